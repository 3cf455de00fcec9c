"""Segments that a rollout starts from and is compared with, and the trajectories it gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

TRANSIENT_S = 5.0
"""Length of the transient of a test part, s (`transient_s` in `data.json`).

Within some such time constant parameters lead from the measured state to a steady one of their own.
Of a policy's gain on a test part of 15 s two thirds can lie there, but a simulation that runs for
minutes sees it once.
"""


class ComponentKey(NamedTuple):
    """Key of a component's equations.

    Attributes:
        component: the class.
        settings: as JSON, without what is an input of the equations.
    """

    component: type
    settings: str


class Terms(NamedTuple):
    """What one frame adds to each sum: a pure elementwise function.

    Attributes:
        function: of simulated speed and gap, measured speed and gap.
        key: tells it from others; equal keys share compiled code.
    """

    function: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, ...]]
    key: ComponentKey | str


class Start(NamedTuple):
    """A follower's state when a rollout begins; all tensors `(*batch,)`.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        acceleration: m/s2.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor


class Trajectory(NamedTuple):
    """The result of a rollout; all tensors `(*batch, time)`, frame 0 being the start.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        gap: bumper to bumper, m; negative from a collision on.
        collided: bool, the gap is negative. A rollout continues after a collision.
            False where the gap is NaN.
    """

    position: Tensor
    speed: Tensor
    gap: Tensor
    collided: Tensor


class Segments(NamedTuple):
    """P measured segments of trajectories; signals `(K, P)`, other values `(P,)`; SI units.

    Attributes:
        leader_position, leader_speed, leader_acceleration: at frames 0 to K - 1.
        leader_rear: position of the leader's rear bumper at frames 1 to K.
        measured_speed, measured_gap: of the follower, at frames 1 to K.
        counted: 1 for each of the frames 1 to K that count, else 0.
        leader_length: m.
        position, speed, acceleration: of the follower at frame 0.
    """

    leader_position: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    leader_rear: Tensor
    measured_speed: Tensor
    measured_gap: Tensor
    counted: Tensor
    leader_length: Tensor
    position: Tensor
    speed: Tensor
    acceleration: Tensor


def common_shape(shapes: Iterable[tuple[int, ...]]) -> torch.Size:
    """Returns the shape to which all of them broadcast.

    PyTorch's own function imports its symbolic shapes for that: half a second and 40 MB.
    """
    return torch.Size(np.broadcast_shapes(*shapes))
