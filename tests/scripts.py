"""Scripts that tests write and start, as a user would, in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.checkout import ROOT

ENVIRONMENT = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
"""What a script knows of the tests' own environment: where cfx is, and that others use the cores."""


def command_of(text: str, folder: Path) -> list[str]:
    """Writes a script into a folder; returns the command that starts it."""
    script = folder / "script.py"
    script.write_text(text)
    return [sys.executable, str(script)]


def run_script(text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a script to its end."""
    return subprocess.run(
        command_of(text, folder), env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
