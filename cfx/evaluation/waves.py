"""How fast stop-and-go waves travel: from pairs of vehicles, and from whole rings.

Positive speeds are downstream. Waves of people in congestion travel upstream at 15 to 20 km/h (M.
Treiber and A. Kesting, 2013, *Traffic flow dynamics*, chapter 18).

Shapes: P pairs, T frames, V vehicles of a ring.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = [
    "LEAST_STD",
    "MOST_LAG_S",
    "PairWaves",
    "RingWaves",
    "pair_waves",
    "ring_waves",
]
"""What plugins may use, as `cfx.plugin.waves`."""

MOST_LAG_S = 8.0
"""A wave takes at most this long from a vehicle to the one behind it."""

LEAST_STD = 0.5
"""m/s: standard deviation of the speed from which on there are waves to be measured."""

_LEAST_CORRELATION = 0.5
"""Of a leader's speed and its follower's after the lag."""

_MODES = 6
"""Waves around a ring at most."""

_CANDIDATES = torch.arange(-12.0, 12.001, 0.1, dtype=torch.float64)
"""Speeds of waves that are tried, m/s."""


class PairWaves(NamedTuple):
    """How changes of speed come from leaders to their followers, `(P,)` each; NaN where none do.

    Attributes:
        way: from where the leader changes its speed to where the follower does, m; negative:
            upstream.
        lag: what passes between the two, s.
    """

    way: Tensor
    lag: Tensor

    @property
    def measured(self) -> int:
        """Pairs in which there are any."""
        return int(self.lag.isfinite().sum())

    @property
    def speed(self) -> float:
        """How fast a wave travels that passes all pairs one after the other, m/s.

        That is all ways over all lags; a mean of each pair's speed would be that of the shortest
        lags.
        """
        total = float(self.lag.nansum())
        if total == 0.0:
            return float("nan")
        return float(self.way.nansum()) / total


def pair_waves(
    leader_position: Tensor,
    leader_speed: Tensor,
    position: Tensor,
    speed: Tensor,
    counted: Tensor,
    dt: float,
) -> PairWaves:
    """Returns how changes of speed travel from leaders to their followers.

    The lag tau is the one at which the follower's speed correlates best with the leader's before
    it. A change that is at the leader's place at t is at the follower's place at t + tau, so it has
    come `x_f(t + tau) - x_l(t)`, in the mean over t. A follower that repeats what its leader did
    tau earlier and d behind (G. F. Newell, 2002, *A simplified car-following theory*,
    Transportation Research B 36) gives -d and tau.

    NaN where there is nothing to measure: speeds that hardly change, or do not correlate.

    Args:
        leader_position, leader_speed, position, speed: `(P, T)`, front bumpers; SI units.
        counted: bool `(P, T)`.
        dt: s between frames.
    """
    lags = min(round(MOST_LAG_S / dt), position.shape[1] - 2)
    if lags < 2:
        undefined = torch.full(position.shape[:1], torch.nan, dtype=torch.float64)
        return PairWaves(undefined, undefined)
    correlations, moved = [], []
    for lag in range(lags + 1):
        before, after = slice(0, position.shape[1] - lag), slice(lag, None)
        counts = counted[:, before] & counted[:, after]
        correlations.append(_correlation(leader_speed[:, before], speed[:, after], counts))
        moved.append(_mean(position[:, after] - leader_position[:, before], counts))
    correlation, distances = torch.stack(correlations, -1).double(), torch.stack(moved, -1).double()
    best = correlation.nan_to_num(-1.0).argmax(-1)
    inner = best.clamp(1, lags - 1)
    top = inner + _peak(correlation, inner)
    low = top.floor().long().clamp(0, lags - 1)
    share = top - low
    rows = torch.arange(len(best), device=best.device)
    travelled = (1.0 - share) * distances[rows, low] + share * distances[rows, low + 1]
    changes = _std(leader_speed, counted) >= LEAST_STD
    follows = (correlation[rows, best] >= _LEAST_CORRELATION) & (best == inner)
    measured = changes & follows
    return PairWaves(
        torch.where(measured, travelled, torch.nan), torch.where(measured, top * dt, torch.nan)
    )


class RingWaves(NamedTuple):
    """The waves of a ring.

    Attributes:
        speed: m/s; NaN if there are none.
        coherence: share of the variance of the speed that travels at it, in what the ring's longest
            waves explain.
    """

    speed: float
    coherence: float


def ring_waves(position: Tensor, speed: Tensor, circumference: float, interval: float) -> RingWaves:
    """Returns how fast the waves of a ring travel.

    For each candidate speed the field of speeds is stacked along lines of that slant: its Fourier
    modes around the ring, `u_m(t)`, are averaged over time after they are turned back by what a
    wave of that speed has turned them, `exp(2 pi i m c t / L)`. The candidate that leaves most
    variance wins.

    Args:
        position: `(V, T)`, m, not wrapped around the ring.
        speed: `(V, T)`, m/s.
        circumference: L, m.
        interval: s between frames.
    """
    deviation = speed - speed.mean()
    if float(deviation.square().mean().sqrt()) < LEAST_STD:
        return RingWaves(torch.nan, torch.nan)
    # Each vehicle stands for half of the ways to its neighbours.
    ahead = torch.roll(position, 1, 0)
    ahead[0] += circumference
    spacing = ahead - position
    weight = 0.5 * (spacing + torch.roll(spacing, -1, 0)) / circumference
    modes = torch.arange(1, min(_MODES, max(1, len(position) // 4)) + 1, dtype=position.dtype)
    angle = 2.0 * torch.pi / circumference * modes.to(position)
    phase = torch.polar(torch.ones_like(position)[None], -angle[:, None, None] * position)
    field = (phase * (weight * deviation)).sum(1)
    time = interval * torch.arange(position.shape[1], dtype=position.dtype, device=position.device)
    candidates = _CANDIDATES.to(position)
    turned = angle[:, None, None] * candidates[:, None] * time
    stacked = torch.polar(torch.ones_like(turned), turned) * field[:, None]
    energy = stacked.mean(-1).abs().square().sum(0)
    best = energy.argmax().clamp(1, len(candidates) - 2)
    place = _peak(energy[None], best[None])[0]
    step = candidates[1] - candidates[0]
    total = field.abs().square().mean(-1).sum()
    return RingWaves(float(candidates[best] + place * step), float(energy[best] / total))


def _peak(values: Tensor, place: Tensor) -> Tensor:
    """Returns how far from a place `(P,)` a parabola through it and its neighbours has its top."""
    rows = torch.arange(len(place), device=place.device)
    before, at_place, after = (values[rows, place + k] for k in (-1, 0, 1))
    curvature = before - 2.0 * at_place + after
    top = 0.5 * (before - after) / torch.where(curvature < 0.0, curvature, -torch.inf)
    return top.clamp(-0.5, 0.5).nan_to_num(0.0)


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    return (values * counted).sum(-1) / counted.sum(-1).clamp(min=1)


def _std(values: Tensor, counted: Tensor) -> Tensor:
    deviation = values - _mean(values, counted)[:, None]
    return _mean(deviation.square(), counted).sqrt()


def _correlation(signal: Tensor, other: Tensor, counted: Tensor) -> Tensor:
    """Returns the correlation of two signals `(P, T)`, NaN where one does not change."""
    first = signal - _mean(signal, counted)[:, None]
    second = other - _mean(other, counted)[:, None]
    scale = (_mean(first.square(), counted) * _mean(second.square(), counted)).sqrt()
    return _mean(first * second, counted) / torch.where(scale > 0.0, scale, torch.nan)
