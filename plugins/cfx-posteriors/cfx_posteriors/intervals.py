"""Intervals of drivers' parameters: what their recordings say, and what they leave open.

Shapes: P drivers, n tuned parameters.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.errors import NotInstalledError
from cfx.plugin import (
    INTERVAL_LEVEL,
    CalibrationSettings,
    DriverPosteriors,
    PairBatch,
    ParameterSpace,
    PosteriorMethod,
    SegmentLosses,
    Segments,
    Solver,
    distributions,
    squashed,
)
from cfx_posteriors.density import ParameterPrior, Posterior
from cfx_posteriors.fan import Fan, fan_of
from cfx_posteriors.importance import DRAWS, Sampled, sample
from cfx_posteriors.laplace import Normal, laplace, likely_starts
from cfx_posteriors.population import Population, fit_population

if TYPE_CHECKING:
    from cfx_posteriors.neural import Learned
    from cfx_posteriors.nuts import Chains

_SHARES = (0.5 - 0.5 * INTERVAL_LEVEL, 0.5, 0.5 + 0.5 * INTERVAL_LEVEL)

NEW_DRIVERS = 1000
"""Drivers that are drawn from a prior or a population and kept."""

_WORK = 10**8
"""Vehicle steps that belong together: enough for a compiled kernel."""


_OF_DRIVERS = ("noise_scale", "noise_correlation", "noise_left", "effective_samples")


@dataclass(frozen=True)
class ParameterIntervals(DriverPosteriors):
    """What P recordings say of parameters, as intervals and draws.

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
        diagnostics: whether the intervals are to be relied on, columns of `fits`, `(P,)` each.
        draws: parameters, `(P, draws, n)`, SI units: as correlated as a recording leaves them.
        chains: that the draws are of, one after the other; 1 where draws are independent.
        make_fan: simulates the fan of trajectories.
        origin: where drivers who were not recorded come from: the population, or as the prior has
            them.
        seed: of the job.
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
    diagnostics: Mapping[str, Tensor]
    draws: Tensor
    chains: int
    make_fan: Callable[[], Fan]
    origin: Population | PriorDrivers
    seed: int

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Returns columns for a row per driver: `median_NAME`, `noise_scale` and so on."""
        found = {}
        for kind in ("median", "low", "high", "contraction"):
            for number, name in enumerate(self.names):
                found[f"{kind}_{name}"] = getattr(self, kind)[:, number].numpy()
        for kind in _OF_DRIVERS:
            found[kind] = getattr(self, kind).numpy()
        for kind, values in self.diagnostics.items():
            found[kind] = values.numpy()
        return found

    def tables(self, ids: Sequence[str]) -> dict[str, pd.DataFrame]:
        """Returns `posterior`, draws of each driver's parameters, `prior` and `fan`.

        Where a population was asked for, `population`, new drivers of it, stands for `prior`.
        """
        columns = [f"parameter_{name}" for name in self.names]
        pairs, draws, _ = self.draws.shape
        values = pd.DataFrame(self.draws.flatten(0, 1).numpy(), columns=columns)
        values.insert(0, "pair_id", np.repeat(np.asarray(ids, dtype=object), draws))
        if self.chains > 1:
            chain = np.repeat(np.arange(self.chains), draws // self.chains)
            values.insert(1, "chain", np.tile(chain, pairs))
        draw = np.tile(np.arange(draws // self.chains), pairs * self.chains)
        values.insert(len(values.columns) - len(columns), "draw", draw)
        new = pd.DataFrame(self.draw_drivers(NEW_DRIVERS, self.seed).numpy(), columns=columns)
        name = "population" if isinstance(self.origin, Population) else "prior"
        return {"posterior": values, "fan": self.make_fan().table(ids), name: new}

    def draw_drivers(self, count: int, seed: int) -> Tensor:
        return self.origin.draw(count, seed=seed)


@dataclass(frozen=True)
class PriorDrivers:
    """Drivers as the prior has them.

    Attributes:
        space: of the parameters.
        prior: of their logits.
    """

    space: ParameterSpace
    prior: ParameterPrior

    def draw(self, drivers: int, *, seed: int) -> Tensor:
        """Returns parameters of new drivers, `(drivers, n)`, SI units."""
        logits = self.prior.draw(drivers, len(self.space), seed=seed)
        return self.space.from_unit(torch.sigmoid(logits))


class LaplaceMethod(PosteriorMethod):
    """Each driver alone: Laplace's approximation, corrected by weighted samples."""

    any_simulator = True

    def find(
        self,
        solver: Solver,
        batch: PairBatch,
        last: Tensor,
        best: Tensor,
        settings: CalibrationSettings,
    ) -> ParameterIntervals:
        posterior = posterior_of(solver, batch, last, settings)
        origin = PriorDrivers(solver.space, posterior.prior)
        normal = laplace(posterior, _starts(solver, posterior, best))
        found = self.draws_of(solver, posterior, _sampled(solver, posterior, normal))
        return _intervals(solver, batch, last, settings, (posterior, normal.mode, origin, found))

    def draws_of(self, solver: Solver, posterior: Posterior, sampled: Sampled) -> Sampled | Chains:
        """Returns the draws that stand for the posterior, of weighted samples of it."""
        return sampled


class NutsMethod(LaplaceMethod):
    """Each driver alone: chains of the No-U-Turn sampler, which start from weighted samples."""

    any_simulator = False

    def draws_of(self, solver: Solver, posterior: Posterior, sampled: Sampled) -> Sampled | Chains:
        # JAX is imported by those alone who ask for chains.
        from cfx_posteriors.nuts import walk

        return walk(posterior, sampled, _shares(), seed=solver.seed, memory=solver.memory)


class SbiMethod(PosteriorMethod):
    """Each driver alone, by a network that learns from simulations.

    Raises:
        NotInstalledError: sbi is not installed.
    """

    any_simulator = True

    def __init__(self) -> None:
        if importlib.util.find_spec("sbi") is None:
            raise NotInstalledError(
                "calibration.posterior=sbi needs sbi, which is not installed; it comes with"
                f" {distributions.install_line('cfx-posteriors[sbi]')}"
            )

    def find(
        self,
        solver: Solver,
        batch: PairBatch,
        last: Tensor,
        best: Tensor,
        settings: CalibrationSettings,
    ) -> ParameterIntervals:
        # sbi takes seconds to import.
        from cfx_posteriors.neural import learn

        posterior = posterior_of(solver, batch, last, settings)
        origin = PriorDrivers(solver.space, posterior.prior)
        found = learn(posterior, _shares(), seed=solver.seed, memory=solver.memory)
        return _intervals(
            solver, batch, last, settings, (posterior, found.likeliest, origin, found)
        )


class HierarchicalMethod(PosteriorMethod):
    """Each driver as one of a population, which all drivers of the job give."""

    has_population = True
    any_simulator = True

    def find(
        self,
        solver: Solver,
        batch: PairBatch,
        last: Tensor,
        best: Tensor,
        settings: CalibrationSettings,
    ) -> ParameterIntervals:
        alone = posterior_of(solver, batch, last, settings)
        population, posterior, normal = fit_population(alone, _starts(solver, alone, best))
        sampled = _sampled(solver, posterior, normal)
        return _intervals(
            solver, batch, last, settings, (posterior, normal.mode, population, sampled)
        )


def _starts(solver: Solver, posterior: Posterior, best: Tensor) -> Tensor:
    """Returns logits at which searches start, `(P, S, n)`: the point estimates among them."""
    space = solver.space
    best = squashed(space.to_unit(best.to("cpu", torch.float64)))
    default = squashed(space.to_unit(space.defaults())).expand_as(best)
    likely = likely_starts(posterior, solver.seed)
    return torch.cat([best[:, None], default[:, None], likely], dim=1)


def _shares() -> Tensor:
    return torch.tensor(_SHARES, dtype=torch.float64)


def _sampled(solver: Solver, posterior: Posterior, normal: Normal) -> Sampled:
    return sample(posterior, normal, _shares(), seed=solver.seed, memory=solver.memory)


def _intervals(
    solver: Solver,
    batch: PairBatch,
    last: Tensor,
    settings: CalibrationSettings,
    found: tuple[Posterior, Tensor, Population | PriorDrivers, Sampled | Chains | Learned],
) -> ParameterIntervals:
    """Returns the intervals of each driver's parameters.

    Args:
        solver, batch, last, settings: as of `PosteriorMethod.find`.
        found: the posteriors, their likeliest coordinates `(P, d)`, where new drivers come from,
            and samples.
    """
    posterior, likeliest, origin, sampled = found
    space = solver.space
    shares = _shares()
    prior = posterior.prior.quantiles(shares, len(space))
    width = (sampled.quantiles[:, 2] - sampled.quantiles[:, 0]) / (prior[2] - prior[0])
    values = space.from_unit(torch.sigmoid(sampled.quantiles))
    low, median, high = values.unbind(1)
    scale, correlation, left = _noise(posterior, likeliest)

    def make_fan() -> Fan:
        whole = posterior_of(solver, batch, batch.lengths - 1, settings)
        return fan_of(
            replace(whole, stride=posterior.stride),
            last.cpu(),
            sampled.draws[:, :: sampled.draws.shape[1] // DRAWS],
            shares,
            seed=solver.seed,
            memory=solver.memory,
        )

    return ParameterIntervals(
        space.names,
        low,
        median,
        high,
        contraction=1.0 - width,
        noise_scale=scale,
        noise_correlation=correlation,
        noise_left=left,
        effective_samples=sampled.effective,
        diagnostics=sampled.diagnostics,
        draws=space.from_unit(torch.sigmoid(sampled.draws[..., : len(space)])),
        chains=sampled.chains,
        make_fan=make_fan,
        origin=origin,
        seed=solver.seed,
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
        solver.stepper.for_work(_WORK), solver.objective, batch, pair, pair * 0, last
    )
    measured = Segments(*(values.to("cpu", torch.float64) for values in cut.segments))
    stride = max(1, round(settings.noise_step_s / solver.stepper.dt))
    return Posterior(
        SegmentLosses(cut.stepper, cut.objective, measured),
        ParameterPrior.of(solver.space, settings.prior),
        settings.noise_order,
        min(stride, cut.steps),
    )


def _noise(posterior: Posterior, likeliest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns scale, correlation and what is left of it at coordinates `(P, d)`, `(P,)` each."""
    n = len(posterior.space)
    residual = posterior.residual(likeliest[:, None])[..., 0]
    left = (residual[1:] * residual[:-1]).sum(0) / residual.square().sum(0).clamp(min=1e-300)
    noise = likeliest[:, n:]
    return noise[:, -1].exp(), noise[:, 0].tanh(), left
