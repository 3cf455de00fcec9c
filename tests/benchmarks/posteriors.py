"""What docs/how-to/uncertainty.md says of `calibration.posterior`: coverage, ranks, I-80, time.

python -m tests.benchmarks.posteriors coverage|recording|forecasts|chains krauss|idm|w99
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import emcee
import numpy as np
import torch
from scipy.stats import chisquare
from scoringrules import crps_ensemble
from torch import Tensor

from cfx.calibration.levels import DETERMINED
from cfx.calibration.optimizers.random import RandomSearch
from cfx.calibration.settings import CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Segments
from cfx_posteriors.density import Posterior
from cfx_posteriors.importance import DRAWS, sample
from cfx_posteriors.intervals import LaplaceMethod, posterior_of
from cfx_posteriors.laplace import laplace, likely_starts
from cfx_posteriors.population import fit_population
from tests.posteriors.recordings import draw_recordings

I80 = "../shared/data/i80_reconstructed_pairs.parquet"
SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)
CLASSES = 10


MODELS: dict[str, DrivingModel] = {"krauss": Krauss(), "idm": IDM(), "w99": W99()}
DRIVERS = {"krauss": 1000, "idm": 300, "w99": 100}
WALKERS, CHAIN = 40, 4000
FRAMES, AFTER_S = 600, (1, 5, 10, 30)
AHEAD_S = (1, 2, 3, 5, 10)
AFTER = ", ".join(map(str, AFTER_S))


def coverage(name: str) -> Iterator[str]:
    """Yields coverage of 90 % intervals and ranks of the truth, of synthetic drivers of 60 s.

    Intervals are of parameters, and of the signal up to 30 s after the recording has ended.
    """
    model, drivers = MODELS[name], DRIVERS[name]
    signals: tuple[Literal["speed", "gap"], ...] = ("speed", "gap")
    for signal in signals:
        drawn = draw_recordings(
            model, drivers, frames=FRAMES + 10 * max(AFTER_S), signal=signal, seed=11
        )
        posterior = first_steps(drawn.posterior, FRAMES)
        started = time.process_time()
        normal = laplace(posterior, likely_starts(posterior, seed=0))
        found = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
        seconds = time.process_time() - started
        n = len(posterior.space)
        ranks = (drawn.truth[:, None, :n] > found.quantiles).sum(1)
        held = ((ranks > 0) & (ranks < 19)).double()
        ahead = forecast_held(drawn.posterior, found.draws).double()
        good = found.reliable
        counts = torch.stack([torch.histc(r.double(), CLASSES, 0, 20) for r in ranks[good].T])
        said = [f"{type(model).__name__} {signal}: {drivers} drivers, {seconds:.0f} CPU s"]
        said.append(f"reliable {float(good.double().mean()):.0%}")
        said.append(f"held by reliable {float(held[good].mean()):.1%}")
        said.append(f"each parameter {shares(held[good])}")
        said.append(f"{signal} after {AFTER} s {shares(ahead[good])}")
        if not bool(good.all()):
            said.append(f"by others {float(held[~good].mean()):.1%}, {shares(ahead[~good])}")
        said.append("ranks, all parameters: " + " ".join(f"{c:.0f}" for c in counts.sum(0)))
        least = min(float(chisquare(one).pvalue) for one in counts.numpy())
        yield ", ".join([*said, f"least p of uniform ranks, of {n} parameters: {least:.3f}"])


def shares(held: Tensor) -> str:
    """Returns the shares of rows in which each column of `(P, n)` is held."""
    return " ".join(f"{float(share):.0%}" for share in held.mean(0))


def first_steps(posterior: Posterior, frames: int) -> Posterior:
    """Returns the posterior on the first frames of recordings."""
    whole = posterior.segments
    signals = [values[: frames - 1] if values.dim() == 2 else values for values in whole.segments]
    return replace(posterior, segments=replace(whole, segments=Segments(*signals)))


def forecast_held(posterior: Posterior, draws: Tensor) -> Tensor:
    """Returns whether 90 % of a forecast's paths hold what happened, bool `(P, len(AFTER_S))`.

    Each draw drives on from the recording's start, and its noise from its last error.

    Args:
        posterior: of whole recordings, with noise of order 1, a step of it each second.
        draws: from the posteriors on the first `FRAMES` frames, `(P, q, d)`.
    """
    errors = posterior.errors(draws[..., : len(posterior.space)])
    correlation, scale = draws[..., -2].tanh(), draws[..., -1].exp()
    generator = torch.Generator().manual_seed(0)
    last = (FRAMES - 1) // posterior.stride - 1
    expected, held = errors[last], []
    for step in range(1, max(AFTER_S) + 1):
        noise = torch.randn(scale.shape, generator=generator, dtype=torch.float64)
        expected = correlation * expected + scale * noise
        if step in AFTER_S:
            # Measured is simulated minus the error.
            rank = (expected < errors[last + step]).double().mean(1)
            held.append((rank > 0.05) & (rank < 0.95))
    return torch.stack(held, dim=1)


def recording(name: str) -> Iterator[str]:
    """Yields what the first seconds of I-80's pairs of 70 s say, and the time for all pairs."""
    settings = CalibrationSettings(posterior="laplace")
    model = MODELS[name]
    for least, seconds in ((700, 15), (700, 30), (700, 60), (700, None), (0, None)):
        pairs = TidyDataset(path=I80, min_frames=max(least, 2)).load()
        batch = PairBatch.of(pairs, dtype=torch.float64)
        last = batch.lengths - 1
        if seconds is not None:
            last = last.clamp(max=round(seconds / batch.dt))
        solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
        best = model.space.defaults().double().expand(len(batch), -1)
        started = time.process_time()
        found = LaplaceMethod().find(solver, batch, last, best, settings)
        spent = time.process_time() - started
        rows = []
        for column, parameter in enumerate(found.names):
            known = float((found.contraction[:, column] >= DETERMINED).double().mean())
            low = float(found.low[:, column].median())
            high = float(found.high[:, column].median())
            rows.append(f"{parameter} {known:.0%} ({low:.2g} to {high:.2g})")
        reliable = float((found.pareto_k <= 0.7).double().mean())
        yield (
            f"{type(model).__name__}, {len(batch)} pairs, {seconds or 'all'} s, reliable"
            f" {reliable:.0%}, {spent:.1f} CPU s: {', '.join(rows)}"
        )


def chains(name: str) -> Iterator[str]:
    """Yields how far intervals of ten I-80 drivers are from those of long chains, and the time.

    The chains are emcee's (affine-invariant ensembles, Goodman and Weare 2010), a driver at a time.
    """
    model = MODELS[name]
    pairs = TidyDataset(path=I80, min_frames=700, max_pairs=10).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
    settings = CalibrationSettings(posterior="laplace")
    posterior = posterior_of(solver, batch, batch.lengths - 1, settings)
    n, d = len(posterior.space), posterior.dimensions
    started = time.process_time()
    normal = laplace(posterior, likely_starts(posterior, seed=0))
    found = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
    ours = time.process_time() - started
    draw = np.random.default_rng(0)
    apart, effective, theirs = [], [], 0.0
    for driver in range(len(batch)):
        one = posterior.take(torch.tensor([driver]))

        def density(place: np.ndarray, one: Posterior = one) -> np.ndarray:
            return np.nan_to_num(one(torch.from_numpy(place)[None])[0].numpy(), nan=-np.inf)

        start = normal.mode[driver].numpy() + 0.1 * draw.standard_normal((WALKERS, d))
        started = time.process_time()
        sampler = emcee.EnsembleSampler(WALKERS, d, density, vectorize=True)
        sampler.random_state = np.random.RandomState(driver).get_state()
        sampler.run_mcmc(start, CHAIN)
        theirs += time.process_time() - started
        values = sampler.get_chain(discard=CHAIN // 4, flat=True)[:, :n]
        slowest = float(np.max(sampler.get_autocorr_time(discard=CHAIN // 4, quiet=True)[:n]))
        effective.append(len(values) / slowest)
        ends = np.quantile(values, SHARES[[0, 9, 18]], axis=0)
        off = found.quantiles[driver, [0, 9, 18]].numpy() - ends
        apart.append(np.abs(off) / values.std(axis=0))
    mean, worst = np.mean(apart), np.max(apart)
    yield (
        f"{type(model).__name__}: 5, 50 and 95 % of {len(batch)} drivers' {n} parameters are"
        f" {mean:.2f} deviations apart in the mean, {worst:.2f} at most; effective samples:"
        f" {float(found.effective.median()):.0f} in {ours:.1f} CPU s for all drivers, emcee"
        f" {np.median(effective):.0f} in {theirs:.1f} CPU s, a driver at a time"
    )


def forecasts(name: str) -> Iterator[str]:
    """Yields scores of forecasts of speed from each second of the last fifth of I-80's pairs.

    Parameters and noise are of the first four fifths: draws from posteriors, or the likeliest ones.
    A path drives on from the recording's start, and its noise from the last error.
    """
    model = MODELS[name]
    pairs = TidyDataset(path=I80, min_frames=700).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
    settings = CalibrationSettings(posterior="laplace")
    last = batch.lengths - 1
    known = (0.8 * last).long()
    alone = posterior_of(solver, batch, known, settings)
    starts = likely_starts(alone, seed=0)
    normal = laplace(alone, starts)
    _, within, pooled = fit_population(alone, starts)
    drawn = {
        "likeliest": normal.mode[:, None].expand(-1, DRAWS, -1),
        "posterior": sample(alone, normal, SHARES, seed=0, memory=1 << 30).draws,
        "likeliest within the population": pooled.mode[:, None].expand(-1, DRAWS, -1),
        "posterior within the population": sample(
            within, pooled, SHARES, seed=0, memory=1 << 30
        ).draws,
    }
    whole = posterior_of(solver, batch, last, settings)
    for label, draws in drawn.items():
        errors = whole.errors(draws[..., : len(model.space)])
        crps, held = forecast_scores(errors, draws, known // whole.stride, last // whole.stride)
        said = [f"{one:.3f} m/s {share:.0%}" for one, share in zip(crps, held, strict=True)]
        yield f"{type(model).__name__}, {label}, after {AHEAD_S} s: {', '.join(said)}"


def forecast_scores(
    errors: Tensor, draws: Tensor, known: Tensor, last: Tensor
) -> tuple[list[float], list[float]]:
    """Returns CRPS and coverage of 90 % after each of `AHEAD_S`, means over drivers' means.

    Args:
        errors: of whole recordings, a step each second, `(K, P, q)`.
        draws: their coordinates, with noise of order 1, `(P, q, d)`.
        known, last: the first step to forecast from, and the last step that was recorded, `(P,)`.
    """
    correlation, scale = draws[..., -2].tanh(), draws[..., -1].exp()
    generator = torch.Generator().manual_seed(0)
    rows: dict[int, list[Tensor]] = {seconds: [] for seconds in AHEAD_S}
    for origin in range(int(known.min()), len(errors) - 1):
        expected = errors[origin - 1]
        for step in range(1, max(AHEAD_S) + 1):
            noise = torch.randn(scale.shape, generator=generator, dtype=torch.float64)
            expected = correlation * expected + scale * noise
            if step not in AHEAD_S or origin - 1 + step >= len(errors):
                continue
            off = errors[origin - 1 + step] - expected
            score = crps_ensemble(
                np.zeros(len(off)), off.numpy(), estimator="fair", backend="numpy"
            )
            rank = (off < 0).double().mean(1)
            counts = (origin >= known) & (origin + step <= last)
            found = torch.stack([torch.as_tensor(score), (rank > 0.05) & (rank < 0.95)])
            rows[step].append(torch.where(counts, found, torch.nan))
    means = [torch.stack(found).nanmean(0).nanmean(1).tolist() for found in rows.values()]
    return [crps for crps, _ in means], [held for _, held in means]


if __name__ == "__main__":
    torch.set_num_threads(1)
    programs = {
        "coverage": coverage,
        "recording": recording,
        "forecasts": forecasts,
        "chains": chains,
    }
    for line in programs[sys.argv[1]](sys.argv[2]):
        print(line, flush=True)
