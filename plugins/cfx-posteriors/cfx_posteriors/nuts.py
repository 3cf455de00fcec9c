"""Chains that follow the density's slope: blackjax's No-U-Turn sampler, all drivers in step.

A step of all chains of all drivers is one simulation: every chain takes it with those whose trees
have not turned back yet, and the density is a call from JAX into the compiled kernel. Slopes are
differences, which any model has; a sampler of this kind needs none that are exact, since its steps
can be turned around and keep volumes with any force that the place alone determines. Chains run,
and start, in coordinates in which the weighted samples (`importance`) are about standard normal:
what is left to learn is the length of a step. The scale of the noise is no coordinate of theirs:
its distribution given the others is known, and without it densities fall less steeply.

M. D. Hoffman and A. Gelman (2014), *The No-U-Turn sampler*, Journal of Machine Learning Research
15.

Shapes: P drivers, C chains, n tuned parameters, d coordinates, e = d - 1 without the noise's scale.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from cfx.plugin import Task, threads
from cfx_posteriors.chains import Chains, chains_of
from cfx_posteriors.density import Posterior
from cfx_posteriors.importance import Sampled

# JAX brings absl, whose handler of logging keeps the standard error of its import, and closes it
# as logging is configured anew, unless it is the process's own.
with contextlib.redirect_stderr(sys.__stderr__):
    import blackjax
    import jax
    import jax.numpy as jnp
    from blackjax.adaptation.step_size import (
        DualAveragingAdaptationState,
        dual_averaging_adaptation,
    )
    from blackjax.mcmc.hmc import HMCState
    from blackjax.mcmc.nuts import NUTSInfo

CHAINS = 8
WARM_UP, DRAWS = 100, 250
"""Draws of each chain: those that find coordinates and the length of a step, and those kept. All
chains of a driver learn one length, and most of the time goes into calls of the kernel, not into
chains. Four I-80 drivers of IDM, errors of speed: 20 CPU s, R-hat at most 1.020, effective sizes of
201 to 574 (median 333); four chains of 200 and 500 draws, with trees of up to 31 steps: 63 s,
1.012, 278 to 489 (401)."""

_AT_ONCE = 25
"""Draws between which Python may be interrupted."""

_QUICKLY = {"xla_backend_optimization_level": 0}
"""Compiles in 3 instead of 6 s; what JAX has to do beside the simulations is little."""

_FIRST_LENGTH = 0.5
"""Of a step, in standard deviations."""

_ACCEPTED = 0.8
"""Acceptance that the length of a step aims at."""

_DOUBLINGS = 4
"""Of a tree, at most: 15 steps. In coordinates in which the posterior is about standard normal
longer trees bring little, and every chain of every driver waits for the longest. With 31 the same
drivers take 34 instead of 20 CPU s for effective sizes of 351 instead of 333 in the median; with 7
R-hat came to 1.09 (four chains)."""

_SHARES = (0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99)
"""Of samples, at which a coordinate is that of a normal distribution."""

_FAR = 6.0
"""Deviations to which a coordinate is a line from the outermost two of these on."""

_LEAST_RISE = 0.02
"""Of a coordinate for each of its normal scores, in standard deviations."""


class _Walk(NamedTuple):
    """Where chains stand, `(P, C, ...)`, and what is known of the length of a step, `(P,)`."""

    state: HMCState
    length: DualAveragingAdaptationState


class _Step(NamedTuple):
    """One draw of each chain, `(P, C, ...)`."""

    place: jax.Array | NDArray[np.float64]
    diverges: jax.Array | NDArray[np.bool_]


class _Coordinates:
    """Coordinates in which samples are about standard normal: a Gaussian copula of them.

    A posterior may end like a wall, as that of a desired speed does at the highest speed that was
    driven. Where a coordinate alone is normal it does not, and steps may be longer.
    """

    def __init__(self, sampled: Tensor) -> None:
        """Takes quantiles and correlations of samples `(P, N, e)`."""
        count = sampled.shape[1]
        score = torch.special.ndtri((torch.arange(count, dtype=torch.float64) + 0.5) / count)
        order = sampled.argsort(dim=1).argsort(dim=1)
        identity = torch.eye(sampled.shape[2], dtype=torch.float64)
        scores = score[order]
        self.factor = torch.linalg.cholesky(scores.mT @ scores / count + 1e-3 * identity)

        shares = torch.tensor(_SHARES, dtype=torch.float64)
        inside = torch.special.ndtri(shares)
        deviation = sampled.std(dim=1).clamp(min=1e-9)
        quantiles = sampled.quantile(shares, dim=1)
        # Samples may be the same, and a coordinate has to rise all the same.
        quantiles = quantiles + _LEAST_RISE * inside[:, None, None] * deviation
        low = (quantiles[1] - quantiles[0]) / (inside[1] - inside[0])
        high = (quantiles[-1] - quantiles[-2]) / (inside[-1] - inside[-2])
        far = (
            [quantiles[0] - (_FAR + inside[0]) * low],
            [quantiles[-1] + (_FAR - inside[-1]) * high],
        )
        places = torch.stack([*far[0], *quantiles, *far[1]])
        self.knots = torch.cat([inside.new_tensor([-_FAR]), inside, inside.new_tensor([_FAR])])
        cubic = PchipInterpolator(self.knots.numpy(), places.numpy())
        self.cubic = torch.from_numpy(cubic.c).permute(2, 0, 3, 1)

    def relearned(self, sampled: Tensor, seen: Tensor) -> _Coordinates:
        """Returns coordinates of samples `(P, N, e)` and of what chains saw in these `(P, M, e)`.

        Chains find tails that weighted samples have missed.
        """
        places, *_ = self.outer(seen)
        return _Coordinates(torch.cat([sampled, places], dim=1))

    def outer(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns places in these coordinates `(P, q, e)` as the posterior has them.

        Two derivatives by the normal scores of each coordinate come with them.
        """
        scores = places @ self.factor.mT
        between = torch.bucketize(scores, self.knots[1:-1])
        away = scores - self.knots[between]
        cubic = self.cubic[..., None, :, :].expand(-1, -1, scores.shape[1], -1, -1)
        number = between[:, None, ..., None].expand(-1, 4, -1, -1, 1)
        c3, c2, c1, c0 = cubic.gather(-1, number)[..., 0].unbind(1)
        place = ((c3 * away + c2) * away + c1) * away + c0
        return place, (3.0 * c3 * away + 2.0 * c2) * away + c1, 6.0 * c3 * away + 2.0 * c2

    def density(self, posterior: Posterior, places: Tensor, drivers: Tensor) -> Tensor:
        """Returns log density and slope `(S, q, 1 + e)` of some drivers.

        Args:
            posterior: of these drivers.
            places: of all drivers, in these coordinates, `(P, q, e)`.
            drivers: numbers of these, `(S,)`.
        """
        place, rate, bend = (values[drivers] for values in self.outer(places))
        value, slope = posterior.with_slope(place)
        slope = (slope * rate + bend / rate) @ self.factor[drivers]
        value = value + rate.log().sum(-1)
        return torch.cat([value[..., None], slope], dim=-1).nan_to_num()


class _Density:
    """The log density and its slope, as JAX calls them.

    It calls from a thread of its own, in which values of 64 bits would become such of 32: they come
    and go as two halves.
    """

    def __init__(self, posterior: Posterior, coordinates: _Coordinates) -> None:
        self.posterior = posterior
        drivers, e = posterior.segments.problems, posterior.dimensions - 1
        self.last = torch.empty((drivers, CHAINS, e), dtype=torch.float64)
        self.change(coordinates)
        self.answer = torch.zeros((drivers, CHAINS, 1 + e), dtype=torch.float64)
        self.driving, self.part = torch.arange(drivers), posterior

    def change(self, coordinates: _Coordinates) -> None:
        """Takes other coordinates, in which nothing has been asked for yet."""
        self.coordinates = coordinates
        self.last.fill_(torch.nan)

    def __call__(self, halves: jax.Array) -> NDArray[np.uint32]:
        """Returns log density and slope `(P, C, 1 + e)` at places `(P, C, e)`.

        A driver all of whose trees are finished asks for the same places again, while others go on:
        they are not simulated.
        """
        places = torch.from_numpy(np.array(halves).view(np.float64)[..., 0])
        moved = (places != self.last).flatten(1).any(1).nonzero()[:, 0]
        if len(moved):
            if not torch.equal(moved, self.driving):
                self.driving, self.part = moved, self.posterior.take(moved)
            # Threads are counted for each thread that calls PyTorch, and this is JAX's.
            with threads.one_thread():
                self.answer[moved] = self.coordinates.density(self.part, places, moved)
            self.last.copy_(places)
        return self.answer.numpy()[..., None].view(np.uint32)

    def of_chain(self, place: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the log density and its slope at the place of one chain `(e,)`, for JAX."""
        like = jax.ShapeDtypeStruct((1 + len(place), 2), jnp.uint32)  # type: ignore[no-untyped-call]  # it has no types
        halves = jax.lax.bitcast_convert_type(place, jnp.uint32)
        answer = jax.pure_callback(self, like, halves, vmap_method="broadcast_all")
        both = jax.lax.bitcast_convert_type(answer, jnp.float64)
        return both[0], both[1:]


def walk(
    posterior: Posterior, sampled: Sampled, shares: Tensor, *, seed: int, memory: int
) -> Chains:
    """Returns chains of each driver's posterior.

    Args:
        posterior: of P drivers.
        sampled: samples of it, which chains start from.
        shares: of the quantiles, within (0, 1).
        seed: the same seed gives the same chains.
        memory: bound in bytes for the drivers that are worked on at once.
    """
    n, d = len(posterior.space), posterior.dimensions
    kept = 4 * CHAINS * DRAWS * (d + 4) * torch.float64.itemsize
    at_once = max(CHAINS * (n + 1), DRAWS)
    size = max(1, memory // (at_once * posterior.bytes_per_candidate + kept))
    places, diverges = [], []
    for drivers in torch.split(torch.arange(len(sampled.draws)), size):
        walked = _walked(posterior.take(drivers), sampled.draws[drivers], seed)
        places.append(walked[0])
        diverges.append(walked[1])
    chains = chains_of(torch.cat(places), n, shares)
    divergences = torch.cat(diverges).double().mean((1, 2))
    return chains._replace(diagnostics={**chains.diagnostics, "divergences": divergences})


def _walked(posterior: Posterior, sampled: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Returns draws `(P, CHAINS, DRAWS, d)`, and whether their trees diverged.

    Args:
        posterior: of P drivers.
        sampled: equally likely samples of it, `(P, N, d)`.
        seed: of the chains.
    """
    sampled = sampled[..., :-1]
    density = _Density(posterior, _Coordinates(sampled))
    generator = torch.Generator().manual_seed(seed)
    shape = (len(sampled), CHAINS, sampled.shape[2])
    starts = torch.randn(shape, generator=generator, dtype=torch.float64).numpy()
    key = jax.random.key(seed)
    half, learning, every = (
        draws // _AT_ONCE for draws in (WARM_UP // 2, WARM_UP, WARM_UP + DRAWS)
    )
    steps_of_parts: list[_Step] = []
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        begin, go_on = _sampler(density)
        now = begin(starts)
        title = f"Sampling {CHAINS} chains of each of {shape[0]} drivers"
        with Task(title, every * _AT_ONCE) as task:
            for number in range(every):
                if number == half:
                    seen = torch.tensor(steps_of_parts[-1].place).flatten(1, 2)
                    density.change(density.coordinates.relearned(sampled, seen))
                    now = begin(starts)
                folded = jax.random.fold_in(key, number)
                keys = jax.random.split(folded, (shape[0], _AT_ONCE, CHAINS))
                now, steps = go_on(keys, now, number < learning)
                steps_of_parts.append(_Step(*map(np.asarray, steps)))
                task.advance(_AT_ONCE)
    coordinates = density.coordinates
    # Draws come before chains.
    places, diverges = (
        torch.from_numpy(np.concatenate(values, axis=1)).transpose(1, 2)
        for values in zip(*steps_of_parts[learning:], strict=True)
    )
    outer, *_ = coordinates.outer(places.flatten(1, 2))
    drawn = []
    for chain in torch.split(outer, DRAWS, dim=1):
        drawn.append(torch.cat([chain, posterior.draw_scales(chain, generator)], dim=-1))
    return torch.stack(drawn, dim=1), diverges


def _sampler(density: _Density) -> tuple[Callable[..., _Walk], Callable[..., tuple[_Walk, _Step]]]:
    """Returns what begins walks of all drivers, and what goes on with them."""

    @jax.custom_vjp
    def log_density(place: jax.Array) -> jax.Array:
        return density.of_chain(place)[0]

    log_density.defvjp(density.of_chain, lambda slope, weight: (weight * slope,))
    kernel = blackjax.nuts.build_kernel()
    first, learned, _ = dual_averaging_adaptation(_ACCEPTED)

    def begin(starts: jax.Array) -> _Walk:
        state = jax.vmap(lambda start: blackjax.nuts.init(start, log_density))(starts)
        # All of one type from the beginning on, so that JAX compiles once.
        length = jax.tree.map(lambda value: jnp.asarray(value, jnp.float64), first(_FIRST_LENGTH))
        return _Walk(state, length)

    def go_on(keys: jax.Array, walk: _Walk, learning: jax.Array) -> tuple[_Walk, _Step]:
        identity = jnp.eye(walk.state.position.shape[-1])

        def step(walk: _Walk, keys: jax.Array) -> tuple[_Walk, _Step]:
            adapted = walk.length
            length = jnp.exp(jnp.where(learning, adapted.log_step_size, adapted.log_step_size_avg))

            def of_chain(key: jax.Array, state: HMCState) -> tuple[HMCState, NUTSInfo]:
                drawn: tuple[HMCState, NUTSInfo] = kernel(
                    key, state, log_density, length, identity, _DOUBLINGS
                )
                return drawn

            state, said = jax.vmap(of_chain)(keys, walk.state)
            more = learned(adapted, said.acceptance_rate.mean())
            kept = jax.tree.map(lambda new, old: jnp.where(learning, new, old), more, adapted)
            return _Walk(state, kept), _Step(state.position, said.is_divergent)

        walked: tuple[_Walk, _Step] = jax.lax.scan(step, walk, keys)
        return walked

    compiled = functools.partial(jax.jit, compiler_options=_QUICKLY)
    return compiled(jax.vmap(begin)), compiled(jax.vmap(go_on, in_axes=(0, 0, None)))
