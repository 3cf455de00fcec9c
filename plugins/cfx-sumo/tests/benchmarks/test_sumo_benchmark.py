"""Pair-runs per second with SUMO in the loop, beside one SUMO process for each run in the same run.

The case is a calibration: followers with parameters of their own behind real-looking leaders, 650
steps each. The other way is
what scripts around SUMO do: write the input files, start a process, drive one pair, read the
result; here with libsumo, which is
faster than talking to the `sumo` program by TraCI. Both use every core. `extra_info` holds both
rates and their ratio; nothing
passes or fails by the clock.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.models.base import Leader
from cfx.simulation.trajectory import Start
from cfx_sumo.krauss import KraussSumo

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)

RUNS, STEPS, DT = 400, 650, 0.1
ALONE = 8  # runs with a process each
REFERENCE = Path(__file__).parents[1] / "sumo_reference.py"


class Case:
    """Followers behind leaders that slow down and drive off again."""

    def __init__(self) -> None:
        draw = torch.Generator().manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(shape, generator=draw, dtype=torch.float64)

        self.model = KraussSumo()
        time = torch.arange(STEPS, dtype=torch.float64)[:, None] * DT
        speed = 9 + 6 * torch.sin(6.28 * time / uniform(12, 25, RUNS) + uniform(0, 6, RUNS))
        acceleration = torch.cat([torch.zeros(1, RUNS), speed.diff(dim=0) / DT])
        moved = torch.cat([torch.zeros(1, RUNS), (speed[1:] * DT).cumsum(0)])
        self.leader = Leader(
            200.0 + moved, speed, acceleration, torch.full((RUNS,), 5.0, dtype=torch.float64)
        )
        zero = torch.zeros(RUNS, dtype=torch.float64)
        self.start = Start(195.0 - uniform(10, 40, RUNS), zero + 9.0, zero)
        self.p = self.model.space.unpack(
            self.model.space.from_unit(uniform(0, 1, RUNS, len(self.model.space)))
        )

    def request(self, i: int) -> str:
        """Returns run i for a process of its own."""
        kind = self.model.sumo_vtype(
            {name: value if value.dim() == 0 else value[i] for name, value in self.p.items()}
        )
        run = {
            "model": kind.car_follow_model,
            "parameters": {name: float(value) for name, value in kind.attributes.items()},
            "leader": {name: float(value) for name, value in kind.leader.items()},
            "leader_speed": self.leader.speed[:, i].tolist(),
            "leader_position": 200.0,
            "leader_acceleration": 0.0,
            "leader_length": 5.0,
            "position": self.start.position[i].item(),
            "speed": 9.0,
            "acceleration": 0.0,
        }
        return json.dumps({"dt": DT, "runs": [run]})


def alone(request: str) -> list[float]:
    """Drives one pair in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(REFERENCE)], input=request, capture_output=True, text=True, check=True
    )
    speed: list[float] = json.loads(done.stdout)["runs"][0]["speed"]
    return speed


@pytest.mark.benchmark(group="sumo")
def test_pair_runs_in_sumo(benchmark: Any) -> None:
    from cfx_sumo.simulation.stepper import SumoStepper

    case, cores = Case(), len(os.sched_getaffinity(0))
    stepper = SumoStepper(case.model, DT)

    def drive() -> Tensor:
        return stepper.advance(stepper.begin(case.start), case.leader, case.p)[2]

    speed = drive()  # the processes have started
    benchmark.pedantic(drive, rounds=4)
    stepper.close()
    rate = RUNS / benchmark.stats.stats.median
    begin = time.perf_counter()
    with ThreadPoolExecutor(cores) as pool:
        one_by_one = list(pool.map(alone, [case.request(i) for i in range(ALONE)]))
    slow = ALONE / (time.perf_counter() - begin)
    for i, theirs in enumerate(one_by_one):
        assert speed[: STEPS - 1, i].tolist() == pytest.approx(theirs[1:], abs=1e-9)
    benchmark.extra_info["cores"] = cores
    benchmark.extra_info["pair_runs_per_s"] = round(rate)
    benchmark.extra_info["pair_runs_per_s_with_a_process_each"] = round(slow, 1)
    benchmark.extra_info["times_a_process_each"] = round(rate / slow)
