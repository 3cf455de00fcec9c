"""The trajectories of one gradient step, and what was measured around them, window by window.

Shapes: P pairs, N networks, D trajectories of each, H windows of a trajectory, L frames of a token,
S steps of a window, m width of the model's memory, q numbers that a stochastic head keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.learners.rollout.window import LeaderWindow, LoopState, WindowStep


class RolloutBatch(NamedTuple):
    """Trajectories to simulate, D for each of N networks.

    Attributes:
        place: which of the network's drivers, `(N, D)`.
        start: window at whose beginning the policy takes over, `(N, D)`.
        cold_start: whether nothing was observed before and the pooled parameters are the base, as
            for an unseen driver; bool `(N, D)`.
        last: the last frame that counts, `(N, D)`.
        weight: `(N, D)`; 0 leaves a trajectory out.
        scale: factor on all distances, speeds and accelerations, `(N, D)`; None: 1. It makes a
            recording of another driver on another road.
        shift: m/s added to the speeds of both vehicles, `(N, D)`; None: nothing. It makes a
            recording of a faster road.
        wider: m by which the gap is wider for that, `(N, D)`; given where `shift` is.
    """

    place: Tensor
    start: Tensor
    cold_start: Tensor
    last: Tensor
    weight: Tensor
    scale: Tensor | None = None
    shift: Tensor | None = None
    wider: Tensor | None = None

    @property
    def row(self) -> Tensor:
        """The network of each trajectory, `(N, 1)`: the first index of tables `(N, B, ...)`."""
        return torch.arange(len(self.place), device=self.place.device)[:, None]

    def repeated(self, times: int) -> RolloutBatch:
        """Returns the trajectories `times` times, all of them behind one another."""

        def copies(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return values.repeat(1, times)

        return RolloutBatch(
            place=self.place.repeat(1, times),
            start=self.start.repeat(1, times),
            cold_start=self.cold_start.repeat(1, times),
            last=self.last.repeat(1, times),
            weight=self.weight.repeat(1, times),
            scale=copies(self.scale),
            shift=copies(self.shift),
            wider=copies(self.wider),
        )

    def without_unweighted(self) -> RolloutBatch:
        """Returns the trajectories that have weight, in order.

        A network that has fewer of them than another is filled up with trajectories without weight.
        """
        has_weight = self.weight > 0
        most = int(has_weight.sum(1).max())
        order = has_weight.long().argsort(dim=1, descending=True, stable=True)
        kept = order[:, :most].sort(1).values

        def chosen(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return values.gather(1, kept)

        return RolloutBatch(
            place=self.place.gather(1, kept),
            start=self.start.gather(1, kept),
            cold_start=self.cold_start.gather(1, kept),
            last=self.last.gather(1, kept),
            weight=self.weight.gather(1, kept),
            scale=chosen(self.scale),
            shift=chosen(self.shift),
            wider=chosen(self.wider),
        )


class Measured(NamedTuple):
    """Recorded values at simulated frames, `(N, D, frames)` each.

    Attributes:
        speed: m/s.
        gap: m.
        counted: 1 for a frame within the training part, else 0.
    """

    speed: Tensor
    gap: Tensor
    counted: Tensor


@dataclass(frozen=True)
class RolloutInputs:
    """Recorded values before, during and after trajectories.

    Positions are relative to the follower's at the start of its trajectory.

    Attributes:
        leader: position, speed, acceleration, window by window, `(3, H, N, D, L + S)`, SI units;
            frame by frame in memory, those of two windows once.
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
    measured: Measured

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
                _at(pairs.follower_position, each, past) - origin,
                _at(pairs.follower_speed, each, past),
                _at(pairs.follower_acceleration, each, past),
            ]
        )
        leader = torch.stack(
            [
                _at(pairs.leader_position, pair, around) - origin[..., 0],
                _at(pairs.leader_speed, pair, around),
                _at(pairs.leader_acceleration, pair, around),
            ]
        )
        speed = _at(pairs.follower_speed, each, simulated)
        gap = _at(pairs.gap, each, simulated)
        leader_length = pairs.leader_length[pair]
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
        measured = Measured(speed, gap, counted)
        leader = leader.unfold(1, length + stride, stride)
        return cls(leader, leader_length, follower, memory, latent, measured)

    def initial(self, state: Tensor) -> LoopState:
        """Returns where the trajectories begin; `state` is the policy's, `(N, D, s)`.

        Where gradients are recorded they flow through the first state too, as through all later
        ones: otherwise the window step would be compiled once more for it.
        """
        position, speed, acceleration = self.follower.unbind(0)
        begin = LoopState(position, speed, acceleration, self.memory, state, self.latent)
        if not torch.is_grad_enabled():
            return begin
        return LoopState(
            _with_gradient(begin.position),
            _with_gradient(begin.speed),
            _with_gradient(begin.acceleration),
            _with_gradient(begin.memory),
            _with_gradient(begin.state),
            _with_gradient(begin.latent),
        )

    def measured_at(self, frames: slice) -> Measured:
        """Returns what was measured at some of the simulated frames."""
        speed, gap, counted = self.measured
        return Measured(speed[..., frames], gap[..., frames], counted[..., frames])

    def leader_window(self, window: int) -> LeaderWindow:
        """Returns the leader around a window."""
        position, speed, acceleration = self.leader[:, window].contiguous().unbind(0)
        return LeaderWindow(position, speed, acceleration)


def _moved(shift: Tensor, time: Tensor, ahead: Tensor) -> list[Tensor]:
    """Returns what a faster road adds to position, speed and acceleration at times, s."""
    position = shift * time + ahead
    return [position, shift.expand_as(position), torch.zeros_like(position)]


def _at(signal: Tensor, pair: Tensor, frames: Tensor) -> Tensor:
    """Returns a signal `(P, T)` at frames; beyond a recording, its first or last frame.

    Args:
        signal: of all pairs.
        pair: of each frame, of a shape to which it is broadcast.
        frames: numbers.
    """
    end = signal.shape[1] - 1
    return signal[pair, frames.clamp(min=0, max=end)]


def _with_gradient(value: Tensor) -> Tensor:
    """Returns the value as a tensor whose gradient is recorded."""
    if value.requires_grad:
        return value
    return value.clone().requires_grad_()
