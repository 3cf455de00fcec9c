"""Flow and density of trajectories by Edie's definitions.

In a region of space and time the density is the time that vehicles spend in it, and the flow the
distance that they travel in it, each over the region's area (L. C. Edie, 1963, *Discussion of
traffic stream measurements and definitions*, 2nd International Symposium on the Theory of Traffic
Flow). Their ratio is the speed.

Of recordings only pairs are known: the region is the strip between a leader and its follower, front
bumper to front bumper, for some seconds. One vehicle drives in it, the follower. So the density is
the duration over the area, `1 / mean spacing`, and the flow the follower's way over the area. A
simulated road is cut into the same strips, so that both are measured alike.

Shapes: P pairs, T frames, S strips.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

STRIP_S = 10.0
"""Length of a strip, s."""

PER_KM, PER_HOUR = 1000.0, 3600.0


class Strips(NamedTuple):
    """S strips between leaders and followers, `(S,)` each.

    Attributes:
        pair: which of the P pairs each is of.
        density: vehicles/km.
        flow: vehicles/h.
        speed_std: standard deviation of the follower's speed in it, m/s.
    """

    pair: Tensor
    density: Tensor
    flow: Tensor
    speed_std: Tensor


def strips_of(spacing: Tensor, speed: Tensor, counted: Tensor, dt: float) -> Strips:
    """Cuts pairs into strips of `STRIP_S`; what is left at the end of a pair is left out.

    Args:
        spacing: front bumper to front bumper, `(P, T)`, m.
        speed: of the followers, `(P, T)`, m/s.
        counted: the frames there are, bool `(P, T)`.
        dt: s between frames.
    """
    frames = max(1, round(STRIP_S / dt))
    whole = spacing.shape[1] // frames
    shape = (len(spacing), whole, frames)
    spacing, speed, counted = (
        values[:, : whole * frames].reshape(shape) for values in (spacing, speed, counted)
    )
    complete = counted.all(-1) & (spacing > 0.0).all(-1)
    pair = torch.arange(shape[0], device=speed.device)[:, None].expand(-1, whole)[complete]
    spacing, speed = spacing[complete], speed[complete]
    area, way = spacing.sum(-1), speed.sum(-1)
    density, flow = frames / area * PER_KM, way / area * PER_HOUR
    # Where there is no strip, torch.std warns.
    spread = (speed - speed.mean(-1, keepdim=True)).square().mean(-1).sqrt()
    return Strips(pair, density, flow, spread)


class Region(NamedTuple):
    """A stretch of road over some time, and what is measured in it.

    Attributes:
        density: vehicles/km.
        flow: vehicles/h.
        speed: mean over space and time, m/s; NaN where nobody was.
    """

    density: float
    flow: float
    speed: float


def region(position: Tensor, speed: Tensor, begin: float, end: float) -> Region:
    """Returns Edie's density and flow on a stretch of road over all frames.

    Args:
        position, speed: `(V, T)`, m and m/s.
        begin, end: of the stretch, m.
    """
    inside = (position >= begin) & (position < end)
    time, way = float(inside.sum()), float((speed * inside).sum())
    area = (end - begin) * position.shape[1]
    mean = way / time if time > 0.0 else float("nan")
    return Region(time / area * PER_KM, way / area * PER_HOUR, mean)
