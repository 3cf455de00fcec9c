"""What documents print as code, and an environment in which it runs as it is printed."""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
import venv
from collections.abc import Iterator
from pathlib import Path

from tests.checkout import ROOT

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def all_blocks(name: str) -> Iterator[tuple[str, str]]:
    """Yields language and text of each block of code of a document."""
    yield from _BLOCK.findall((ROOT / name).read_text(encoding="utf-8"))


def blocks(name: str, language: str) -> list[str]:
    """Returns the blocks of one language."""
    return [body for found, body in all_blocks(name) if found == language]


class Reader:
    """Somebody who types what a document prints.

    They have an environment of their own that sees this one's packages; pip stays off the network.
    """

    def __init__(self, folder: Path) -> None:
        home = folder / "env"
        venv.create(home, with_pip=False, symlinks=True)
        (site,) = home.glob("lib/python*/site-packages")
        (site / "all.pth").write_text(
            f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n", encoding="utf-8"
        )
        pip = home / "bin" / "pip"
        pip.write_text(f'#!/bin/sh\nexec {home}/bin/python -m pip "$@"\n', encoding="utf-8")
        pip.chmod(0o755)
        search = f"{home / 'bin'}{os.pathsep}{os.environ['PATH']}"
        self.folder = folder
        self.environment = {
            **os.environ,
            "PIP_NO_INDEX": "1",
            "PIP_NO_DEPS": "1",
            "PIP_NO_BUILD_ISOLATION": "0",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
            "PATH": search,
            "MLFLOW_TRACKING_URI": f"sqlite:///{folder}/mlflow.db",
        }

    def shell(self, block: str) -> str:
        """Runs a block as a shell does that stops at the first error; returns what it printed."""
        return self._run(["sh", "-ec", block])

    def python(self, block: str) -> str:
        """Runs a block of Python; returns what it printed."""
        return self._run(["python", "-c", block])

    def _run(self, command: list[str]) -> str:
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout
