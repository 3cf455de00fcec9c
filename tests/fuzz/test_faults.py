"""Every file that a job writes fails once: a sentence, and the same command then gives it all.

A fault hits before the file is written, before it takes its name, or just after. The process may be
refused (a full disk, a broken one, a missing right) or end there.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import cfx.calibration.cache
import cfx.core.files
import cfx.data.tidy
import cfx.figures.drawing
import cfx.policies.checkpoint
import cfx.results.folder
import cfx.results.result
import cfx.results.table
from cfx.app import cli
from cfx.errors import Terminated
from tests.broken_plugins import QUICK

JOB = [one for one in QUICK if not one.startswith(("figures", "cache", "policy"))]
JOB += ["policy=gru", "learner.epochs=1", "policy.hidden_size=4"]

MODULES = (
    cfx.policies.checkpoint,
    cfx.calibration.cache,
    cfx.data.tidy,
    cfx.core.files,
    cfx.results.folder,
    cfx.results.result,
    cfx.results.table,
    cfx.figures.drawing,
)
"""Whoever writes files."""

WHOLE = cfx.core.files.atomic_write
STRIDE = int(os.environ.get("CFX_FAULTS_STRIDE", "97"))
"""Of the faults every so manieth is tried, of another kind at another moment; `make fuzz` tries all."""

KINDS = ("ENOSPC", "EIO", "EACCES", "killed")
MOMENTS = ("before", "unnamed", "named")


class Faults:
    """Counts the files that are written, and lets one of them fail."""

    def __init__(self, at: int | None = None, kind: str = "", moment: str = "") -> None:
        self.at, self.kind, self.moment = at, kind, moment
        self.count = 0
        self.hit = ""

    def strike(self, number: int, moment: str) -> None:
        if number != self.at or moment != self.moment:
            return
        if self.kind == "killed":
            raise Terminated
        number = getattr(errno, self.kind)
        raise OSError(number, os.strerror(number))

    @contextlib.contextmanager
    def atomic_write(self, path: Path) -> Iterator[Path]:
        self.count += 1
        number = self.count  # another file may be written within this one
        if number == self.at:
            self.hit = path.name
        self.strike(number, "before")
        with WHOLE(path) as temporary:
            yield temporary
            self.strike(number, "unnamed")
        self.strike(number, "named")


def undrawn(one: object, results: object) -> Figure:
    """Stands for a drawing, which takes most of such a job's time."""
    return Figure()


def job(folder: Path, faults: Faults, monkeypatch: pytest.MonkeyPatch) -> int:
    with monkeypatch.context() as patched:
        patched.setattr(cfx.figures.drawing, "draw_figure", undrawn)
        for module in MODULES:
            patched.setattr(module, "atomic_write", faults.atomic_write)
        cache = f"cache.folder={folder / 'cache'}"
        return cli.main([*JOB, cache, f"hydra.run.dir={folder / 'job'}"])


def results(folder: Path) -> dict[str, bytes]:
    found = {}
    for name in ("metrics.json", "pairs.csv", "policy/policy.safetensors"):
        found[name] = (folder / "job" / name).read_bytes()
    return found


def test_each_file_fails_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counted = Faults()
    assert job(tmp_path / "whole", counted, monkeypatch) == 0
    expected = results(tmp_path / "whole")
    assert counted.count > 12
    tried = 0
    for number in range(counted.count * len(KINDS) * len(MOMENTS)):
        if number % STRIDE:
            continue
        at, rest = divmod(number, len(KINDS) * len(MOMENTS))
        kind, moment = KINDS[rest // len(MOMENTS)], MOMENTS[rest % len(MOMENTS)]
        folder = tmp_path / str(number)
        capsys.readouterr()
        faults = Faults(at + 1, kind, moment)
        code = job(folder, faults, monkeypatch)
        said = capsys.readouterr().err
        where = f"{faults.hit} ({at + 1} of {counted.count}), {kind}, {moment}: {code} {said}"
        assert code == (143 if kind == "killed" else 2), where
        assert "Traceback" not in said, where
        assert len(said.strip().splitlines()) <= 3, where
        assert job(folder, Faults(), monkeypatch) == 0, where
        assert results(folder) == expected, where
        assert not list(folder.rglob(f".{os.getpid()}@*")), where
        tried += 1
    assert tried >= 3
    print(f"{tried} faults of {counted.count} files tried, 0 failed")
