"""One window of the closed loop under gradients: its state, steps and backward pass.

Training repeats a window thousands of times for all networks and trajectories at once, so it is one
function of plain tensors that `torch.compile` turns into few kernels, forwards and backwards. Agent
and integration are those of evaluation (`cfx.evaluation.closed_loop`); a test holds the two loops
equal.

A closed loop of many windows multiplies Jacobians, and behind a regime switch these can be large:
the gradients of Wiedemann 99 overflow without a bound. `GradientPath` scales, clips and cuts them.

Shapes: P pairs, N networks, D trajectories of each, H windows of a trajectory, L frames of a token,
S steps of a window, f features of a token, n tuned parameters, c features of conditioning, s width
of the policy's state, m of the model's memory, q numbers that a stochastic head keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.data.signals import Signal
from cfx.learners.rollout.dataset import RolloutBatch
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.core import AgentCore
from cfx.policies.history import History
from cfx.simulation.kernel.compiler import torch_compiled
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

    def detached(self) -> LoopState:
        """Returns the same values, cut off from the graph of gradients."""
        return LoopState(*(value.detach() for value in self))

    def as_start(self) -> LoopState:
        """Returns the same values as leaves of the graph, at which gradients end.

        Where gradients are recorded they flow through the first state too, as through all later
        ones: otherwise the window step would be compiled once more for it.
        """
        states = []
        for value in self:
            if value.requires_grad:
                states.append(value)
            else:
                states.append(value.clone().requires_grad_())
        return LoopState(*states)


class LeaderWindow(NamedTuple):
    """The leader around one window: the last L frames up to now and the S frames after it.

    Attributes:
        position: front bumper, `(N, D, L + S)`, m.
        speed: `(N, D, L + S)`, m/s.
        acceleration: `(N, D, L + S)`, m/s2.
        surroundings: the policy's further signals, as `PairBatch.surroundings` stores them, `(N, D,
            L + S)` each.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
    surroundings: tuple[Tensor, ...] = ()


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
        mean = core.scaler.mean
        low, high = self.space.bounds(dtype=mean.dtype, device=mean.device)
        self.low, self.range = low, high - low

    def compile(self) -> None:
        """Lets `torch.compile` make one function of `observe` and one of `drive_window`."""
        # The compiled functions take the methods' places.
        self.observe = torch_compiled(self.observe, dynamic=False)  # type: ignore[method-assign]
        self.drive_window = torch_compiled(self.drive_window, dynamic=False)  # type: ignore[method-assign]

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
        history = {
            "leader_speed": leader.speed[..., past],
            "leader_acceleration": leader.acceleration[..., past],
            "follower_speed": now.speed,
            "follower_acceleration": now.acceleration,
            "gap": leader.position[..., past] - leader_length[..., None] - now.position,
        }
        for signal, stored in zip(self.core.further_signals, leader.surroundings, strict=True):
            history[signal.name] = signal.seen_from(now.position, stored[..., past])
        return history

    def _shift(self, before: Tensor, after: Tensor) -> Tensor:
        """Returns the last L frames after a window."""
        return torch.cat([before, after], -1)[..., self.stride :].contiguous()


@dataclass(frozen=True)
class GradientPath:
    """Back-propagation through time, with decay, clipping and cuts.

    A decay of g per window makes gradients forget with a time constant of -1 / ln g windows.

    Attributes:
        decay: factor on gradients that come back through one window, 0 to 1.
        clip: largest absolute value of each of them.
        cut_after: windows of a segment, between two losses, after which they are cut; None: never.
        through_motion: whether they come back through the vehicle's motion too; False: through the
            policy's memory alone.
    """

    decay: float
    clip: float
    cut_after: int | None = None
    through_motion: bool = True

    def windows_of_segment(self, windows: int) -> int:
        """Returns how many of a trajectory's windows lie between two cuts."""
        if self.cut_after is None:
            return windows
        return self.cut_after

    def after_window(self, state: LoopState) -> LoopState:
        """Returns the state, of the same values, from which the next window starts."""
        values = [_Bounded.apply(value, self.decay, self.clip) for value in state]  # type: ignore[no-untyped-call]
        bounded = LoopState(*values)
        if self.through_motion:
            return bounded
        return self.after_segment(bounded)._replace(state=bounded.state)

    def after_segment(self, state: LoopState) -> LoopState:
        """Returns the state, of the same values, from which the next segment starts."""
        return LoopState(*(value.detach().requires_grad_() for value in state))


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


class MeasuredFrames(NamedTuple):
    """Recorded values at simulated frames, `(N, D, frames)` each.

    Attributes:
        speed: m/s.
        gap: m.
        counted: 1 for a frame within the training part, else 0.
    """

    speed: Tensor
    gap: Tensor
    counted: Tensor


class Segment(NamedTuple):
    """Simulated values between two cuts of the gradients, `(N, D, frames)` each.

    Attributes:
        speed: m/s.
        gap: m.
        measured: at the same frames.
        expert_speed: the speeds at which experts would have driven each window, m/s; None without
            experts.
        first: how many frames were simulated before.
    """

    speed: Tensor
    gap: Tensor
    measured: MeasuredFrames
    expert_speed: Tensor | None
    first: int = 0

    def only(self, trajectories: slice) -> Segment:
        """Returns the segment of some trajectories."""
        expert_speed = self.expert_speed
        if expert_speed is not None:
            expert_speed = expert_speed[:, trajectories]
        speed, gap, counted = self.measured
        return Segment(
            self.speed[:, trajectories],
            self.gap[:, trajectories],
            MeasuredFrames(speed[:, trajectories], gap[:, trajectories], counted[:, trajectories]),
            expert_speed,
            self.first,
        )


@dataclass(frozen=True)
class RolloutInputs:
    """Recorded values before, during and after trajectories.

    Positions are relative to the follower's at the start of its trajectory.

    Attributes:
        leader: position, speed, acceleration, then the policy's E further signals, window by
            window, `(3 + E, H, N, D, L + S)`, SI units; frame by frame in memory, those of two
            windows once.
        leader_length: `(N, D)`, m.
        follower: position, speed, acceleration of the last L frames before the policy takes over,
            `(3, N, D, L)`, SI units.
        memory: of the model at that moment, `(N, D, m)`.
        latent: of the head at that moment, `(N, D, q)`: nothing is drawn yet.
        measured: at the `H S` frames that are simulated.
    """

    leader: Tensor
    leader_length: Tensor
    follower: Tensor
    memory: Tensor
    latent: Tensor
    measured: MeasuredFrames

    @classmethod
    def of(
        cls, pairs: PairBatch, pair: Tensor, batch: RolloutBatch, step: WindowStep, windows: int
    ) -> RolloutInputs:
        """Gathers them.

        Args:
            pairs: the P pairs.
            pair: which pair each trajectory is of, `(N, D)`.
            batch: where the trajectories begin.
            step: knows L, S and the model.
            windows: H.
        """
        length, stride, device = step.length, step.stride, pair.device
        now, each = (batch.start * stride)[..., None], pair[..., None]
        past = now + torch.arange(1 - length, 1, device=device)
        frames = torch.arange(1 - length, windows * stride + 1, device=device)
        around = now[..., 0] + frames[:, None, None]
        simulated = now + torch.arange(1, windows * stride + 1, device=device)
        origin = _at(pairs.follower_position, each, now)
        follower = torch.stack(
            [
                _at(pairs.follower_position, each, past),
                _at(pairs.follower_speed, each, past),
                _at(pairs.follower_acceleration, each, past),
            ]
        )
        leader = torch.stack(
            [
                _at(pairs.leader_position, pair, around),
                _at(pairs.leader_speed, pair, around),
                _at(pairs.leader_acceleration, pair, around),
            ]
        )
        follower[0] -= origin
        leader[0] -= origin[..., 0]
        speed = _at(pairs.follower_speed, each, simulated)
        gap = _at(pairs.gap, each, simulated)
        leader_length = pairs.leader_length[pair]
        surroundings = []
        for signal in step.core.further_signals:
            stored = _at(pairs.surroundings[signal], pair, around)
            if signal.quantity == "gap":
                stored = stored - origin[..., 0]
            surroundings.append(_augmented(signal, stored, frames, batch, step.dt))
        if batch.scale is not None:
            scale = batch.scale[..., None]
            follower, speed, gap = follower * scale, speed * scale, gap * scale
            # The gap is scaled, the vehicle's length is not.
            zero = torch.zeros_like(leader_length)
            rear = torch.stack([leader_length, zero, zero])[:, None]
            leader = (leader - rear) * batch.scale + rear
        if batch.shift is not None and batch.wider is not None:
            shift, wider = batch.shift[..., None], batch.wider[..., None]
            before = (past - now) * step.dt
            follower = follower + torch.stack(_moved(shift, before, torch.zeros_like(shift)))
            after = frames[:, None, None] * step.dt
            leader = leader + torch.stack(_moved(batch.shift, after, batch.wider))
            speed, gap = speed + shift, gap + wider
        counted = (simulated <= batch.last[..., None]).to(follower.dtype)
        memory = step.model.initial_memory(follower[1, ..., -1])
        latent = memory.new_zeros((*pair.shape, step.core.head.latent_width))
        measured = MeasuredFrames(speed, gap, counted)
        if surroundings:
            leader = torch.cat([leader, torch.stack(surroundings)])
        leader = leader.unfold(1, length + stride, stride)
        return cls(leader, leader_length, follower, memory, latent, measured)

    def initial(self, state: Tensor) -> LoopState:
        """Returns where the trajectories begin; `state` is the policy's, `(N, D, s)`."""
        position, speed, acceleration = self.follower.unbind(0)
        begin = LoopState(position, speed, acceleration, self.memory, state, self.latent)
        if not torch.is_grad_enabled():
            return begin
        return begin.as_start()

    def measured_at(self, frames: slice) -> MeasuredFrames:
        """Returns what was measured at some of the simulated frames."""
        speed, gap, counted = self.measured
        return MeasuredFrames(speed[..., frames], gap[..., frames], counted[..., frames])

    def leader_window(self, window: int) -> LeaderWindow:
        """Returns the leader around a window."""
        position, speed, acceleration, *more = self.leader[:, window].contiguous().unbind(0)
        return LeaderWindow(position, speed, acceleration, tuple(more))


def _moved(shift: Tensor, time: Tensor, ahead: Tensor) -> list[Tensor]:
    """Returns what a faster road adds to position, speed and acceleration at times, s."""
    position = shift * time + ahead
    return [position, shift.expand_as(position), torch.zeros_like(position)]


def _augmented(
    signal: Signal, stored: Tensor, frames: Tensor, batch: RolloutBatch, dt: float
) -> Tensor:
    """Returns a further signal `(frames, N, D)` on the scaled or faster road of trajectories.

    Args:
        signal: which.
        stored: as recorded, of a gap the position of what is ahead.
        frames: since the trajectories began, `(frames,)`.
        batch: how each trajectory is changed.
        dt: time step, s.
    """
    if batch.scale is not None and signal.is_scaled:
        stored = stored * batch.scale
    if batch.shift is None or batch.wider is None:
        return stored
    time = frames[:, None, None] * dt
    if signal.quantity == "gap":
        return stored + batch.shift * time + batch.wider
    if signal.quantity == "speed":
        return stored + batch.shift
    return stored


def _at(signal: Tensor, pair: Tensor, frames: Tensor) -> Tensor:
    """Returns a signal `(P, T)` at frames; beyond a recording, its first or last frame."""
    return signal[pair, frames.clamp(min=0, max=signal.shape[1] - 1)]
