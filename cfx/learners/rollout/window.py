"""One window of the closed loop under gradients: its state, steps and backward pass.

Training repeats a window thousands of times for all networks and trajectories at once, so it is one
function of plain tensors that `torch.compile` turns into few kernels, forwards and backwards. Agent
and integration are those of evaluation (`cfx.evaluation.closed_loop`); a test holds the two loops
equal.

A closed loop of many windows multiplies Jacobians, and behind a regime switch these can be large:
the gradients of Wiedemann 99 overflow without a bound. So each way back is an object that says
where gradients are scaled, clipped or cut (`GradientPath`); the loop itself
(`cfx.learners.rollout.loop`) does not know.

Shapes: N networks, D trajectories of each, L frames of a token, S steps of a window, f features of
a token, n tuned parameters, c features of conditioning, s width of the policy's state, m of the
model's memory, q numbers that a stochastic head keeps.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.calibration import losses
from cfx.core import parameters
from cfx.core.component import folder_hash
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies import features
from cfx.policies.core import AgentCore
from cfx.policies.features import History
from cfx.simulation.kernel.compiler import torch_compiled
from cfx.simulation.kernel.run import component_code
from cfx.simulation.step import advance_vehicle
from cfx.simulation.windows import WindowSettings


class LoopState(NamedTuple):
    """State of N by D trajectories: the follower's last L frames, the last being now.

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


class WindowStep:
    """Observes or drives one window.

    Args:
        core: the networks with their head; shared, not copied.
        model: the driving model.
        windows: L and S.
        dt: time step, s.
    """

    def __init__(
        self, core: AgentCore, model: DrivingModel, windows: WindowSettings, dt: float
    ) -> None:
        self.core = core
        self.model = model
        self.length, self.stride = windows.length, windows.stride
        self.dt = dt
        self.space = core.head.space
        like = core.scaler.mean
        low, high = self.space.bounds(dtype=like.dtype, device=like.device)
        self.low, self.range = low, high - low

    def compile(self) -> None:
        """Lets `torch.compile` make one function of `observe` and one of `drive_window`."""
        # The compiled functions take the methods' places.
        self.observe = torch_compiled(self.observe, dynamic=False)  # type: ignore[method-assign]
        self.drive_window = torch_compiled(self.drive_window, dynamic=False)  # type: ignore[method-assign]

    def key(self) -> object:
        """Returns what the window depends on besides tensors; None if only this process knows."""
        core = self.core
        code = []
        for component in (type(self.model), type(core.head), type(core.policy)):
            code.append(component_code(component))
        if None in code:
            return None
        settings = [self.model.equations_key(), repr(self.space), self.length, self.stride, self.dt]
        read = [core.inputs, core.summary, core.scaler.mean.shape[-1]]
        rooms = [folder_hash(module.__file__) for module in (features, parameters, losses)]
        return [code, settings, read, rooms, folder_hash(__file__)]

    def observe(
        self, token: Tensor, conditioning: Tensor, state: Tensor, present: Tensor
    ) -> Tensor:
        """Lets the networks see one measured window of each trajectory.

        Args:
            token: `(N, D, f)`, not normalised.
            conditioning: `(N, D, c)`, not normalised.
            state: `(N, D, s)`.
            present: whether the trajectory has this window; otherwise its state stays, bool `(N,
                D)`.

        Returns:
            The networks' state afterwards.
        """
        return self.core.observe(torch.cat([token, conditioning], -1), state, present)

    def drive_window(
        self,
        now: LoopState,
        leader: LeaderWindow,
        leader_length: Tensor,
        base: Tensor,
        conditioning: Tensor,
        noise: Tensor | None = None,
    ) -> tuple[LoopState, Tensor, Tensor]:
        """Simulates one window.

        Args:
            now: where the trajectories stand.
            leader: the leader around the window.
            leader_length: `(N, D)`, m.
            base: in unit space, `(N, D, n)`.
            conditioning: `(N, D, c)`, not normalised.
            noise: what a stochastic head draws from, `(N, D, k)`; None: nothing is drawn.

        Returns:
            Where the trajectories stand afterwards; speed (m/s) and gap (m) at the S frames,
            `(N, D, S)` each.
        """
        features = self.features(now, leader, leader_length, conditioning)
        answer, state = self.core.answer(features, now.state)
        after, speed, gap = self.steer(answer, now, leader, leader_length, base, noise)
        return after._replace(state=state), speed, gap

    def features(
        self, now: LoopState, leader: LeaderWindow, leader_length: Tensor, conditioning: Tensor
    ) -> Tensor:
        """Returns what networks read, `(*batch, f + c)`, not normalised; as for `drive_window`."""
        history = self._history(now, leader, leader_length)
        return torch.cat([self.core.encode(history), conditioning], -1)

    def steer(
        self,
        answer: Tensor,
        now: LoopState,
        leader: LeaderWindow,
        leader_length: Tensor,
        base: Tensor,
        noise: Tensor | None = None,
    ) -> tuple[LoopState, Tensor, Tensor]:
        """Takes the steps of a window, elementwise over trajectories.

        Args:
            answer: of the networks, `(*batch, n)`.
            now, leader, leader_length, base, noise: as for `drive_window`.

        Returns:
            As `drive_window`; the policy's state is as before.
        """
        history = self._history(now, leader, leader_length)
        unit = self.core.head.unit_parameters(answer, base)
        chosen = self.core.head.measured(self.low + unit * self.range, history, self.dt)
        latent = now.latent
        if noise is not None:
            chosen, latent = self.core.head.sampled(chosen, noise, latent, self.stride * self.dt)
        p = self.space.unpack(chosen)
        last = self.length - 1
        follower = Follower(
            now.position[..., last], now.speed[..., last], now.acceleration[..., last], now.memory
        )
        positions, speeds, accelerations = [], [], []
        for frame in range(last, last + self.stride):
            ahead = Leader(
                leader.position[..., frame],
                leader.speed[..., frame],
                leader.acceleration[..., frame],
                leader_length,
            )
            follower = advance_vehicle(self.model, follower, ahead, p, self.dt)
            positions.append(follower.position)
            speeds.append(follower.speed)
            accelerations.append(follower.acceleration)
        position, speed = torch.stack(positions, -1), torch.stack(speeds, -1)
        acceleration = torch.stack(accelerations, -1)
        after = LoopState(
            self._shift(now.position, position),
            self._shift(now.speed, speed),
            self._shift(now.acceleration, acceleration),
            follower.memory,
            now.state,
            latent,
        )
        gap = leader.position[..., self.length :] - leader_length[..., None] - position
        return after, speed, gap

    def _history(self, now: LoopState, leader: LeaderWindow, leader_length: Tensor) -> History:
        """Returns what the policy sees: the last L frames."""
        past = slice(None, self.length)
        return History(
            leader.speed[..., past],
            leader.acceleration[..., past],
            now.speed,
            now.acceleration,
            leader.position[..., past] - leader_length[..., None] - now.position,
        )

    def _shift(self, before: Tensor, after: Tensor) -> Tensor:
        """Returns the last L frames after a window."""
        return torch.cat([before, after], -1)[..., self.stride :].contiguous()


class GradientPath(ABC):
    """Base of the ways back.

    Life cycle: the loop asks for `segment_length` once, calls `after_window` on the state behind
    each window, and `after_segment` behind each segment. Both return the same values.
    """

    @abstractmethod
    def segment_length(self, windows: int) -> int:
        """Returns the number of windows between two losses, for trajectories of `windows`."""

    @abstractmethod
    def after_window(self, state: LoopState) -> LoopState:
        """Returns the state from which the next window starts."""

    @abstractmethod
    def after_segment(self, state: LoopState) -> LoopState:
        """Returns the state from which the next segment starts."""


class NoGradients(GradientPath):
    """Nothing is recorded: one segment, as in validation."""

    def segment_length(self, windows: int) -> int:
        return windows

    def after_window(self, state: LoopState) -> LoopState:
        return state

    def after_segment(self, state: LoopState) -> LoopState:
        return state


@dataclass(frozen=True)
class ThroughTime(GradientPath):
    """Back-propagation through time, with decay, clipping and cuts.

    A decay of g per window makes gradients forget with a time constant of -1 / ln g windows.

    Attributes:
        decay: factor on gradients that come back through one window, 0 to 1.
        clip: largest absolute value of each of them.
        cut_after: windows after which they are cut; None: never.
    """

    decay: float
    clip: float
    cut_after: int | None = None

    def segment_length(self, windows: int) -> int:
        return self.cut_after or windows

    def after_window(self, state: LoopState) -> LoopState:
        return LoopState(
            self._bounded(state.position),
            self._bounded(state.speed),
            self._bounded(state.acceleration),
            self._bounded(state.memory),
            self._bounded(state.state),
            self._bounded(state.latent),
        )

    def after_segment(self, state: LoopState) -> LoopState:
        return LoopState(
            _cut(state.position),
            _cut(state.speed),
            _cut(state.acceleration),
            _cut(state.memory),
            _cut(state.state),
            _cut(state.latent),
        )

    def _bounded(self, value: Tensor) -> Tensor:
        bounded: Tensor = _Bounded.apply(value, self.decay, self.clip)  # type: ignore[no-untyped-call]
        return bounded


class ThroughMemory(ThroughTime):
    """Back-propagates through the policy's memory alone, not through the vehicle's motion."""

    def after_window(self, state: LoopState) -> LoopState:
        bounded = super().after_window(state)
        return LoopState(
            _cut(bounded.position),
            _cut(bounded.speed),
            _cut(bounded.acceleration),
            _cut(bounded.memory),
            bounded.state,
            _cut(bounded.latent),
        )


class _Bounded(torch.autograd.Function):
    """The identity; its backward pass scales and clips the gradient."""

    @staticmethod
    def forward(ctx, value, decay, clip):  # type: ignore[no-untyped-def]  # torch's signature
        ctx.decay, ctx.clip = decay, clip
        return value.view_as(value)

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]  # torch's signature
        gradient = torch.nan_to_num(gradient, 0.0, 0.0, 0.0) * ctx.decay
        return gradient.clamp(-ctx.clip, ctx.clip), None, None


def _cut(value: Tensor) -> Tensor:
    """Returns the value without its past, as the start of new gradients."""
    return value.detach().requires_grad_()
