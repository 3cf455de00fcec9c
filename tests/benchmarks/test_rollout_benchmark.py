"""Vehicle steps per second of the rollout, eager and compiled, beside hand-written numba kernels in
the same run.

The case is label search: 64 windows of 5 steps with 4,096 candidates each. `extra_info` holds
million vehicle steps per second,
and the ratio to the numba kernel (where there is one) on two threads and on one; nothing passes or
fails by the clock. A rollout
uses one thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.models.base import DrivingModel, Leader
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import Compile, MemoryStepper, can_compile
from cfx.simulation.trajectory import Start

numba = pytest.importorskip("numba")

PROBLEMS, CANDIDATES, STEPS, DT = 64, 4096, 5, 0.1
WORK = PROBLEMS * CANDIDATES * STEPS
Kernel = Callable[..., None]
Array = NDArray[Any]


@numba.njit(parallel=True)
def krauss_kernel(lead: Array, v0: Array, p: Array, c: Array, x_out: Array, v_out: Array) -> None:
    a, b, v_max = c[0], c[1], c[2]
    for row in numba.prange(p.shape[0]):
        for i in range(p.shape[1]):
            x, v, t_i = v0.dtype.type(0), v0[row, i], p[row, i, 1]
            lag = p[row, i, 0] + t_i / 2
            for k in range(lead.shape[0]):
                v_l = lead[k, row, 1]
                g = lead[k, row, 0] - lead[k, row, 3] - x
                radicand = b * b * lag * lag + b * (v_l * t_i + v_l * v_l / b + 2 * g)
                safe = (math.sqrt(radicand) if radicand > 0 else 0.0) - b * lag
                v = max(min(v + a * c[3], v_max, safe), 0)
                x += v * c[3]
                x_out[k, row, i], v_out[k, row, i] = x, v


@numba.njit(parallel=True)
def w99_kernel(lead: Array, v0: Array, p: Array, c: Array, x_out: Array, v_out: Array) -> None:
    b, b_max, v_max, dt = c[0], c[1], c[2], c[3]
    for row in numba.prange(p.shape[0]):
        for i in range(p.shape[1]):
            x, v, old = v0.dtype.type(0), v0[row, i], v0.dtype.type(0)
            q = p[row, i]
            for k in range(lead.shape[0]):
                v_l, a_l = lead[k, row, 1], lead[k, row, 2]
                dx, dv = lead[k, row, 0] - lead[k, row, 3] - x, v_l - v
                near = q[0] + (q[1] * v if v_l > 0 else 0)
                far = near + q[2]
                sensitivity = q[6] * dx * dx * 1e-4
                closing = q[4] - sensitivity if v > 0 else 0
                opening = sensitivity + q[5] if v_l > q[5] else sensitivity
                if dv < opening and dx <= near:
                    acc = -b_max if dx < v * dt + 0.1 * q[0] else 0.0
                    if v_l > 0:
                        if dv < 0:
                            acc = min(
                                a_l + (dv * dv / (q[0] - dx) if dx > q[0] else (dv - opening) / 2),
                                0,
                            )
                        acc = -q[7] if acc > -q[7] else max(acc, math.sqrt(v) / 2 - 10)
                elif dv < closing and dx < far + q[3] * (dv - q[4]):
                    acc = dv * dv / (2 * (near - dx - 0.1))
                elif dv < opening and dx < far:
                    acc = min(old, -q[7]) if old <= 0 else max(old, q[7])
                elif dx > near:
                    acc = q[8] + q[9] * min(v, 22.2)
                    if dx < far:
                        acc = min(dv * dv / (far - dx), acc)
                else:
                    acc = 0.0
                plan = min(v + acc * dt, v + q[8] * dt, v_max)
                if plan < max(v - b * dt, 0):
                    plan = max(plan, v - b_max * dt, 0)
                plan = 0 if abs(plan) < 1e-5 else plan
                old = (plan - v) / dt
                v = plan
                x += v * dt
                x_out[k, row, i], v_out[k, row, i] = x, v


KERNELS: dict[type[DrivingModel], tuple[Kernel, tuple[str, ...]]] = {
    Krauss: (krauss_kernel, ("a", "b", "v_max")),
    W99: (w99_kernel, ("b", "b_max", "v_max")),
}


class Case:
    """One model's rollouts, for both implementations."""

    def __init__(self, model: DrivingModel, dtype: torch.dtype) -> None:
        draw = torch.Generator().manual_seed(0)
        self.model = model

        def uniform(*shape: int) -> Tensor:
            return torch.rand(shape, generator=draw, dtype=dtype)

        speed = 6 + 8 * uniform(PROBLEMS, 1)
        steps = torch.arange(STEPS, dtype=dtype)[:, None, None]
        position = 8 + 30 * uniform(PROBLEMS, 1) + steps * speed * DT
        acceleration = uniform(STEPS, PROBLEMS, 1) - 0.5
        self.leader = Leader(
            position, speed.expand_as(position), acceleration, torch.full_like(speed, 5.0)
        )
        self.values = model.space.from_unit(uniform(PROBLEMS, CANDIDATES, len(model.space)))
        self.p = {
            name: value.contiguous() for name, value in model.space.unpack(self.values).items()
        }
        zero = torch.zeros((PROBLEMS, CANDIDATES), dtype=dtype)
        self.start = Start(zero, zero + 9 + uniform(PROBLEMS, 1), zero)

    def torch(self, compile: Compile) -> Tensor:
        stepper = MemoryStepper(self.model, DT, compile=compile)
        with torch.inference_mode():
            return stepper.advance(stepper.begin(self.start), self.leader, self.p)[2]

    def numba(self) -> Callable[[], Array]:
        kernel, names = KERNELS[type(self.model)]
        lead = np.stack(
            [np.broadcast_to(x[..., 0].numpy(), (STEPS, PROBLEMS)) for x in self.leader], axis=-1
        )
        constants = np.array([*(self.p[name].item() for name in names), DT], dtype=lead.dtype)
        speed, values = self.start.speed.numpy(), self.values.numpy()

        def run() -> Array:
            position = np.empty((STEPS, PROBLEMS, CANDIDATES), lead.dtype)
            out = np.empty_like(position)
            kernel(lead, speed, values, constants, position, out)
            return out

        return run


def best_time(run: Callable[[], object], rounds: int = 12) -> float:
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.benchmark(group="rollout")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("mode", ["never", "always"], ids=["eager", "compiled"])
@pytest.mark.parametrize("model", [Krauss(), W99(), IDM()], ids=["krauss", "w99", "idm"])
def test_rollout(benchmark: Any, model: DrivingModel, mode: Compile, dtype: torch.dtype) -> None:
    if mode == "always" and not can_compile(torch.device("cpu")):
        pytest.skip("there is no C++ compiler here")
    case = Case(model, dtype)
    begin = time.perf_counter()
    speed = case.torch(mode)
    benchmark.extra_info["first_call_s"] = round(time.perf_counter() - begin, 2)
    benchmark.pedantic(case.torch, (mode,), rounds=12)
    steps = WORK / benchmark.stats.stats.min / 1e6
    benchmark.extra_info["million_vehicle_steps_per_s"] = round(steps)
    if type(model) not in KERNELS:
        return
    run = case.numba()
    reference = run()
    share = float((np.abs(reference - speed.numpy()) < 1e-3).mean())
    assert share > 0.999, f"the numba kernel drives otherwise in {1 - share:.2%} of the frames"
    available = numba.get_num_threads()
    for threads in {1, min(2, available)}:
        numba.set_num_threads(threads)
        kernel_steps = WORK / best_time(run) / 1e6
        benchmark.extra_info[f"numba_{threads}_threads_million_vehicle_steps_per_s"] = round(
            kernel_steps
        )
        benchmark.extra_info[f"times_numba_{threads}_threads"] = round(steps / kernel_steps, 2)
    numba.set_num_threads(available)
