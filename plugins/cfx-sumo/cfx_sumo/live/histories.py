"""The last frames of vehicles and their leaders, as a policy sees them.

Shapes: D vehicles, F of them behind a leader, L frames of a token.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.plugin import OBSERVED
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.surroundings import Seen, View
from cfx_sumo.live.vehicles import KnownVehicles

_LEADER_SPEED, _LEADER_ACCELERATION, _SPEED, _ACCELERATION, _GAP = range(len(OBSERVED))
"""Rows of a history."""

WALKING_MPS = 1.5
"""Speed below which a time gap means nothing."""


def frame_of(seen: Seen) -> Tensor:
    """Returns one frame of a history, `(D, 5)`, in the order of `OBSERVED`."""
    signals = (
        seen.leader_speed,
        seen.leader_acceleration,
        seen.speed,
        seen.acceleration,
        seen.gap,
    )
    return torch.stack(signals, 1)


class Histories:
    """Keeps a frame for each step of the model, however long the simulation's steps are.

    Args:
        vehicles: in whose rows the frames are.
    """

    def __init__(self, vehicles: KnownVehicles) -> None:
        self._vehicles = vehicles

    def goes_on(self, rows: Tensor, now: float, clock: Clock) -> Tensor:
        """Says which vehicles were looked at one period ago, bool `(D,)`.

        Args:
            rows: of the vehicles, `(D,)` int64.
            now: s.
            clock: of the simulation.
        """
        return (now - self._vehicles.table.time[rows] - clock.period).abs() < 0.5 * clock.dt

    def remember(self, rows: Tensor, view: View, now: float, clock: Clock) -> tuple[Seen, Tensor]:
        """Puts this instant into the histories of followers.

        Args:
            rows: of the F followers, who stand first in the view.
            view: all D vehicles.
            now: s.
            clock: of the simulation.

        Returns:
            What all D vehicles do, with accelerations as over a step of the model; and which of the
            followers begin anew, `(B,)` int64: this frame stands for those before it.
        """
        table, count = self._vehicles.table, len(rows)
        going = self.goes_on(rows, now, clock) & ~table.free[rows]
        frame = frame_of(view.seen)
        if clock.substeps > 1 or clock.held > 1:
            frame[:count] = self._in_model_steps(rows, view, frame[:count], going, clock)
        self._vehicles.leaders.update(zip(view.following, view.leaders, strict=True))
        seen = view.seen._replace(
            acceleration=frame[:, _ACCELERATION], leader_acceleration=frame[:, _LEADER_ACCELERATION]
        )
        self.append(rows[going], seen.rows(slice(count)).rows(going))
        table.time[rows] = now
        if bool(going.all()):
            return seen, torch.empty(0, dtype=torch.int64)
        new = (~going).nonzero().flatten()
        table.history[rows[new]] = frame[new, :, None]
        return seen, new

    def append(self, rows: Tensor, seen: Seen) -> None:
        """Puts a frame of vehicles `(D,)` into their histories, in place of the oldest one."""
        history = self._vehicles.table.history
        earlier = history[rows, :, 1:]
        history[rows] = torch.cat([earlier, frame_of(seen)[:, :, None]], -1)

    def time_gaps(self, rows: Tensor) -> Tensor:
        """Returns the time gaps of those that were faster than walking, `(d,)`, s."""
        frame = self._vehicles.table.history[rows, :, -1]
        return (frame[:, _GAP] / frame[:, _SPEED])[frame[:, _SPEED] > WALKING_MPS]

    def gap(self, row: int) -> float:
        """Returns the gap of a vehicle at its last frame, m."""
        return float(self._vehicles.table.history[row, _GAP, -1])

    def _in_model_steps(
        self, rows: Tensor, view: View, frame: Tensor, going: Tensor, clock: Clock
    ) -> Tensor:
        """Returns frames `(F, 5)` with accelerations as they are over a step of the model.

        SUMO's are over its own step. In a long one the frames of the model's steps were expected;
        what happened instead is spread over them evenly. A leader that is new was not expected.
        """
        table, frame = self._vehicles.table, frame.clone()
        same = []
        for name, leader in zip(view.following, view.leaders, strict=True):
            same.append(self._vehicles.leaders.get(name) == leader)
        leader_stays = going & torch.tensor(same, dtype=torch.bool)
        before = table.history[rows, :, -1]
        if clock.held > 1:
            mean = (frame - before) / clock.period
            for speed, acceleration, stays in (
                (_SPEED, _ACCELERATION, going),
                (_LEADER_SPEED, _LEADER_ACCELERATION, leader_stays),
            ):
                frame[:, acceleration] = torch.where(stays, mean[:, speed], frame[:, acceleration])
            return frame
        error = frame - table.expected[rows]
        error[:, _ACCELERATION] = error[:, _SPEED] / clock.dt
        error[:, _LEADER_ACCELERATION] = error[:, _LEADER_SPEED] / clock.dt
        of_follower = torch.zeros(len(OBSERVED), dtype=torch.bool)
        of_follower[[_SPEED, _ACCELERATION]] = True
        used = going[:, None] & (of_follower | leader_stays[:, None])
        error = torch.where(used, error, 0.0)
        steps = min(clock.substeps - 1, table.history.shape[-1])
        share = torch.arange(clock.substeps - steps, clock.substeps) / clock.substeps
        spread = error[:, :, None] * share
        for row in (_ACCELERATION, _LEADER_ACCELERATION):
            spread[:, row] = error[:, row, None]
        table.history[rows, :, -steps:] += spread
        expected = table.expected[rows] + error
        for row in (_ACCELERATION, _LEADER_ACCELERATION):
            frame[:, row] = torch.where(used[:, row], expected[:, row], frame[:, row])
        return frame
