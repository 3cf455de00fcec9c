"""Seconds and memory of whole jobs for growing numbers of synthetic pairs, as a table and a figure.

`python -m tests.benchmarks.cost_growth --figure docs/cost_growth.png 100 1000 10000`. The pairs are
in files of 1,000, made before and kept in the folder `--recordings`; making them is not measured.
Each job is a process of its own, so that its peak of memory is its own too. `--fixed` leaves
training out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from cfx.data.pairs import PairSet
from cfx.data.tidy import write_tidy
from cfx.simulation.synthetic import SyntheticDataset

_FRAMES, _OF_FILE = 300, 1000
"""Frames of each pair, and pairs of each file."""

_JOB = ("data=tidy", "data.min_duration=20", "model=krauss", "optimizer=random")
_QUIET = ("figures=none", "tracking.enabled=false", "cache.enabled=false")
_TRAINED = ("learner.epochs=2",)
_FIXED = ("policy=fixed",)


class Cost(NamedTuple):
    """What a job takes.

    Attributes:
        pairs: how many.
        seconds: from its start to its end.
        cpu: seconds of all cores together.
        system: those of them that the operating system took.
        peak: MB of memory at most, of the largest of its processes.
    """

    pairs: int
    seconds: float
    cpu: float
    system: float
    peak: float


def record(folder: Path, number: int) -> Path:
    """Returns the folder of one recording of synthetic pairs; makes it if it is not there."""
    name = f"r{number:04d}"
    recording = folder / f"recording={name}"
    file = recording / "part-0.parquet"
    if not file.exists():
        pairs = SyntheticDataset(seed=number, pairs=_OF_FILE, frames=_FRAMES).read()
        named = []
        for pair in pairs:
            pair_id = f"{name}-{pair.pair_id}"
            named.append(replace(pair, pair_id=pair_id, recording=name, truth={}, truth_model=""))
        recording.mkdir(parents=True, exist_ok=True)
        write_tidy(PairSet(tuple(named), name), file)
    return recording


def cost(recordings: Path, pairs: int, overrides: list[str]) -> Cost:
    """Runs one job in an empty folder, on the first so many pairs."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        data.mkdir()
        for number in range(-(-pairs // _OF_FILE)):
            recording = record(recordings, number)
            (data / recording.name).symlink_to(recording.absolute())
        which = [f"data.path={data}", f"data.max_pairs={pairs}"]
        command = [sys.executable, "-m", "cfx", *_JOB, *_QUIET, *which, *overrides]
        began = time.perf_counter()
        job = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        assert job.stderr is not None
        said = job.stderr.read()
        _, status, usage = os.wait4(job.pid, 0)
        job.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - began
    if job.returncode:
        raise SystemExit(said)
    cpu = usage.ru_utime + usage.ru_stime
    return Cost(pairs, seconds, cpu, usage.ru_stime, usage.ru_maxrss / 1024)


def draw(costs: dict[str, list[Cost]], path: Path) -> None:
    """Draws seconds and memory against the number of pairs, both axes logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    panels: Any = figure.subplots(1, 2)
    panels[0].set(title="time of the whole job", ylabel="s")
    panels[1].set(title="memory at most", ylabel="MB")
    for name, found in costs.items():
        pairs = [one.pairs for one in found]
        panels[0].plot(pairs, [one.seconds for one in found], marker="o", label=name)
        panels[1].plot(pairs, [one.peak for one in found], marker="o", label=name)
    for panel in panels:
        panel.set(xscale="log", yscale="log", xlabel=f"pairs of {_FRAMES} frames")
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.3)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measures, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", nargs="*", type=int, help="with training")
    parser.add_argument("--fixed", nargs="*", type=int, default=[], help="without training")
    parser.add_argument("--file", type=Path, help="where results are kept between calls, JSON")
    parser.add_argument("--recordings", type=Path, help="where the pairs are kept between calls")
    parser.add_argument("--figure", type=Path, help="PNG")
    parser.add_argument("--set", nargs="*", default=[], help="further settings of all jobs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        costs = _measured(options, options.recordings or Path(folder))
    for name, found in costs.items():
        print(
            f"\n{name}\n| pairs | seconds | CPU seconds | system | MB |\n| --- | --- | --- | --- | --- |"
        )
        for one in found:
            print(
                f"| {one.pairs:,} | {one.seconds:.1f} | {one.cpu:.1f} | {one.system:.1f} | {one.peak:.0f} |"
            )
    if options.figure:
        draw(costs, options.figure)


def _measured(options: argparse.Namespace, recordings: Path) -> dict[str, list[Cost]]:
    """Returns the costs of all jobs that were asked for, and of those in the file."""
    kept: dict[str, dict[str, list[float]]] = {}
    if options.file and options.file.exists():
        kept = json.loads(options.file.read_text())
    plans = (
        ("calibrate, train, evaluate", options.pairs, _TRAINED),
        ("calibrate, evaluate", options.fixed, _FIXED),
    )
    for name, numbers, overrides in plans:
        for pairs in numbers:
            found = cost(recordings, pairs, [*overrides, *options.set])
            kept.setdefault(name, {})[str(pairs)] = list(found)
            print(name, found, flush=True)
            if options.file:
                options.file.write_text(json.dumps(kept))
    costs = {}
    for name, rows in kept.items():
        costs[name] = sorted(Cost(*row) for row in rows.values())
    return costs


if __name__ == "__main__":
    main()
