"""Pages of made-up jobs, as the report renders them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cfx_report import inline
from cfx_report.page import render
from cfx_report.runs import read_runs
from tests.pages import Page


def page_of(folder: Path) -> Page:
    return Page(render(read_runs([str(folder)])))


@contextmanager
def blank_drawings() -> Iterator[None]:
    """Makes pages quick that are looked at for something else than their figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inline, "inline_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')
        yield
