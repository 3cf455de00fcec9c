"""What the closed loop of training carries from window to window, and what it reads of the leader.

Shapes: N networks, D trajectories of each, L frames of a token, S steps of a window, s width of the
policy's state, m of the model's memory, q numbers that a stochastic head keeps.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class LoopState(NamedTuple):
    """Where N by D trajectories stand: the follower's last L frames, the last being now.

    Attributes:
        position: front bumper, `(N, D, L)`, m.
        speed: `(N, D, L)`, m/s.
        acceleration: `(N, D, L)`, m/s2.
        memory: of the model, `(N, D, m)`.
        state: of the policy, `(N, D, s)`.
        latent: what a stochastic head keeps of its random numbers, `(N, D, q)`.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
    memory: Tensor
    state: Tensor
    latent: Tensor


class LeaderWindow(NamedTuple):
    """The leader around one window: the last L frames up to now and the S frames after it.

    Attributes:
        position: front bumper, `(N, D, L + S)`, m.
        speed: `(N, D, L + S)`, m/s.
        acceleration: `(N, D, L + S)`, m/s2.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
