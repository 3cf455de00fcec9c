"""Where the time of calibration's kernel goes: to make it, and to run it beside its eager twin.

    python -m tests.benchmarks.kernel_stages krauss idm w99

One thread, 60 segments of 600 steps, 512 candidates of each, errors of speed. A table in Markdown:
seconds to record a step (PyTorch's tracer is imported before) and to compile it, then million
vehicle steps a second.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from typing import cast

import torch

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.rmse import SpeedRmse
from cfx.core import registry, threads
from cfx.data.pairs import PairBatch
from cfx.models.base import DrivingModel
from cfx.models.krauss import Krauss
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.graph import record
from cfx.simulation.kernel.source import write
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

SEGMENTS, STEPS, CANDIDATES, DT = 60, 600, 512, 0.1


def seconds(work: Callable[[], object]) -> float:
    """Returns the shortest of three times."""
    times = []
    for _ in range(3):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def losses_of(model: DrivingModel, compile: str) -> SegmentLosses:
    """Returns the losses of made-up recordings, of drivers of Krauss's model."""
    unit = torch.rand((SEGMENTS, 2), generator=torch.Generator().manual_seed(0)).double()
    driven = Krauss()
    pairs = PairBatch.of(wavy_pairs(driven, driven.space.from_unit(unit), frames=STEPS + 1))
    number = torch.arange(SEGMENTS)
    stepper = MemoryStepper(model, DT, compile=compile)  # type: ignore[arg-type]
    first, steps = torch.zeros_like(number), torch.full_like(number, STEPS)
    return SegmentLosses.of_segments(stepper, SpeedRmse(), pairs, number, first, steps)


def row(name: str) -> str:
    """Returns a model's row of the table."""
    model = cast("DrivingModel", registry.create("model", {"name": name}))
    compiled, eager = losses_of(model, "always"), losses_of(model, "never")
    generator = torch.Generator().manual_seed(1)
    shape = (SEGMENTS, CANDIDATES, len(model.space))
    candidates = torch.rand(shape, generator=generator, dtype=torch.float64)
    p = compiled.parameters(candidates)

    def recorded() -> str:
        program = record(model, tuple(p), DT, compiled.terms, torch.float64)
        varied = [value.dim() > 0 for value in p.values()]
        return write(program, varied, torch.float64)

    recorded()  # imports PyTorch's tracer
    recording = seconds(recorded)
    source = recorded()
    began = time.perf_counter()
    compiler.build_library(source)
    compiling = time.perf_counter() - began
    steps = SEGMENTS * STEPS * CANDIDATES / 1e6
    compiled(candidates)
    by_kernel = seconds(lambda: compiled(candidates))
    by_pytorch = seconds(lambda: eager(candidates))
    return (
        f"| {name} | {recording:.2f} | {compiling:.2f} |"
        f" {steps / by_kernel:.0f} | {steps / by_pytorch:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="+")
    names = parser.parse_args().models
    threads.limit_cores(1)
    torch.set_num_threads(1)
    print("| model | record, s | compile, s | kernel | PyTorch |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["CFX_KERNEL_CACHE"] = folder
        compiler.cache_folder.cache_clear()
        for name in names:
            print(row(name))


if __name__ == "__main__":
    main()
