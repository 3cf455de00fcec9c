"""The page on the kernel of calibration: its code runs, and prints what stands there."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import pytest

from cfx.simulation.kernel import compiler
from tests.printed import all_blocks

PAGE = "docs/development/kernel.md"


@pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")
def test_the_page_shows_what_its_code_makes() -> None:
    """Blocks run one after the other; what follows one as text or C++ is all that it prints."""
    names: dict[str, Any] = {"__name__": "kernel_page"}
    printed, shown = "", 0
    for language, block in all_blocks(PAGE):
        if language == "python":
            assert not printed, f"nothing is shown of\n{printed}"
            output = io.StringIO()
            with contextlib.redirect_stdout(output):
                exec(compile(block, PAGE, "exec"), names)  # noqa: S102 - the page's own code
            printed = output.getvalue()
        elif language in {"text", "cpp"}:
            assert block.strip() == printed.strip(), f"{PAGE} should show\n{printed}"
            printed, shown = "", shown + 1
    assert shown >= 6
