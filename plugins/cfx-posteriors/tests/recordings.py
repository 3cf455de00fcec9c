"""Recordings of drivers whose parameters and noise are drawn from the posterior's own prior."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.data.pairs import PairBatch
from cfx.models.base import DrivingModel
from cfx.simulation.rollout import MemoryStepper
from cfx_posteriors import noise
from cfx_posteriors.density import ParameterPrior, Posterior
from cfx_posteriors.noise import noise_kind
from cfx_posteriors.population import Population
from tests.drives import wavy_pairs

DT, STRIDE = 0.1, 10


class Drawn(NamedTuple):
    """Drivers, and what is to be found again: their coordinates `(P, d)`."""

    posterior: Posterior
    truth: Tensor
    batch: PairBatch


def draw_recordings(
    model: DrivingModel,
    drivers: int,
    *,
    frames: int = 600,
    signal: Literal["speed", "gap"] = "speed",
    seed: int = 0,
    population: Population | None = None,
) -> Drawn:
    """Draws parameters, noise and errors, and adds the errors to what the drivers did."""
    generator = torch.Generator().manual_seed(seed)
    space = model.space
    prior = ParameterPrior.of(space, "weak")
    assert prior.center is not None
    among = population or Population(
        space, prior.center[None], torch.linalg.inv(prior.precision)[None]
    )
    normal = torch.randn((drivers, len(space)), generator=generator).double()
    logits = among.mean[0] + normal @ torch.linalg.cholesky(among.covariance[0]).mT
    correlation = torch.rand((drivers, 1), generator=generator).double() * 2.0 - 1.0
    gamma = -torch.log(torch.rand((drivers, 1), generator=generator).double())  # of shape 1
    scale = (noise.RATE / gamma).sqrt()
    pairs = wavy_pairs(model, space.from_unit(torch.sigmoid(logits)), frames=frames, seed=seed)
    batch = PairBatch.of(pairs, dtype=torch.float64)
    errors = torch.zeros_like(batch.follower_speed)
    last = torch.zeros((drivers, 1)).double()
    for first in range(STRIDE, frames, STRIDE):
        step = torch.randn((drivers, 1), generator=generator).double()
        last = correlation * last + scale * step
        errors[:, first : first + STRIDE] = last
    if signal == "speed":
        batch = replace(batch, follower_speed=batch.follower_speed - errors)
    else:
        # A gap that is longer than measured is a follower who is further behind.
        batch = replace(batch, follower_position=batch.follower_position + errors)
    first = torch.zeros(drivers, dtype=torch.int64)
    objective = SpeedRmse() if signal == "speed" else GapRmse()
    segments = SegmentLosses.of_segments(
        MemoryStepper(model, DT).for_work(10**7),
        objective,
        batch,
        torch.arange(drivers),
        first,
        first + frames - 1,
    )
    truth = torch.cat([logits, torch.atanh(correlation), scale.log()], dim=1)
    posterior = Posterior(segments, prior, noise_kind("trajectory", order=1), stride=STRIDE)
    return Drawn(posterior, truth, batch)
