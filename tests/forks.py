"""Processes of their own that start in milliseconds: forks of one that has imported already.

Imports take a process of cfx one to five seconds. What is tested here is what such processes do;
`tests/test_imports.py` and others start Python itself.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.checkout import ROOT

_SERVER = """
import gc, json, os, runpy, sys

answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what is imported may print
exec(sys.argv[1], {"__name__": "imports"})
gc.freeze()
for line in iter(sys.stdin.readline, ""):
    asked = json.loads(line)
    if "pid" in asked:
        answer = os.waitpid(asked["pid"], asked["options"])
    else:
        answer = os.fork()
        if not answer:
            break
    print(json.dumps(answer), file=answers, flush=True)
else:
    sys.exit()

answers.close()
os.chdir(asked["folder"])
os.environ.clear()
os.environ.update(asked["environment"])
for number, name in enumerate((asked["given"], asked["out"], asked["error"])):
    os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_APPEND), number)
kind, *sys.argv = asked["command"]
if kind == "-m":
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
elif kind == "-c":
    text, sys.argv[0] = sys.argv[0], "-c"
    exec(compile(text, "<string>", "exec"), {"__name__": "__main__"})
else:
    sys.argv.insert(0, kind)
    runpy.run_path(kind, run_name="__main__")
"""
"""A fork leaves the loop, and ends as any program does."""


class Fork:
    """A process that was started, as `subprocess.Popen` has one.

    Attributes:
        out, error: files of what it writes.
    """

    def __init__(self, forks: Forks, pid: int, out: Path, error: Path) -> None:
        self.pid, self.out, self.error = pid, out, error
        self._forks = forks
        self._code: int | None = None

    def poll(self) -> int | None:
        """Returns the exit code, negative for a signal; None while it runs."""
        return self._wait(os.WNOHANG)

    def wait(self) -> int:
        """Waits until it ends; returns the exit code."""
        code = self._wait(0)
        assert code is not None
        return code

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def _wait(self, options: int) -> int | None:
        if self._code is None:
            pid, status = self._forks.ask({"pid": self.pid, "options": options})
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code


class Forks:
    """Starts processes that have done `imports` already; `with` ends them and whom they come from."""

    def __init__(self, imports: str, folder: Path) -> None:
        self._folder = folder
        self._started: list[Fork] = []
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        environment.pop("MLFLOW_TRACKING_URI", None)
        self._environment = environment
        self._server = subprocess.Popen(
            [sys.executable, "-c", _SERVER, imports],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Forks:
        return self

    def __exit__(self, *_: object) -> None:
        for fork in self._started:
            if fork.poll() is None:
                fork.kill()
        self._server.communicate()

    def start(self, command: Sequence[str], folder: Path, *, given: str = "") -> Fork:
        """Starts a process.

        Args:
            command: what would follow `python`: `-m` and a module, `-c` and a text, or a script.
            folder: to start in.
            given: what it reads from its standard input.
        """
        number = len(self._started)
        names = [f"{number}.{name}" for name in ("given", "out", "error")]
        read, out, error = (self._folder / name for name in names)
        read.write_text(given)
        asked = {
            "command": list(command),
            "folder": str(folder),
            "environment": self._environment,
            "given": str(read),
            "out": str(out),
            "error": str(error),
        }
        self._started.append(Fork(self, self.ask(asked), out, error))
        return self._started[-1]

    def run(
        self, command: Sequence[str], folder: Path, given: str = ""
    ) -> subprocess.CompletedProcess[str]:
        """Runs a process to its end; `given` is what it reads from its standard input."""
        fork = self.start(command, folder, given=given)
        code = fork.wait()
        return subprocess.CompletedProcess(
            command, code, fork.out.read_text(), fork.error.read_text()
        )

    def ask(self, what: Mapping[str, Any]) -> Any:
        """Asks the process that the others come from."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps(what) + "\n")
        self._server.stdin.flush()
        answer = self._server.stdout.readline()
        assert answer, "the process that the others come from has ended"
        return json.loads(answer)
