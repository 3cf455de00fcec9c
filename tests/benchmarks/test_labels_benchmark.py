"""Labels per second: all windows as one batch, by BoTorch and along gradients, against the plain BoTorch loop of its tutorials,
window by window, in the same run.

`pytest tests/benchmarks --benchmark-only`. What counts are the ratios in `extra_info`: they compare
runs on one machine.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import pytest
import torch
from botorch.acquisition.analytic import LogExpectedImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.optim import optimize_acqf
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor

from cfx.calibration.botorch import BotorchOptimizer
from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.losses import SegmentLosses
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.rmse import SpeedRmse
from cfx.models.base import DrivingModel, Leader
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Segments, Start

WINDOWS, STEPS, DT, LOOPED = 128, 5, 0.1, 4


def windows(model: DrivingModel) -> SegmentLosses:
    """Returns windows of drivers of this model whose parameters nobody knows, behind leaders that
    accelerate and brake.
    """
    draw = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(WINDOWS, generator=draw, dtype=torch.float64)

    speed, acceleration, gap = uniform(3.0, 18.0), uniform(-1.5, 1.5), uniform(5.0, 40.0)
    leader_speed = (
        speed + uniform(-1.5, 1.5) + acceleration * DT * torch.arange(STEPS)[:, None]
    ).clamp(min=0.0)
    leader_position = (
        gap + 4.5 + torch.cat([torch.zeros(1, WINDOWS), leader_speed[1:] * DT]).cumsum(0)
    )
    length = torch.full((WINDOWS,), 4.5, dtype=torch.float64)
    leader = Leader(leader_position, leader_speed, acceleration.expand(STEPS, -1), length)
    start = Start(torch.zeros_like(speed), speed, uniform(-1.0, 1.0))
    stepper = MemoryStepper(model, DT, compile="never")
    truth = torch.rand(WINDOWS, len(model.space), generator=draw, dtype=torch.float64)
    _, position, observed = stepper.advance(
        stepper.begin(start), leader, model.space.unpack(model.space.from_unit(truth))
    )
    observed = observed + 0.02 * torch.randn(observed.shape, generator=draw, dtype=torch.float64)
    rear = leader_position + leader_speed * DT - length
    segments = Segments(
        *leader[:3],
        leader_rear=rear,
        measured_speed=observed,
        measured_gap=rear - position,
        counted=torch.ones_like(observed),
        leader_length=length,
        position=start.position,
        speed=start.speed,
        acceleration=start.acceleration,
    )
    return SegmentLosses(stepper, SpeedRmse(), segments)


def plain_loop(objective: SegmentLosses, guess: Tensor, *, initial: int, iterations: int) -> float:
    """Returns the loss that BoTorch's tutorial reaches in one window."""
    n = guess.shape[-1]
    bounds = torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, n)
    points = torch.quasirandom.SobolEngine(n, scramble=True, seed=0).draw(
        initial - 1, dtype=torch.float64
    )
    tried = torch.cat([guess, points])
    values = -objective(tried[None])[0][:, None]
    for _ in range(iterations):
        process = SingleTaskGP(tried, values)
        fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
        improvement = LogExpectedImprovement(process, best_f=values.max())
        candidate, _ = optimize_acqf(improvement, bounds, q=1, num_restarts=10, raw_samples=512)
        tried, values = (
            torch.cat([tried, candidate]),
            torch.cat([values, -objective(candidate[None])[0][:, None]]),
        )
    return -values.max().item()


@pytest.mark.timeout(1800)  # the plain loop takes a minute for a window of w99 on a busy machine
@pytest.mark.parametrize("model", [Krauss(), W99()], ids=["krauss", "w99"])
def test_labels_per_second(benchmark: Any, model: DrivingModel) -> None:
    objective = windows(model)
    guesses = model.space.to_unit(model.space.defaults()).expand(WINDOWS, 1, -1)

    found = benchmark.pedantic(
        BotorchOptimizer().minimize, args=(objective, guesses), kwargs={"seed": 0}
    )
    began = time.perf_counter()
    searched = RandomSearch().minimize(objective, guesses, seed=0)
    random_seconds = (time.perf_counter() - began) / WINDOWS

    GradientSearch().minimize(objective, guesses, seed=0)  # its kernel is compiled
    began = time.perf_counter()
    climbed = GradientSearch().minimize(objective, guesses, seed=0)
    gradient_seconds = (time.perf_counter() - began) / WINDOWS

    began = time.perf_counter()
    with warnings.catch_warnings():
        # The plain loop warns of fits and climbs that did not converge: part of what is compared.
        warnings.simplefilter("ignore")
        plain = [
            plain_loop(objective.take(slice(i, i + 1)), guesses[i], initial=10, iterations=30)
            for i in range(LOOPED)
        ]
    plain_seconds = (time.perf_counter() - began) / LOOPED
    seconds = benchmark.stats.stats.mean / WINDOWS
    benchmark.extra_info |= {
        "labels_per_second": 1 / seconds,
        "labels_per_second_random": 1 / random_seconds,
        "labels_per_second_gradient": 1 / gradient_seconds,
        "labels_per_second_plain_loop": 1 / plain_seconds,
        "times_faster_than_plain_loop": plain_seconds / seconds,
        "times_faster_than_plain_loop_gradient": plain_seconds / gradient_seconds,
        "mean_loss_over_plain_loop_gradient": (
            climbed.loss[:LOOPED].mean().item() / (sum(plain) / LOOPED)
        ),
        "mean_loss_over_4096_random": (found.loss.mean() / searched.loss.mean()).item(),
        "mean_loss_over_plain_loop": found.loss[:LOOPED].mean().item() / (sum(plain) / LOOPED),
    }
    assert bool((found.loss <= objective(guesses)[:, 0] * (1 + 1e-5)).all())
