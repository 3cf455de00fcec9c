"""Whether what a method drives is safe and smooth, besides being close to the driver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.result import Array
from cfx.parameters import ParameterSpace

HARD_BRAKING = -8.0
"""m/s2: an acceleration below it is hard braking. On a dry road a passenger car's tyres give little more."""

NEAR_BOUND = 0.01
"""A value is at a bound within this share of the parameter's range."""


@dataclass(frozen=True)
class Safety:
    """What P closed loops did on the counted frames.

    Attributes:
        collided: `(P,)` bool, the gap became negative.
        hard_braking: `(P,)`, frames with an acceleration below `HARD_BRAKING`.
        rms_jerk: `(P,)`, m/s3; NaN for a pair of a single frame.
        at_bounds: `(P,)`, share of the tuned parameters' values that lie at a bound.
    """

    collided: Array
    hard_braking: Array
    rms_jerk: Array
    at_bounds: Array

    @classmethod
    def of(cls, loop: ClosedLoop, space: ParameterSpace, dt: float) -> Safety:
        """Measures closed loops whose time step is `dt`, s."""
        counted = loop.counted
        unit = space.to_unit(loop.parameters)
        at_bounds = ((unit <= NEAR_BOUND) | (unit >= 1 - NEAR_BOUND)).double().mean(-1)
        return cls(
            collided=_array(((loop.gap < 0) & counted).any(1)),
            hard_braking=_array(hard_braking(loop.speed, counted, dt)),
            rms_jerk=rms_jerk(loop.speed, counted, dt),
            at_bounds=_array(torch.where(counted, at_bounds, 0.0).sum(1) / counted.sum(1)),
        )


def hard_braking(speed: Tensor, counted: Tensor, dt: float) -> Tensor:
    """Counts frames with an acceleration below `HARD_BRAKING`.

    Args:
        speed: `(*batch, K + 1)`, m/s.
        counted: bool, broadcasting to it; the acceleration at a frame is the one on the way to it, so frame 0 has none.
        dt: time step, s.

    Returns:
        `(*batch,)`.
    """
    return ((speed.diff(dim=-1) / dt < HARD_BRAKING) & counted[..., 1:]).sum(-1)


def rms_jerk(speed: Tensor, counted: Tensor, dt: float) -> Array:
    """Returns the root mean square jerk `(P,)`, m/s3, of speeds `(P, K + 1)`; NaN where fewer than two frames count.

    The jerk is the difference of successive accelerations over the time step. The last acceleration before the simulation takes
    over is the driver's own and does not count: the jump from it is nobody's.
    """
    jerk = speed.diff(n=2, dim=-1) / dt**2
    of_both = counted[:, 2:] & counted[:, 1:-1]
    return _array((torch.where(of_both, jerk, 0.0).square().sum(1) / of_both.sum(1)).sqrt())


def _array(values: Tensor) -> Array:
    return np.asarray(values.double().cpu().numpy())
