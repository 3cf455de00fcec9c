"""One window of a closed loop under gradients: the policy chooses, the model drives, for all networks and drives at once.

This is what training by rollout repeats thousands of times, so it is one function of plain tensors that `torch.compile` turns
into few kernels, forwards and backwards. It is the same loop as `cfx.evaluation.closed_loop.simulate_closed_loop`; a test holds them equal.

Shapes: N networks, D drives of each, L frames that a token holds, S steps of a window, n tuned parameters, k driver features, s width of
the policy's state, m of the model's memory.
"""

from __future__ import annotations

import importlib
import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.agents.core import AgentCore
from cfx.agents.heads.offset import OffsetHead
from cfx.agents.scaler import Scaler
from cfx.calibration.windows import WindowSettings
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import History
from cfx.simulation.step import advance_vehicle


class LoopState(NamedTuple):
    """Where N by D drives stand: the follower's last L frames, the last being now; `(N, D, L)` each, SI units.

    Attributes:
        memory: of the model, `(N, D, m)`.
        state: of the policy, `(N, D, s)`.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
    memory: Tensor
    state: Tensor


class LeaderWindow(NamedTuple):
    """The leader around one window: the last L frames up to now and the S frames after it, `(N, D, L + S)` each; SI units."""

    position: Tensor
    speed: Tensor
    acceleration: Tensor


class WindowStep:
    """Reads and drives one window; `network` and `scaler` are shared, not copied."""

    def __init__(
        self,
        network: PolicyNetwork,
        scaler: Scaler,
        policy: Policy,
        model: DrivingModel,
        windows: WindowSettings,
        dt: float,
    ) -> None:
        head = OffsetHead.for_model(model, scaler.mean.device)
        self.core = AgentCore(policy, network, scaler, head)
        self.network = network
        self.model = model
        self.length, self.stride = windows.length, windows.stride
        self.dt = dt
        self.space = head.space
        low, high = self.space.bounds(dtype=scaler.mean.dtype, device=scaler.mean.device)
        self.low, self.range = low, high - low

    def compile(self) -> None:
        """Lets `torch.compile` make one function of each of the two."""
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # torch's own, about itself, as it imports its compiler
            importlib.import_module("torch._inductor.compile_fx")
        self.read = torch.compile(self.read, dynamic=False)  # type: ignore[method-assign]  # the compiled one takes its place
        self.drive = torch.compile(self.drive, dynamic=False)  # type: ignore[method-assign]  # likewise

    def read(self, seen: Tensor, told: Tensor, state: Tensor, there: Tensor) -> Tensor:
        """Reads one token of each drive.

        Args:
            seen: `(N, D, f)`, not normalised.
            told: the base in the squashed space, and driver features, `(N, D, n + k)`.
            state: `(N, D, s)`.
            there: whether the drive has this token; where not, its state stays, bool `(N, D)`.

        Returns:
            The network's state afterwards.
        """
        return self.core.observe(torch.cat([seen, told], -1), state, there)

    def drive(
        self,
        recent: LoopState,
        ahead: LeaderWindow,
        leader_length: Tensor,
        base: Tensor,
        told: Tensor,
    ) -> tuple[LoopState, Tensor, Tensor]:
        """Drives one window.

        Args:
            recent: where the drives stand.
            ahead: the leader around the window.
            leader_length: `(N, D)`, m.
            base: in unit space, `(N, D, n)`.
            told: the same in the squashed space, and driver features, `(N, D, n + k)`.

        Returns:
            Where the drives stand afterwards; speed and gap at the S frames, `(N, D, S)`.
        """
        length, stride, now = self.length, self.stride, self.length - 1
        gap = ahead.position[..., :length] - leader_length[..., None] - recent.position
        history = History(
            ahead.speed[..., :length],
            ahead.acceleration[..., :length],
            recent.speed,
            recent.acceleration,
            gap,
        )
        unit, state = self.core.act(history, base, told, recent.state)
        p = self.space.unpack(self.low + unit * self.range)
        follower = Follower(
            recent.position[..., now],
            recent.speed[..., now],
            recent.acceleration[..., now],
            recent.memory,
        )
        positions, speeds, accelerations = [], [], []
        for k in range(now, now + stride):
            leader = Leader(
                ahead.position[..., k],
                ahead.speed[..., k],
                ahead.acceleration[..., k],
                leader_length,
            )
            follower = advance_vehicle(self.model, follower, leader, p, self.dt)
            positions.append(follower.position)
            speeds.append(follower.speed)
            accelerations.append(follower.acceleration)
        position, speed, acceleration = (
            torch.stack(frames, -1) for frames in (positions, speeds, accelerations)
        )
        frames = zip(recent[:3], (position, speed, acceleration), strict=True)
        carried = [
            torch.cat([before, after], -1)[..., stride:].contiguous() for before, after in frames
        ]
        last = LoopState(carried[0], carried[1], carried[2], follower.memory, state)
        return last, speed, ahead.position[..., length:] - leader_length[..., None] - position


class _Bounded(torch.autograd.Function):
    """The identity, whose gradient is damped and bounded on its way back."""

    @staticmethod
    def forward(ctx, value, gradient_decay, bound):  # type: ignore[no-untyped-def]  # torch's signature
        ctx.gradient_decay, ctx.bound = gradient_decay, bound
        return value.view_as(value)

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]  # torch's signature
        gradient = torch.nan_to_num(gradient, 0.0, 0.0, 0.0) * ctx.gradient_decay
        return gradient.clamp(-ctx.bound, ctx.bound), None, None


def bounded(recent: LoopState, gradient_decay: float, bound: float) -> LoopState:
    """Returns the same state; what gradients bring back through it is multiplied by `damping` and kept within `bound`.

    A closed loop of many windows multiplies Jacobians, and behind a regime switch these can be large: without this, W99's
    gradients overflow. A damping of g per window makes gradients forget with a time constant of -1 / ln g windows.
    """
    return LoopState(*(_Bounded.apply(value, gradient_decay, bound) for value in recent))  # type: ignore[no-untyped-call]
