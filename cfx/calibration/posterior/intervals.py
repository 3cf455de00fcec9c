"""Intervals of drivers' parameters: what their recordings say, and what they leave open.

Shapes: P drivers, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.calibration.losses import SegmentLosses
from cfx.calibration.posterior.density import ParameterPrior, Posterior
from cfx.calibration.posterior.fan import Fan, fan_of
from cfx.calibration.posterior.importance import sample
from cfx.calibration.posterior.laplace import Normal, laplace, likely_starts
from cfx.calibration.posterior.levels import LEVEL
from cfx.calibration.posterior.population import Population, fit_population
from cfx.calibration.settings import CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.core.parameters import squashed
from cfx.data.pairs import PairBatch
from cfx.simulation.trajectory import Segments

_SHARES = (0.5 - 0.5 * LEVEL, 0.5, 0.5 + 0.5 * LEVEL)

NEW_DRIVERS = 1000
"""Drivers that are drawn from a prior or a population and kept."""

_WORK = 10**8
"""Vehicle steps that belong together: enough for a compiled kernel."""


_OF_DRIVERS = (
    "noise_scale",
    "noise_correlation",
    "noise_left",
    "effective_samples",
    "pareto_k",
)


@dataclass(frozen=True)
class ParameterIntervals:
    """What P recordings say of parameters.

    Attributes:
        names: of the parameters.
        low, median, high: quantiles, `(P, n)`, SI units.
        contraction: `(P, n)`, 1 minus the width of the interval over that of the prior's, of
            logits: 0 where a recording says nothing, 1 where it leaves no doubt.
        noise_scale: `(P,)`, what each step of the noise adds, as the signal: m/s or m.
        noise_correlation: `(P,)`, of the noise with itself one step later.
        noise_left: `(P,)`, the same correlation of what the noise's model leaves of it; near 0
            where the model is right.
        effective_samples: `(P,)`, effective sample size that the quantiles rest on.
        pareto_k: `(P,)`, above 0.7 the intervals are not to be relied on.
        draws: parameters, `(P, DRAWS, n)`, SI units: as correlated as a recording leaves them.
        new_drivers: parameters of drivers who have no recording, `(NEW_DRIVERS, n)`, SI units: of
            the population, or as the prior has them.
        fan: of trajectories.
        population: from which all drivers come, if it was asked for.
    """

    names: tuple[str, ...]
    low: Tensor
    median: Tensor
    high: Tensor
    contraction: Tensor
    noise_scale: Tensor
    noise_correlation: Tensor
    noise_left: Tensor
    effective_samples: Tensor
    pareto_k: Tensor
    draws: Tensor
    new_drivers: Tensor
    fan: Fan
    population: Population | None = None

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Returns columns for a row per driver: `median_NAME`, `noise_scale` and so on."""
        found = {}
        for kind in ("median", "low", "high", "contraction"):
            for number, name in enumerate(self.names):
                found[f"{kind}_{name}"] = getattr(self, kind)[:, number].numpy()
        for kind in _OF_DRIVERS:
            found[kind] = getattr(self, kind).numpy()
        return found

    def tables(self, ids: Sequence[str]) -> dict[str, pd.DataFrame]:
        """Returns `posterior`, draws of each driver's parameters, `prior` and `fan`.

        Where a population was asked for, `population`, new drivers of it, stands for `prior`.

        Args:
            ids: of the pairs.
        """
        columns = [f"parameter_{name}" for name in self.names]
        pairs, draws, _ = self.draws.shape
        values = pd.DataFrame(self.draws.flatten(0, 1).numpy(), columns=columns)
        values.insert(0, "pair_id", np.repeat(np.asarray(ids, dtype=object), draws))
        values.insert(1, "draw", np.tile(np.arange(draws), pairs))
        new = pd.DataFrame(self.new_drivers.numpy(), columns=columns)
        name = "prior" if self.population is None else "population"
        return {"posterior": values, "fan": self.fan.table(ids), name: new}


def parameter_intervals(
    solver: Solver,
    batch: PairBatch,
    last: Tensor,
    best: Tensor,
    settings: CalibrationSettings,
) -> ParameterIntervals:
    """Returns the intervals of each driver's parameters.

    Args:
        solver: whose model, time step and objective count, and which bounds the memory.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed loop.
        best: `(P, n)`, the point estimates, SI units: searches start there too.
        settings: prior, method and noise.
    """
    posterior = posterior_of(solver, batch, last, settings)
    space = solver.space
    best = squashed(space.to_unit(best.to("cpu", torch.float64)))
    default = squashed(space.to_unit(space.defaults())).expand_as(best)
    starts = torch.cat(
        [best[:, None], default[:, None], likely_starts(posterior, solver.seed)], dim=1
    )
    population = None
    if settings.posterior == "hierarchical":
        population, posterior, normal = fit_population(posterior, starts)
    else:
        normal = laplace(posterior, starts)
    shares = torch.tensor(_SHARES, dtype=torch.float64)
    found = sample(posterior, normal, shares, seed=solver.seed, memory=solver.memory)
    prior = posterior.prior.quantiles(shares, len(space))
    width = (found.quantiles[:, 2] - found.quantiles[:, 0]) / (prior[2] - prior[0])
    values = space.from_unit(torch.sigmoid(found.quantiles))
    low, median, high = values.unbind(1)
    scale, correlation, left = _noise(posterior, normal)
    whole = posterior_of(solver, batch, batch.lengths - 1, settings)
    fan = fan_of(
        replace(whole, stride=posterior.stride),
        last.cpu(),
        found.draws,
        shares,
        seed=solver.seed,
        memory=solver.memory,
    )
    if population is None:
        before = posterior.prior.draw(NEW_DRIVERS, len(space), seed=solver.seed)
        new_drivers = space.from_unit(torch.sigmoid(before))
    else:
        new_drivers = population.draw(NEW_DRIVERS, seed=solver.seed)
    return ParameterIntervals(
        space.names,
        low,
        median,
        high,
        contraction=1.0 - width,
        noise_scale=scale,
        noise_correlation=correlation,
        noise_left=left,
        effective_samples=found.effective,
        pareto_k=found.pareto_k,
        draws=space.from_unit(torch.sigmoid(found.draws[..., : len(space)])),
        new_drivers=new_drivers,
        fan=fan,
        population=population,
    )


def posterior_of(
    solver: Solver, batch: PairBatch, last: Tensor, settings: CalibrationSettings
) -> Posterior:
    """Returns the posterior of drivers on their recordings up to a last frame, on the CPU.

    Args:
        solver: whose model, time step and objective count.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed loop.
        settings: prior and noise.
    """
    pair = torch.arange(len(batch), device=batch.lengths.device)
    last = last.to(pair.device)
    cut = SegmentLosses.of_segments(
        solver.simulator.for_work(_WORK), solver.objective, batch, pair, pair * 0, last
    )
    measured = Segments(*(values.to("cpu", torch.float64) for values in cut.segments))
    stride = max(1, round(settings.noise_step_s / solver.simulator.dt))
    return Posterior(
        SegmentLosses(cut.simulator, cut.objective, measured),
        ParameterPrior.of(solver.space, settings.prior),
        settings.noise_order,
        min(stride, cut.steps),
    )


def _noise(posterior: Posterior, normal: Normal) -> tuple[Tensor, Tensor, Tensor]:
    """Returns scale, correlation and what is left of it at the mode, `(P,)` each."""
    n = len(posterior.space)
    residual = posterior.residual(normal.mode[:, None])[..., 0]
    left = (residual[1:] * residual[:-1]).sum(0) / residual.square().sum(0).clamp(min=1e-300)
    noise = normal.mode[:, n:]
    return noise[:, -1].exp(), noise[:, 0].tanh(), left
