"""What docs/how-to/uncertainty.md says of `calibration.posterior`: coverage, I-80, time; ranks too.

python -m plugins.cfx-posteriors.tests.benchmarks.posteriors coverage|recording|forecasts|chains|nuts|tails|covered krauss|idm|w99
python -m plugins.cfx-posteriors.tests.benchmarks.posteriors learned|beside krauss|idm|w99
python -m plugins.cfx-posteriors.tests.benchmarks.posteriors reference idm
python -m plugins.cfx-posteriors.tests.benchmarks.posteriors sumo krauss_sumo
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal, NamedTuple, cast

import blackjax
import emcee
import jax
import jax.numpy as jnp
import numpy as np
import torch
from scipy.stats import chisquare
from scoringrules import crps_ensemble
from torch import Tensor

from cfx.calibration.random_search import RandomSearch
from cfx.calibration.settings import MAX_PARETO_K, MIN_NARROWING, MIXED, CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.core.registry import create
from cfx.data.pairs import PairBatch
from cfx.data.tidy import TidyDataset
from cfx.models.base import DrivingModel
from cfx.models.idm import CLOSEST, IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.base import Simulator
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Segments
from cfx_posteriors.chains import Chains, effective_samples
from cfx_posteriors.density import DEVIATION, Posterior
from cfx_posteriors.importance import DRAWS, Sampled, sample
from cfx_posteriors.intervals import SAMPLES, LaplaceMethod, posterior_of
from cfx_posteriors.laplace import Normal, laplace, likely_starts
from cfx_posteriors.neural import Learned, learn
from cfx_posteriors.noise import RATE, SHAPE
from cfx_posteriors.nuts import CHAINS, walk
from cfx_posteriors.population import fit_population
from cfx_posteriors.tempered import tempered

from ..recordings import draw_recordings

I80 = "../shared/data/i80_reconstructed_pairs.parquet"
SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)
CLASSES = 10


MODELS: dict[str, DrivingModel] = {"krauss": Krauss(), "idm": IDM(), "w99": W99()}
DRIVERS = {"krauss": 1000, "idm": 300, "w99": 100}
WALKERS, CHAIN = 40, 4000
COVERED = {"krauss": 60, "idm": 40, "w99": 8}
REFERENCES, REFERENCE_DRAWS = 2, 100
BESIDE, IN_SUMO = 6, 2
GROUP, SEEDS = 8, {"krauss": (20,), "idm": (20, 22), "w99": (22,)}
FRAMES, AFTER_S = 600, (1, 5, 10, 30)
AHEAD_S = (1, 2, 3, 5, 10)
NOISE = "trajectory"
"""Of all but `simulated`: what chains, networks and weighted samples are compared on."""
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
    for least, seconds in ((70, 15), (70, 30), (70, 60), (70, None), (0, None)):
        pairs = TidyDataset(path=I80, min_duration=least).load()
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
            known = float((found.contraction[:, column] >= MIN_NARROWING).double().mean())
            low = float(found.low[:, column].median())
            high = float(found.high[:, column].median())
            rows.append(f"{parameter} {known:.0%} ({low:.2g} to {high:.2g})")
        reliable = float((found.diagnostics["pareto_k"] <= MAX_PARETO_K).double().mean())
        yield (
            f"{type(model).__name__}, {len(batch)} pairs, {seconds or 'all'} s, reliable"
            f" {reliable:.0%}, {spent:.1f} CPU s: {', '.join(rows)}"
        )


def chains(name: str) -> Iterator[str]:
    """Yields how far intervals of ten I-80 drivers are from those of long chains, and the time.

    The chains are emcee's (affine-invariant ensembles, Goodman and Weare 2010), a driver at a time.
    """
    model = MODELS[name]
    pairs = TidyDataset(path=I80, min_duration=70, max_pairs=10).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
    settings = CalibrationSettings(posterior="laplace")
    posterior = posterior_of(solver, batch, batch.lengths - 1, settings, NOISE)
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


def nuts(name: str) -> Iterator[str]:
    """Yields how well chains of twenty I-80 drivers mix, and how far weighted samples are off."""
    posterior = recorded(name, 20)
    started, began = time.process_time(), time.perf_counter()
    normal = laplace(posterior, likely_starts(posterior, seed=0))
    weighted = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
    before = time.process_time() - started
    found = walk(posterior, weighted, SHARES, seed=0, memory=1 << 30)
    spent, passed = time.process_time() - started, time.perf_counter() - began
    n, ends = len(posterior.space), [0, 9, 18]
    off = apart(found, weighted.quantiles[:, ends], n)
    normal_ends = torch.special.ndtri(SHARES[ends])[:, None]
    deviation = normal.covariance.diagonal(dim1=1, dim2=2)[:, None, :n].sqrt()
    of_normal = apart(found, normal.mode[:, None, :n] + normal_ends * deviation, n)
    effective = found.effective.sort().values
    yield (
        f"{type(MODELS[name]).__name__}: {len(effective)} drivers, {spent:.0f} CPU s (weighted"
        f" samples {before:.1f}), {passed:.0f} s; effective samples: least"
        f" {float(effective[0]):.0f}, then {', '.join(f'{float(e):.0f}' for e in effective[1:4])},"
        f" median {float(effective.median()):.0f}; above 400: {int((effective > 400).sum())};"
        f" R-hat at most {float(found.diagnostics['r_hat'].max()):.3f}, median {float(found.diagnostics['r_hat'].median()):.3f};"
        f" divergent {float(found.diagnostics['divergences'].mean()):.2%}, at most"
        f" {float(found.diagnostics['divergences'].max()):.1%}; 5, 50 and 95 % apart from weighted samples"
        f" {float(off.mean()):.2f} deviations in the mean, {float(off.max()):.2f} at most; from"
        f" Laplace's approximation alone {float(of_normal.mean()):.2f}, {float(of_normal.max()):.1f};"
        f" effective samples of all drivers in a CPU second {float(effective.sum()) / spent:.1f}"
    )


def tails(name: str) -> Iterator[str]:
    """Yields how far the bounds of eight I-80 drivers are from those of many tempered samples."""
    posterior = recorded(name, 8)
    n = len(posterior.space)
    many = torch.cat([tempered(posterior, seed)[..., :n] for seed in range(4)], dim=1)
    bounds = many.quantile(SHARES[[0, 18]], dim=1).transpose(0, 1)
    normal = laplace(posterior, likely_starts(posterior, seed=0))
    off = []
    for seed in range(100, 105):
        sampled = sample(posterior, normal, SHARES, seed=seed, memory=1 << 30)
        off.append((sampled.quantiles[:, [0, 18]] - bounds) / many.std(1)[:, None])
    by_driver = torch.stack(off).mean(0)
    for column, parameter in enumerate(posterior.space.names):
        low, high = by_driver[..., column].unbind(1)
        yield (
            f"{type(MODELS[name]).__name__}'s {parameter}, deviations above tempered samples' bounds:"
            f" 5 % {float(low.mean()):+.2f} ({float(low.min()):+.2f} to {float(low.max()):+.2f}),"
            f" 95 % {float(high.mean()):+.2f} ({float(high.min()):+.2f} to {float(high.max()):+.2f})"
        )


def apart(found: Chains, quantiles: Tensor, n: int) -> Tensor:
    """Returns how far 5, 50 and 95 % are from those of chains, in their deviations, `(P, 3, n)`."""
    off = (quantiles - found.quantiles[:, [0, 9, 18]]).abs()
    return off / found.draws[..., :n].std(1)[:, None]


def recorded(name: str, drivers: int) -> Posterior:
    """Returns the posterior of the first I-80 drivers of 70 s or more."""
    pairs = TidyDataset(path=I80, min_duration=70, max_pairs=drivers).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(MODELS[name], batch.dt), RandomSearch(), seed=0)
    settings = CalibrationSettings(posterior="nuts")
    return posterior_of(solver, batch, batch.lengths - 1, settings, NOISE)


def covered(name: str) -> Iterator[str]:
    """Yields how often 90 % intervals of chains hold the truth, of synthetic drivers of 60 s."""
    drawn = draw_recordings(MODELS[name], COVERED[name], frames=FRAMES, seed=12)
    normal = laplace(drawn.posterior, likely_starts(drawn.posterior, seed=0))
    weighted = sample(drawn.posterior, normal, SHARES, seed=0, memory=1 << 30)
    found = walk(drawn.posterior, weighted, SHARES, seed=0, memory=1 << 30)
    n = len(drawn.posterior.space)
    off = apart(found, weighted.quantiles[:, [0, 9, 18]], n)
    yield f"apart from weighted samples {float(off.mean()):.2f}, {float(off.max()):.2f} at most"
    for label, quantiles in (("chains", found.quantiles), ("weighted", weighted.quantiles)):
        ranks = (drawn.truth[:, None, :n] > quantiles).sum(1)
        held = ((ranks > 0) & (ranks < 19)).double()
        counts = torch.stack([torch.histc(r.double(), CLASSES // 2, 0, 20) for r in ranks.T])
        least = min(float(chisquare(one).pvalue) for one in counts.numpy())
        yield (
            f"{type(MODELS[name]).__name__}, {COVERED[name]} drivers, {label}: held"
            f" {float(held.mean()):.1%}, each parameter {shares(held)}; ranks"
            f" {' '.join(f'{c:.0f}' for c in counts.sum(0))}, least p {least:.3f}; reliable"
            f" {float((found.diagnostics['r_hat'] <= MIXED).double().mean()):.0%}, divergent"
            f" {float(found.diagnostics['divergences'].mean()):.2%}, effective {float(found.effective.median()):.0f}"
        )


class Group(NamedTuple):
    """Synthetic drivers whose posteriors a network has found: P rows each."""

    ranks: Tensor
    weighted_ranks: Tensor
    off: Tensor
    pareto_k: Tensor
    weighted_k: Tensor
    coverage: Tensor
    seconds: Tensor


def learned_group(name: str, seed: int) -> Group:
    """Returns what a network says of some drivers of 60 s, and weighted samples of the same."""
    drawn = draw_recordings(MODELS[name], GROUP, frames=FRAMES, seed=seed)
    posterior, n = drawn.posterior, len(drawn.posterior.space)
    started = time.process_time()
    found = learn(posterior, SHARES, seed=0, memory=1 << 30)
    spent = time.process_time() - started
    normal = laplace(posterior, likely_starts(posterior, seed=0))
    weighted = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
    ends = [0, 9, 18]
    off = (found.quantiles[:, ends] - weighted.quantiles[:, ends]).abs()
    truth = drawn.truth[:, None, :n]
    return Group(
        (truth > found.quantiles).sum(1),
        (truth > weighted.quantiles).sum(1),
        off / weighted.draws[..., :n].std(1)[:, None],
        found.pareto_k,
        weighted.pareto_k,
        found.coverage,
        torch.full((GROUP,), spent / GROUP),
    )


def learned(name: str) -> Iterator[str]:
    """Yields how often 90 % intervals of networks hold the truth, of groups of eight drivers."""
    groups = [learned_group(name, seed) for seed in SEEDS[name]]
    whole = Group(*(torch.cat(values) for values in zip(*groups, strict=True)))
    good, both = whole.pareto_k <= MAX_PARETO_K, torch.maximum(whole.pareto_k, whole.weighted_k)
    off = whole.off[both <= MAX_PARETO_K]
    yield (
        f"{type(MODELS[name]).__name__}: {len(good)} drivers, {float(whole.seconds.sum()):.0f} CPU"
        f" s, k below 0.7 {float(good.double().mean()):.0%} (weighted samples"
        f" {float((whole.weighted_k <= MAX_PARETO_K).double().mean()):.0%}), the networks alone hold"
        f" {float(whole.coverage.mean()):.0%} of simulated ones; apart from weighted samples where"
        f" both settle {float(off.mean()):.2f} deviations, 99 % below"
        f" {float(off.flatten().quantile(0.99)):.2f}"
    )
    for label, ranks in (("network", whole.ranks), ("weighted", whole.weighted_ranks)):
        held = ((ranks > 0) & (ranks < 19)).double()
        counts = torch.stack([torch.histc(r.double(), CLASSES // 2, 0, 20) for r in ranks.T])
        least = min(float(chisquare(one).pvalue) for one in counts.numpy())
        yield (
            f"{label}: held {float(held.mean()):.1%}, where the network's k is below 0.7"
            f" {float(held[good].mean()):.1%}, else {float(held[~good].mean()):.1%}; each parameter"
            f" {shares(held)}; ranks {' '.join(f'{c:.0f}' for c in counts.sum(0))}, least p"
            f" {least:.3f}"
        )


def beside(name: str) -> Iterator[str]:
    """Yields medians and 90 % intervals of I-80 drivers by weighted samples, network and chains."""
    posterior = recorded(name, BESIDE)
    space = posterior.space
    spent = [time.process_time()]
    normal = laplace(posterior, likely_starts(posterior, seed=0))
    weighted = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
    spent.append(time.process_time())
    network = learn(posterior, SHARES, seed=0, memory=1 << 30)
    spent.append(time.process_time())
    mixed = walk(posterior, weighted, SHARES, seed=0, memory=1 << 30)
    spent.append(time.process_time())
    for driver in range(BESIDE):
        rows = []
        for number, parameter in enumerate(space.names):
            said = []
            for found in (weighted, network, mixed):
                logits = found.quantiles[driver, [0, 9, 18]]
                low, middle, high = space.from_unit(torch.sigmoid(logits))[:, number].tolist()
                said.append(f"{middle:.3g} ({low:.3g} to {high:.3g})")
            rows.append(f"{parameter} {', '.join(said)}")
        yield f"driver {driver}, k {float(network.pareto_k[driver]):.2f}: {'; '.join(rows)}"
    ways = {"laplace": weighted, "sbi": network}
    for (label, found), first, last in zip(ways.items(), spent, spent[1:], strict=False):
        off = apart(mixed, found.quantiles[:, [0, 9, 18]], len(space))
        yield (
            f"{label}: {last - first:.0f} CPU s; from chains {float(off.mean()):.2f} deviations"
            f" apart in the mean, {float(off.max()):.2f} at most"
        )
    yield f"nuts: {spent[3] - spent[2]:.0f} CPU s, R-hat at most {float(mixed.r_hat.max()):.3f}"


def sumo(name: str) -> Iterator[str]:
    """Yields the posteriors of I-80 drivers with SUMO in the loop, beside those of equations."""
    model = cast("DrivingModel", create("model", {"name": name}))
    pairs = TidyDataset(path=I80, min_duration=70, max_pairs=IN_SUMO).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    settings = CalibrationSettings(posterior="sbi")
    simulator = cast("Simulator", create("simulator", {"name": "sumo", "workers": 1}))
    simulated = simulator.stepper(model, batch.dt)
    quantiles = {}
    ways = (("laplace", MemoryStepper(model, batch.dt)), ("sbi", simulated), ("laplace", simulated))
    for way, stepper in ways:
        solver = Solver(stepper, RandomSearch(), seed=0)
        posterior = posterior_of(solver, batch, batch.lengths - 1, settings, NOISE)
        began = time.perf_counter()
        found: Learned | Sampled
        if way == "sbi":
            found = learn(posterior, SHARES, seed=0, memory=1 << 30)
        else:
            normal = laplace(posterior, likely_starts(posterior, seed=0))
            found = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
        label = f"{way}, {type(stepper).__name__}"
        quantiles[label] = found.quantiles[:, [0, 9, 18]]
        first = next(iter(quantiles.values()))
        off = (quantiles[label] - first).abs() / (first[:, 2:] - first[:, :1])
        k = ", ".join(f"{float(one):.2f}" for one in found.pareto_k)
        yield (
            f"{label}: {time.perf_counter() - began:.0f} s, k {k}; 5, 50, 95 % from the first"
            f" {float(off.mean()):.2f} widths apart in the mean, {float(off.max()):.2f} at most"
        )
        values = model.space.from_unit(torch.sigmoid(quantiles[label]))
        for driver, of_driver in enumerate(values):
            rows = []
            for number, parameter in enumerate(model.space.names):
                low, middle, high = of_driver[:, number].tolist()
                rows.append(f"{parameter} {middle:.3g} ({low:.3g} to {high:.3g})")
            yield f"  driver {driver}: {', '.join(rows)}"
    simulated.close()


def reference(name: str) -> Iterator[str]:
    """Yields what the usual way takes: IDM and its noise in JAX, a driver at a time.

    Slopes are JAX's, chains start at the mode, step and masses are adapted (blackjax, as Stan does).
    """
    posterior = recorded(name, REFERENCES)
    space, d = posterior.space, posterior.dimensions
    mode = laplace(posterior, likely_starts(posterior, seed=0)).mode
    low, high = (bound.double().numpy() for bound in space.bounds())
    prior, limits = posterior.prior, MODELS[name].limits
    assert prior.center is not None
    assert limits is not None
    center, dt = prior.center.numpy(), posterior.segments.stepper.dt
    with jax.enable_x64(True):
        for driver in range(REFERENCES):
            one = posterior.take(torch.tensor([driver])).segments.segments
            steps = int(one.counted.sum())
            leader = np.stack([one.leader_position[:steps, 0], one.leader_speed[:steps, 0]], 1)
            measured = one.measured_speed[:steps, 0].numpy()
            length = float(one.leader_length[0])
            first = jnp.array([float(one.position[0]), float(one.speed[0])])

            def density(
                place: jax.Array,
                leader: np.ndarray = leader,
                measured: np.ndarray = measured,
                length: float = length,
                first: jax.Array = first,
            ) -> jax.Array:
                v0, t, s0, a, b = low + (high - low) * jax.nn.sigmoid(place[:5])

                def step(state: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
                    x, v = state
                    gap = jnp.maximum(seen[0] - length - x, CLOSEST)
                    wanted = v * t + v * (v - seen[1]) / (2.0 * jnp.sqrt(a * b))
                    crowding = (s0 + jnp.maximum(wanted, 0.0)) / gap
                    new = v + dt * a * (1.0 - (v / v0) ** 4 - crowding**2)
                    slowest = jnp.maximum(v - limits.emergency_deceleration * dt, 0.0)
                    new = jnp.clip(new, slowest, v + limits.acceleration * dt)
                    return jnp.array([x + new * dt, new]), new

                _, speed = jax.lax.scan(step, first, leader)
                error = (speed - measured)[posterior.stride - 1 :: posterior.stride]
                phi, scale = jnp.tanh(place[5]), place[6]
                left = error - phi * jnp.concatenate([jnp.zeros(1), error[:-1]])
                whole = -len(error) * scale - 0.5 * (left**2).sum() * jnp.exp(-2.0 * scale)
                whole += jnp.log1p(-(phi**2)) - 2.0 * SHAPE * scale - RATE * jnp.exp(-2.0 * scale)
                return whole - 0.5 * ((place[:5] - center) ** 2).sum() / DEVIATION**2

            here = jnp.asarray(mode[driver].numpy())
            ours = posterior.take(torch.tensor([driver]))(mode[driver][None, None])
            assert abs(float(density(here)) - float(ours)) < 1e-6 * abs(float(ours))
            warm = blackjax.window_adaptation(blackjax.nuts, density)

            def chain(
                key: jax.Array, here: jax.Array = here, warm: Any = warm, density: Any = density
            ) -> tuple[jax.Array, jax.Array]:
                (state, tuned), _ = warm.run(key, here, num_steps=REFERENCE_DRAWS)
                step = blackjax.nuts(density, **tuned).step

                def draw(state: Any, key: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array]]:
                    state, said = step(key, state)
                    return state, (state.position, said.num_integration_steps)

                keys = jax.random.split(jax.random.fold_in(key, 1), REFERENCE_DRAWS)
                return jax.lax.scan(draw, state, keys)[1]

            started = time.process_time()
            keys = jax.random.split(jax.random.key(driver), CHAINS)
            places, trees = jax.block_until_ready(jax.jit(jax.vmap(chain))(keys))
            spent = time.process_time() - started
            effective = effective_samples(np.asarray(places)[None])[0]
            yield (
                f"driver {driver}: {effective:.0f} effective samples of {d} coordinates in"
                f" {spent:.0f} CPU s, {effective / spent:.2f} in a CPU second, trees of"
                f" {float(trees.mean()):.0f} steps"
            )


def forecasts(name: str) -> Iterator[str]:
    """Yields scores of forecasts of speed from each second of the last fifth of I-80's pairs.

    Parameters and noise are of the first four fifths: draws from posteriors, or the likeliest ones.
    A path drives on from the recording's start, and its noise from the last error.
    """
    model = MODELS[name]
    pairs = TidyDataset(path=I80, min_duration=70).load()
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(model, batch.dt), RandomSearch(), seed=0)
    settings = CalibrationSettings(posterior="laplace")
    last = batch.lengths - 1
    known = (0.8 * last).long()
    alone = posterior_of(solver, batch, known, settings, NOISE)
    starts = likely_starts(alone, seed=0)
    normal = laplace(alone, starts)

    memory = 1 << 30

    def sampled(posterior: Posterior, normal: Normal) -> Tensor:
        return sample(
            posterior, normal, SHARES, seed=0, memory=memory, draws=SAMPLES, apart=True
        ).draws

    _, likeliest, within = fit_population(alone, normal, sampled, SHARES, seed=0, memory=memory)
    drawn = {
        "likeliest": normal.mode[:, None].expand(-1, DRAWS, -1),
        "posterior": sample(alone, normal, SHARES, seed=0, memory=1 << 30).draws,
        "likeliest within the population": likeliest[:, None].expand(-1, DRAWS, -1),
        "posterior within the population": within.draws[:, :: within.draws.shape[1] // DRAWS],
    }
    whole = posterior_of(solver, batch, last, settings, NOISE)
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
        "nuts": nuts,
        "tails": tails,
        "covered": covered,
        "learned": learned,
        "beside": beside,
        "sumo": sumo,
        "reference": reference,
    }
    for line in programs[sys.argv[1]](sys.argv[2]):
        print(line, flush=True)
