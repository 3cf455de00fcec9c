"""Intervals of drivers' parameters: what their recordings say, and what they leave open.

Shapes: P drivers, n tuned parameters.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.errors import ConfigError, NotInstalledError
from cfx.plugin import (
    INTERVAL_LEVEL,
    CalibrationSettings,
    DriverPosteriors,
    DrivingModel,
    MemoryStepper,
    PairBatch,
    ParameterSpace,
    PosteriorMethod,
    SegmentLosses,
    Segments,
    Solver,
    Stepper,
    distributions,
    squashed,
    threads,
)
from cfx_posteriors.chains import Chains
from cfx_posteriors.density import ParameterPrior, Posterior
from cfx_posteriors.fan import Fan, fan_of
from cfx_posteriors.importance import DRAWS, Sampled, sample
from cfx_posteriors.laplace import Normal, laplace, likely_starts, log_evidence
from cfx_posteriors.noise import NOISE_KINDS, noise_kind
from cfx_posteriors.population import Population, fit_population

if TYPE_CHECKING:
    from xarray import DataTree

    from cfx_posteriors.neural import Learned

_SHARES = (0.5 - 0.5 * INTERVAL_LEVEL, 0.5, 0.5 + 0.5 * INTERVAL_LEVEL)

NEW_DRIVERS = 1000
"""Drivers that are drawn from a prior or a population and kept."""

SAMPLES = 1000
"""Of each driver alone, from which chains of a population start and make their moves."""

_WORK = 10**8
"""Vehicle steps that belong together: enough for a compiled kernel."""


_OF_DRIVERS = (
    "noise_scale",
    "noise_correlation",
    "noise_gain",
    "noise_left",
    "effective_samples",
)


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
        noise_gain: `(P,)`, by which share the noise is the driver's: 0, one closed loop, to 1, from
            measured state to measured state.
        noise_left: `(P,)`, the same correlation of what the noise's model leaves of it; near 0
            where the model is right.
        effective_samples: `(P,)`, effective sample size that the quantiles rest on.
        diagnostics: whether the intervals are to be relied on, columns of `fits`, `(P,)` each.
        draws: parameters, `(P, draws, n)`, SI units: as correlated as a recording leaves them.
        chains: that the draws are of, one after the other; 1 where draws are independent.
        noise: which kind of noise they rest on, and its evidence.
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
    noise_gain: Tensor
    noise_left: Tensor
    effective_samples: Tensor
    diagnostics: Mapping[str, Tensor]
    draws: Tensor
    chains: int
    noise: ChosenNoise
    make_fan: Callable[[], Fan]
    origin: Population | PriorDrivers
    seed: int

    @cached_property
    def fan(self) -> Fan:
        """The fan of trajectories."""
        return self.make_fan()

    def columns(self) -> dict[str, NDArray[Any]]:
        """Returns columns for a row per driver: `median_NAME`, `noise_scale` and so on."""
        by_name: dict[str, NDArray[Any]] = {}
        for kind in ("median", "low", "high", "contraction"):
            for number, name in enumerate(self.names):
                by_name[f"{kind}_{name}"] = getattr(self, kind)[:, number].numpy()
        for kind in _OF_DRIVERS:
            by_name[kind] = getattr(self, kind).numpy()
        for kind, values in self.diagnostics.items():
            by_name[kind] = values.numpy()
        by_name["noise"] = np.full(len(self.low), self.noise.name, dtype=object)
        power = self.noise.posterior.power
        if power != 1.0:
            by_name["likelihood_power"] = np.full(len(self.low), power)
        for kind, values in self.fan.check(self.seed).items():
            by_name[kind] = values.numpy()
        return by_name

    def tables(self, ids: Sequence[str]) -> dict[str, pd.DataFrame]:
        """Returns `posterior`, draws of each driver's parameters, `prior`, `fan` and `noise`.

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
        return {
            "posterior": values,
            "fan": self.fan.table(ids),
            "noise": self.noise.table(ids),
            name: new,
        }

    def inference_data(self, ids: Sequence[str], model: DrivingModel) -> DataTree:
        # xarray is imported by those alone who ask for it.
        from cfx_posteriors.netcdf import inference_data

        fits = pd.DataFrame(self.columns(), pd.Index(ids, name="pair_id"))
        return inference_data(self.tables(ids), fits, model)

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

    def quantiles(self, shares: Tensor) -> Tensor:
        """Returns quantiles of new drivers' logits, `(len(shares), n)`."""
        return self.prior.quantiles(shares, len(self.space))

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
        with threads.one_thread():
            noise = choose_noise(solver, batch, last, best, settings)
            posterior, normal = noise.posterior, noise.normal
            origin = PriorDrivers(solver.space, posterior.prior)
            draws = self.draws_of(solver, posterior, _sampled(solver, posterior, normal))
            return _intervals(solver, batch, last, noise, (posterior, normal.mode, origin, draws))

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

        if settings.noise not in {"chosen", "trajectory"}:
            raise ConfigError(
                f"calibration.noise={settings.noise}: the network of calibration.posterior=sbi"
                " learns from closed loops with autoregressive errors; set"
                " calibration.noise=trajectory, or another posterior"
            )
        alone = settings.model_copy(update={"noise": "trajectory"})
        noise = choose_noise(solver, batch, last, best, alone)
        posterior = noise.posterior
        origin = PriorDrivers(solver.space, posterior.prior)
        learned = learn(posterior, _shares(), seed=solver.seed, memory=solver.memory)
        places = (posterior, learned.likeliest, origin, learned)
        return _intervals(solver, batch, last, noise, places)


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
        def draw(posterior: Posterior, normal: Normal) -> Tensor:
            return sample(
                posterior,
                normal,
                _shares(),
                seed=solver.seed,
                memory=solver.memory,
                draws=SAMPLES,
                apart=True,
            ).draws

        with threads.one_thread():
            noise = choose_noise(solver, batch, last, best, settings)
            population, likeliest, chains = fit_population(
                noise.posterior,
                noise.normal,
                draw,
                _shares(),
                seed=solver.seed,
                memory=solver.memory,
            )
        places = (noise.posterior, likeliest, population, chains)
        return _intervals(solver, batch, last, noise, places)


@dataclass(frozen=True)
class ChosenNoise:
    """Where noise enters a recording, and how evident that is.

    Attributes:
        posterior: with the kind of highest evidence, of all drivers together.
        normal: Laplace's approximation of it.
        evidence: log evidence of each kind that was tried, `(P,)` each.
    """

    posterior: Posterior
    normal: Normal
    evidence: Mapping[str, Tensor]

    @property
    def name(self) -> str:
        """As after `calibration.noise=`."""
        return self.posterior.kind.name

    def table(self, ids: Sequence[str]) -> pd.DataFrame:
        """Returns the table `noise`, a row for each pair and kind.

        Args:
            ids: of the pairs.
        """
        parts = []
        for name, values in self.evidence.items():
            of_kind = {"pair_id": ids, "noise": name, "log_evidence": values.numpy()}
            parts.append(pd.DataFrame({**of_kind, "chosen": name == self.name}))
        return pd.concat(parts, ignore_index=True)


def choose_noise(
    solver: Solver, batch: PairBatch, last: Tensor, best: Tensor, settings: CalibrationSettings
) -> ChosenNoise:
    """Returns posteriors with the kind of noise that `calibration.noise` names.

    Of all kinds that with the highest evidence, summed over drivers: noise is of the recording and
    of what people have in common, and one driver says too little. A simulator that cannot start
    again from a state has one closed loop alone.

    Args:
        solver, batch, last, best, settings: as of `PosteriorMethod.find`.
    """
    names: tuple[str, ...] = (settings.noise,)
    if settings.noise == "chosen":
        names = NOISE_KINDS
        if not isinstance(solver.stepper, MemoryStepper):
            names = ("trajectory",)
    candidates: list[tuple[Posterior, Normal]] = []
    evidence = {}
    for name in names:
        posterior = posterior_of(solver, batch, last, settings, name)
        normal = laplace(posterior, _starts(solver, posterior, best))
        evidence[name] = log_evidence(posterior, normal)
        candidates.append((posterior, normal))
    totals = torch.stack(list(evidence.values())).sum(1)
    posterior, normal = candidates[int(totals.argmax())]
    return ChosenNoise(posterior, normal, evidence)


def _starts(solver: Solver, posterior: Posterior, best: Tensor) -> Tensor:
    """Returns where searches start, `(P, S, s)`: the point estimates among them."""
    space = solver.space
    best = squashed(space.to_unit(best.to("cpu", torch.float64)))
    default = squashed(space.to_unit(space.defaults())).expand_as(best)
    likely = likely_starts(posterior, solver.seed)
    starts = torch.stack([best, default], dim=1)
    # A gain that is estimated starts in the middle.
    starts = torch.cat(
        [starts, starts.new_zeros((*starts.shape[:2], posterior.kind.simulated))], -1
    )
    return torch.cat([starts, likely], dim=1)


def _shares() -> Tensor:
    return torch.tensor(_SHARES, dtype=torch.float64)


def _sampled(solver: Solver, posterior: Posterior, normal: Normal) -> Sampled:
    return sample(posterior, normal, _shares(), seed=solver.seed, memory=solver.memory)


def _intervals(
    solver: Solver,
    batch: PairBatch,
    last: Tensor,
    noise: ChosenNoise,
    posteriors: tuple[Posterior, Tensor, Population | PriorDrivers, Sampled | Chains | Learned],
) -> ParameterIntervals:
    """Returns the intervals of each driver's parameters.

    Args:
        solver, batch, last: as of `PosteriorMethod.find`.
        noise: that posteriors rest on.
        posteriors: the posteriors, their likeliest coordinates `(P, d)`, where new drivers come
            from, and samples.
    """
    posterior, likeliest, origin, sampled = posteriors
    space = solver.space
    shares = _shares()
    prior = origin.quantiles(shares)
    width = (sampled.quantiles[:, 2] - sampled.quantiles[:, 0]) / (prior[2] - prior[0])
    values = space.from_unit(torch.sigmoid(sampled.quantiles))
    low, median, high = values.unbind(1)
    n = len(space)

    def make_fan() -> Fan:
        # It steps a few frames at a time: too little work in each call for compiled code.
        whole = segments_of(solver, batch, batch.lengths - 1, solver.stepper)
        return fan_of(
            replace(posterior, segments=whole),
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
        **_of_noise(posterior, likeliest),
        effective_samples=sampled.effective,
        diagnostics=sampled.diagnostics,
        draws=space.from_unit(torch.sigmoid(sampled.draws[..., :n])),
        chains=sampled.chains,
        noise=noise,
        make_fan=make_fan,
        origin=origin,
        seed=solver.seed,
    )


def posterior_of(
    solver: Solver, batch: PairBatch, last: Tensor, settings: CalibrationSettings, kind: str
) -> Posterior:
    """Returns the posterior of drivers on their recordings up to a last frame, on the CPU.

    Args:
        solver: whose model, time step and objective count.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed loop.
        settings: prior and noise.
        kind: where noise enters, as after `calibration.noise=`, but for `chosen`.
    """
    segments = segments_of(solver, batch, last, solver.stepper.for_work(_WORK))
    stride = max(1, round(settings.noise_step_s / solver.stepper.dt))
    return Posterior(
        segments,
        ParameterPrior.of(solver.space, settings.prior),
        noise_kind(kind, settings.noise_order),
        min(stride, segments.steps),
    )


def segments_of(solver: Solver, batch: PairBatch, last: Tensor, stepper: Stepper) -> SegmentLosses:
    """Returns recordings up to a last frame, on the CPU in float64.

    Args:
        solver: whose objective counts.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared.
        stepper: that simulates them.
    """
    pair = torch.arange(len(batch), device=batch.lengths.device)
    last = last.to(pair.device)
    cut = SegmentLosses.of_segments(stepper, solver.objective, batch, pair, pair * 0, last)
    measured = Segments(*(values.to("cpu", torch.float64) for values in cut.segments))
    return SegmentLosses(cut.stepper, cut.objective, measured)


def _of_noise(posterior: Posterior, likeliest: Tensor) -> dict[str, Tensor]:
    """Returns what coordinates `(P, d)` say of the noise, and what it leaves, `(P,)` each."""
    residual = posterior.residual(likeliest[:, None])[..., 0]
    left = (residual[1:] * residual[:-1]).sum(0) / residual.square().sum(0).clamp(min=1e-300)
    of_noise = likeliest[:, posterior.simulated :]
    gain = posterior.gain(likeliest[:, None])
    correlation = torch.zeros_like(left)
    if posterior.order:
        correlation = of_noise[:, 0].tanh()
    return {
        "noise_scale": of_noise[:, -1].exp(),
        "noise_correlation": correlation,
        "noise_gain": torch.zeros_like(left) if gain is None else gain[:, 0],
        "noise_left": left,
    }
