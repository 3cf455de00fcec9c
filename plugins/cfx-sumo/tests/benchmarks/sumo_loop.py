"""Whether calibrations with SUMO in the loop give the same bits in threads, never hang, and end when told to.

    python -m plugins.cfx-sumo.tests.benchmarks.sumo_loop --runs 100

Each run is a process of its own: eight pairs in 2, 3, 4 or 8 shards, on two cores that share two
SUMO processes. Its results are compared, byte by byte, with those of one core. After them, a fifth
as many runs are sent SIGTERM, each a little later than the one before. Prints one line for each
difference, each run that takes too long, each other way to end, each process that stays; and how
many runs there were.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from tests.scripts import ENVIRONMENT

PAIRS, SAMPLES, SHARDS = 8, 12, (2, 3, 4, 8)
RESULTS = ("pairs.csv", "metrics.json")
MODELS = {
    "krauss_sumo": ("model=krauss_sumo",),
    "IDMM": (
        "model=sumo_vtype",
        "model.car_follow_model=IDMM",
        "model.parameters={tau: {low: 0.5, high: 3, default: 1}}",
    ),
}
JOB = (
    "simulator=sumo",
    "simulator.workers=2",
    "policy=fixed",
    "protocol=within_driver",
    "learner=imitation",
    "optimizer=random",
    f"optimizer.samples={SAMPLES}",
    "data=synthetic_short",
    f"data.pairs={PAIRS}",
    "data.frames=200",
    "data.max_pairs=null",
    "cache.enabled=false",
    "figures=none",
    "tracking.enabled=false",
    "hydra.run.dir=job",
)
PROGRAM = f"""
import sys
from pathlib import Path
from cfx.app import cli
from cfx.calibration.optimizers import base
base._LOSSES_AT_ONCE = {SAMPLES} * -(-{PAIRS} // int(sys.argv.pop(1)))
share = base.share
def counting(solve, starts, **more):
    Path("shards").write_text(str(len(starts)))
    return share(solve, starts, **more)
base.share = counting
sys.exit(cli.main())
"""
"""Bounds the problems of a shard, which needs a large file of pairs otherwise."""

TOO_LONG = 300.0
"""A run that has not ended after as many seconds hangs."""


class Run:
    """One process that calibrates, in a folder of its own."""

    def __init__(self, folder: Path, model: str, shards: int, *more: str) -> None:
        folder.mkdir()
        self.folder, self.shards = folder, shards
        self.name = f"{folder.name}: {model}, {shards} shards"
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(shards), *JOB, *MODELS[model], *more],
            cwd=folder,
            env=ENVIRONMENT | {"TMPDIR": str(folder)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self, *codes: int) -> str:
        """Waits for the end; returns what is wrong with it, or "" if it is as it should be."""
        descendants = psutil.Process(self.process.pid).children(recursive=True)
        try:
            _, said = self.process.communicate(timeout=TOO_LONG)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return f"{self.name} hangs"
        if self.process.returncode not in codes:
            return f"{self.name} ended with {self.process.returncode}: {said.strip()[-300:]}"
        gone, alive = psutil.wait_procs(descendants, timeout=10)
        return f"{self.name} left {len(alive)} of {len(gone) + len(alive)} processes" * bool(alive)

    def results(self) -> dict[str, bytes]:
        return {name: (self.folder / "job" / name).read_bytes() for name in RESULTS}


def main(runs: int, scratch: Path) -> list[str]:
    """Runs everything; returns what was wrong."""
    wrong, seconds = [], {}
    expected = {}
    for model in MODELS:
        alone = Run(scratch / f"{model}_alone", model, 1, "cores=1")
        wrong += [alone.end(0)]
        expected[model] = alone.results()
    for number in range(runs):
        model = list(MODELS)[number % 5 > 2]
        began = time.monotonic()
        run = Run(scratch / f"{number}", model, SHARDS[number % 4], "cores=2")
        said = run.end(0)
        seconds[model] = time.monotonic() - began
        if not said and run.results() != expected[model]:
            said = f"{run.name}: other results than with one core"
        if not said and (run.folder / "shards").read_text() != str(run.shards):
            said = f"{run.name}: another number of shards"
        wrong.append(said)
        print(f"{run.name}: {said or 'equal'}, {seconds[model]:.0f} s", flush=True)
        shutil.rmtree(run.folder)
    told = runs // 5
    for number in range(told):
        model = list(MODELS)[number % 2]
        run = Run(
            scratch / f"told_{number}",
            model,
            SHARDS[number % 4],
            "cores=2",
            "optimizer.samples=4096",
        )
        time.sleep((number + 1) / told * 1.5 * seconds[model])
        run.process.send_signal(signal.SIGTERM)
        began = time.monotonic()
        # The signal itself ends a program that has not begun to run cfx.
        wrong.append(run.end(143, -signal.SIGTERM))
        print(f"{run.name}: {wrong[-1] or 'ended'}, {time.monotonic() - began:.1f} s", flush=True)
    return [one for one in wrong if one]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=100)
    number = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        found = main(number, Path(folder))
    print("\n".join(found))
    print(f"{number} runs and {number // 5} told to end: {len(found)} were wrong")
