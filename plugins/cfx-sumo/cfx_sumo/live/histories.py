"""The last frames of vehicles and their leaders, as a policy sees them.

Shapes: D vehicles, F of them behind a leader, L frames of a token.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cfx.plugin import OBSERVED, RowFunction, Rows, folder_hash, row_function
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.surroundings import Seen, View
from cfx_sumo.live.vehicles import KnownVehicles

_LEADER_SPEED, _LEADER_ACCELERATION, _SPEED, _ACCELERATION, _GAP = range(len(OBSERVED))
"""Rows of a history."""

_FRAME = ("leader_speed", "leader_acceleration", "speed", "acceleration", "gap")
"""Signals of `Seen` in the order of `OBSERVED`."""

WALKING_MPS = 1.5
"""Speed below which a time gap means nothing."""


def frame_of(seen: Seen) -> Tensor:
    """Returns one frame of a history, `(D, 5)`, in the order of `OBSERVED`."""
    return torch.stack([getattr(seen, signal) for signal in _FRAME], 1)


class Histories:
    """Keeps a frame for each step of the model, however long the simulation's steps are.

    Args:
        vehicles: in whose rows the frames are.
    """

    def __init__(self, vehicles: KnownVehicles) -> None:
        self._vehicles = vehicles
        length = vehicles.table.history.shape[-1]
        self._append = _appending(length)

    def goes_on(self, rows: Tensor, now: float, clock: Clock) -> Tensor:
        """Says which vehicles were looked at one period ago, bool `(D,)`.

        Args:
            rows: of the vehicles, `(D,)` int64.
            now: s.
            clock: of the simulation.
        """
        ago = now - self._vehicles.table.time.numpy()[rows.numpy()]
        return torch.from_numpy(np.abs(ago - clock.period) < 0.5 * clock.dt)

    def remember(
        self, rows: Tensor, view: View, going: Tensor | None, now: float, clock: Clock
    ) -> tuple[Seen, Tensor]:
        """Puts this instant into the histories of followers.

        Args:
            rows: of the F followers, who stand first in the view.
            view: all D vehicles.
            going: which of the D vehicles were looked at one period ago, bool `(D,)`; None: all,
                and followers were followers of the same leaders.
            now: s.
            clock: of the simulation.

        Returns:
            What all D vehicles do, with accelerations as over a step of the model; and which of the
            followers begin anew, `(B,)` int64: this frame stands for those before it.
        """
        table, at, seen = self._vehicles.table, rows.numpy(), view.seen
        if going is None:
            follows_on = torch.ones(len(rows), dtype=torch.bool)
        else:
            follows_on = going[: len(rows)] & ~torch.from_numpy(table.free.numpy()[at])
        if clock.substeps > 1 or clock.held > 1:
            seen = self._in_model_steps(rows, view, follows_on, clock)
        table.time.numpy()[at] = now
        if going is None:
            self.append(rows, seen)
            return seen, torch.empty(0, dtype=torch.int64)
        self._vehicles.leaders.update(zip(view.following, view.leaders, strict=True))
        self._put(rows, seen, follows_on.double())
        return seen, (~follows_on).nonzero().flatten()

    def append(self, rows: Tensor, seen: Seen) -> None:
        """Puts a frame of the first F vehicles into their histories, in place of the oldest one.

        Args:
            rows: of the vehicles, `(F,)` int64.
            seen: what they and perhaps others behind them do.
        """
        self._put(rows, seen, torch.ones((), dtype=torch.float64))

    def _put(self, rows: Tensor, seen: Seen, going: Tensor) -> None:
        """Puts a frame into histories; where `going` is 0 it stands for those before it too."""
        width = len(_FRAME) * self._vehicles.table.history.shape[-1]
        history = Rows(self._vehicles.table.history.view(-1, width), rows)
        frame = [Rows(getattr(seen, signal)) for signal in _FRAME]
        self._append(len(rows), [Rows(going), *frame, history], [history])

    def time_gaps(self, rows: Tensor) -> Tensor:
        """Returns the time gaps of those that were faster than walking, `(d,)`, s."""
        frame = self._vehicles.table.history[rows, :, -1]
        return (frame[:, _GAP] / frame[:, _SPEED])[frame[:, _SPEED] > WALKING_MPS]

    def gap(self, row: int) -> float:
        """Returns the gap of a vehicle at its last frame, m."""
        return float(self._vehicles.table.history[row, _GAP, -1])

    def _in_model_steps(self, rows: Tensor, view: View, going: Tensor, clock: Clock) -> Seen:
        """Returns what all D vehicles do, F of them with accelerations over a step of the model.

        SUMO's are over its own step. In a long one the frames of the model's steps were expected;
        what happened instead is spread over them evenly. A leader that is new was not expected.
        """
        table, frame = self._vehicles.table, frame_of(view.seen)[: len(rows)]
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
            return _with_accelerations(view.seen, frame)
        error = frame - table.expected[rows]
        error[:, _ACCELERATION] = error[:, _SPEED] / clock.dt
        error[:, _LEADER_ACCELERATION] = error[:, _LEADER_SPEED] / clock.dt
        of_follower = torch.zeros(len(OBSERVED), dtype=torch.bool)
        of_follower[[_SPEED, _ACCELERATION]] = True
        # Nothing was expected where the simulation's steps were short until now.
        used = going[:, None] & (of_follower | leader_stays[:, None]) & ~error.isnan()
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
        return _with_accelerations(view.seen, frame)


def _with_accelerations(seen: Seen, frame: Tensor) -> Seen:
    """Returns what D vehicles do with the accelerations of a frame of the first F, `(F, 5)`."""
    acceleration, leader_acceleration = seen.acceleration.clone(), seen.leader_acceleration.clone()
    acceleration[: len(frame)] = frame[:, _ACCELERATION]
    leader_acceleration[: len(frame)] = frame[:, _LEADER_ACCELERATION]
    return seen._replace(acceleration=acceleration, leader_acceleration=leader_acceleration)


def _appending(length: int) -> RowFunction:
    """Returns what puts a frame into histories of `length` frames, as a function of rows.

    It takes whether vehicles go on, 1 or 0, the signals of the frame, and histories `(D, 5 L)`.
    """

    def append(going: Tensor, *values: Tensor) -> tuple[Tensor]:
        *signals, history = values
        columns = []
        for number, signal in enumerate(signals):
            earlier = history[:, number * length + 1 : (number + 1) * length]
            columns.append(torch.where(going > 0.0, earlier, signal))
            columns.append(signal)
        return (torch.cat(columns, -1),)

    widths = [1] * (1 + len(_FRAME)) + [len(_FRAME) * length]
    return row_function(append, widths, [length, folder_hash(__file__)])
