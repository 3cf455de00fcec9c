"""One window of the closed loop under gradients, for all networks and trajectories at once.

Training repeats this thousands of times, so it is one function of plain tensors that
`torch.compile` turns into few kernels, forwards and backwards. Agent and integration are those of
evaluation (`cfx.evaluation.closed_loop`); a test holds the two loops equal.

Shapes: N networks, D trajectories of each, L frames of a token, S steps of a window, f features of
a token, n tuned parameters, c features of conditioning, s width of the policy's state.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.agents.core import AgentCore
from cfx.calibration.windows import WindowSettings
from cfx.learners.rollout.state import LeaderWindow, LoopState
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.features import History
from cfx.simulation.compiling import torch_compiled
from cfx.simulation.step import advance_vehicle


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
        history = self._history(now, leader, leader_length)
        unit, state = self.core.act(history, base, conditioning, now.state)
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
            state,
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
