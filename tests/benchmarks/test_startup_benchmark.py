"""How long the program takes to answer where it does no work; both are meant to stay under a
second.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "arguments", [["--help"], ["plugins"], ["modle=w99"]], ids=["help", "plugins", "mistake"]
)
def test_startup(benchmark, arguments: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cfx", *arguments]

    def start() -> int:
        return subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode

    code = benchmark.pedantic(start, rounds=5, warmup_rounds=1)
    assert code == (2 if arguments == ["modle=w99"] else 0)
