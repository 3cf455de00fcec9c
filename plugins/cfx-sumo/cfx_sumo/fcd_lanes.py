"""Who follows whom in a lane of SUMO's floating car data, and who drives in no queue at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.plugin import Floats, Ints, tracks

_STANDING_MPS = 0.1
"""m/s: a vehicle below this stands."""

_OFF_LANE_M = 2.4
"""m: no two vehicles in a lane of SUMO's usual 3.2 m are so far apart sideways; a parked one is."""

_NEAR_M = 10.0
"""m: a lane is straight for so long."""

_STRAIGHT = np.radians(5.0)
"""A lane that bends more between vehicles far apart does not tell who is beside whom."""


class Couples(NamedTuple):
    """Rows `(C,)` of two vehicles in one lane at one time: one is passed by the other there.

    Attributes:
        passed: the row of the one that is passed, before or after it is.
        passing: the row of the other.
    """

    passed: Ints
    passing: Ints


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Rows of vehicles, sorted by vehicle and frame, `(N,)` each.

    Attributes:
        vehicle, frame, lane: numbers.
        position: of the front bumper along the lane, m.
        speed: m/s.
        lateral: to the left of the lane's middle, m; NaN: unknown.
        x, y: of the front bumper, m; NaN: unknown.
        heading: clockwise from north, rad; NaN: unknown.
    """

    vehicle: Ints
    frame: Ints
    lane: Ints
    position: Floats
    speed: Floats
    lateral: Floats
    x: Floats
    y: Floats
    heading: Floats

    @property
    def starts(self) -> tracks.Marks:
        """Where a vehicle's rows begin."""
        return tracks.changes(self.vehicle)

    def take(self, index: NDArray[Any]) -> Self:
        """Returns the rows at an index or a mask."""
        return replace(
            self, **{column.name: getattr(self, column.name)[index] for column in fields(self)}
        )

    def is_followed_up(self) -> tracks.Marks:
        """Says after which rows the same vehicle goes on in the same lane in the next frame."""
        goes_on = np.zeros(len(self.vehicle), dtype=bool)
        goes_on[:-1] = (
            (self.vehicle[1:] == self.vehicle[:-1])
            & (self.frame[1:] == self.frame[:-1] + 1)
            & (self.lane[1:] == self.lane[:-1])
        )
        return goes_on

    def is_oncoming(self, dt: float) -> tracks.Marks:
        """Says which rows are of vehicles that drive against their lane's direction.

        SUMO's vehicles do while they overtake in the lane of the opposite direction.
        """
        goes_on = self.is_followed_up()[:-1]
        moved = np.diff(self.position)
        driven = 0.5 * (self.speed[1:] + self.speed[:-1]) * dt
        # A position that falls by another distance than was driven begins a lane anew: a ring.
        backwards = goes_on & (driven > 0) & (np.abs(moved + driven) < 0.5 * driven)
        result = np.zeros(len(self.vehicle), dtype=bool)
        result[:-1] = backwards
        result[1:] |= backwards
        return result

    def passes(self) -> Couples:
        """Returns where one vehicle drives through another: their order in a lane is reversed."""
        behind, ahead = self._neighbours(1)
        goes_on = self.is_followed_up()
        after = goes_on[behind] & goes_on[ahead]
        one, other = behind[after], ahead[after]
        overtakes = self.position[one + 1] > self.position[other + 1]
        came_on = np.zeros(len(goes_on), dtype=bool)
        came_on[1:] = goes_on[:-1]
        before = came_on[behind] & came_on[ahead]
        third, fourth = behind[before], ahead[before]
        overtook = self.position[third - 1] > self.position[fourth - 1]
        passed = np.concatenate([other[overtakes], third[overtook]])
        passing = np.concatenate([one[overtakes], fourth[overtook]])
        return Couples(passed, passing)

    def is_parked(self, couples: Couples) -> tracks.Marks:
        """Says which rows are of vehicles that are parked beside their lane.

        A vehicle is parked from where it comes to a stop until it moves on, if others drive
        through it meanwhile, or if it stands beside where others drive in that lane.
        """
        standing = self.speed < _STANDING_MPS
        stint = np.cumsum(tracks.changes(self.vehicle, self.lane, standing))
        is_passed = np.zeros(len(standing), dtype=bool)
        is_passed[couples.passed] = True
        marks = standing & (is_passed | self._is_off_lane(standing))
        return standing & np.isin(stint, stint[marks])

    def _is_off_lane(self, standing: tracks.Marks) -> tracks.Marks:
        """Says which vehicles stand away from where the nearest moving one drives in that lane.

        False where `x`, `y` or `heading` is not known.
        """
        result = np.zeros(len(standing), dtype=bool)
        moving = np.flatnonzero(~standing & ~np.isnan(self.x + self.y + self.heading))
        rows = np.flatnonzero(standing)
        if not len(moving) or not len(rows):
            return result
        moving = moving[np.lexsort((self.position[moving], self.lane[moving]))]
        span = float(self.position.max() - self.position.min()) + 2 * _NEAR_M
        keys = self.lane * span + self.position
        behind = np.searchsorted(keys[moving], keys[rows])
        for place in (behind - 1, behind):
            near = moving[np.clip(place, 0, len(moving) - 1)]
            is_near = np.abs(keys[near] - keys[rows]) < _NEAR_M
            right = self._right_of(near, rows, self.heading[near])
            result[rows] |= is_near & (np.abs(right) > _OFF_LANE_M)
        return result

    def beside(self, couples: Couples, width: float) -> Callable[[Ints, Ints], tracks.Marks]:
        """Returns what says of rows of two vehicles in one lane whether they drive side by side.

        They do where they are `width` or more apart sideways: by `lateral`, or by `x`, `y` and
        `heading` where some vehicles of the file pass others. Where neither is known, those that
        pass each other do for as long as both are in that lane.

        Args:
            couples: of vehicles that both move.
            width: m.
        """
        if not np.isnan(self.lateral).all():
            return lambda one, other: np.abs(self.lateral[other] - self.lateral[one]) >= width
        if len(couples.passed) and not np.isnan(self.x + self.y + self.heading).all():
            heading = self._road_heading()
            return lambda one, other: np.abs(self._sideways(one, other, heading)) >= width
        couples_met = self._couple(couples.passed, couples.passing)
        return lambda one, other: np.isin(self._couple(one, other), couples_met)

    def _road_heading(self) -> Floats:
        """Returns where the lane leads at each row, rad: the median heading of those near there."""
        where = [self.lane, np.floor(self.position / _NEAR_M)]
        east = pd.Series(np.sin(self.heading)).groupby(where).transform("median")
        north = pd.Series(np.cos(self.heading)).groupby(where).transform("median")
        heading: Floats = np.arctan2(east.to_numpy(), north.to_numpy())
        return heading

    def _sideways(self, one: Ints, other: Ints, heading: Floats) -> Floats:
        """Returns how far the other is to the right of where the lane leads from one, m.

        On an arc, the way from one to the other has the mean of both headings.
        """
        turn = np.remainder(heading[other] - heading[one] + np.pi, 2 * np.pi) - np.pi
        right = self._right_of(one, other, heading[one] + 0.5 * turn)
        is_near = np.abs(self.position[other] - self.position[one]) < _NEAR_M
        return np.where(is_near | (np.abs(turn) < _STRAIGHT), right, 0.0)

    def _right_of(self, one: Ints, other: Ints, heading: Floats) -> Floats:
        """Returns how far the other is to the right of a line through one, m."""
        right: Floats = (self.x[other] - self.x[one]) * np.cos(heading)
        return right - (self.y[other] - self.y[one]) * np.sin(heading)

    def _couple(self, one: Ints, other: Ints) -> Ints:
        """Returns one number for two vehicles, whichever is first, and the lane they are in."""
        count = int(self.vehicle.max(initial=0)) + 1
        first = np.minimum(self.vehicle[one], self.vehicle[other])
        second = np.maximum(self.vehicle[one], self.vehicle[other])
        both: Ints = (self.lane[one] * count + first) * count + second
        return both

    def next_in_lane(self, beside: Callable[[Ints, Ints], tracks.Marks]) -> Ints:
        """Returns the next vehicle ahead in each row's lane that is not beside, 0 for none."""
        leader = np.zeros(len(self.vehicle), dtype=np.int64)
        is_open = np.ones(len(self.vehicle), dtype=bool)
        for step in range(1, len(self.vehicle)):
            behind, ahead = self._neighbours(step)
            still = is_open[behind]
            behind, ahead = behind[still], ahead[still]
            if not len(behind):
                break
            is_next = ~beside(behind, ahead)
            leader[behind[is_next]] = self.vehicle[ahead[is_next]]
            is_open[behind[is_next]] = False
        return leader

    @cached_property
    def _order(self) -> Ints:
        """The rows by frame, lane and position."""
        return np.lexsort((self.position, self.lane, self.frame))

    def _neighbours(self, step: int) -> tuple[Ints, Ints]:
        """Returns rows, and those `step` vehicles ahead of them in the same lane and frame."""
        behind, ahead = self._order[:-step], self._order[step:]
        same = self.frame[behind] == self.frame[ahead]
        same &= self.lane[behind] == self.lane[ahead]
        return behind[same], ahead[same]

    def rows_of(self, leader: Ints) -> tuple[Ints, tracks.Marks]:
        """Returns the rows of leaders `(N,)` at each row's frame, and whether there is one."""
        frames = int(self.frame.max()) + 1
        keys = self.vehicle * frames + self.frame
        at = np.minimum(np.searchsorted(keys, leader * frames + self.frame), len(keys) - 1)
        is_there = (self.vehicle[at] == leader) & (self.frame[at] == self.frame)
        return at, is_there & (leader != tracks.NOBODY)

    def driven(self, dt: float) -> Floats:
        """Returns the distance that each vehicle has driven since its first row, m.

        SUMO moves vehicles by their new speed (Euler) or by the mean of the old and the new one
        (ballistic); what the positions within lanes agree with better holds for all.
        """
        starts = self.starts
        before = np.append(self.speed[:1], self.speed[:-1])
        euler, ballistic = self.speed * dt, 0.5 * (before + self.speed) * dt
        within = np.flatnonzero(~tracks.changes(self.vehicle, self.lane))
        moved = self.position[within] - self.position[within - 1]
        steps = euler
        if np.abs(moved - ballistic[within]).sum() < np.abs(moved - euler[within]).sum():
            steps = ballistic
        total = np.cumsum(np.where(starts, 0.0, steps))
        vehicle = np.cumsum(starts) - 1
        driven: Floats = total - total[starts][vehicle]
        return driven

    def lane_stints(self, lanes: NDArray[np.str_]) -> Ints:
        """Returns a number that changes where a vehicle goes to another lane of the same edge."""
        edges = [name.rpartition("_")[0] for name in lanes.tolist()]
        _, edge = np.unique(np.array(edges), return_inverse=True)
        here = edge[self.lane]
        changed = np.zeros(len(here), dtype=bool)
        changed[1:] = (here[1:] == here[:-1]) & (self.lane[1:] != self.lane[:-1])
        return np.cumsum(changed & ~self.starts)

    def lengths(self, leader: Ints, gap: Floats, default: Floats) -> Floats:
        """Returns vehicles' lengths by gaps to them from within their own lane, m.

        Args:
            default: of vehicles that nobody follows in their own lane.
        """
        at, is_there = self.rows_of(leader)
        is_known = is_there & (self.lane[at] == self.lane)
        left = (self.position[at] - self.position - gap)[is_known]
        followed = leader[is_known]
        order = np.lexsort((left, followed))
        starts = np.flatnonzero(tracks.changes(followed[order]))
        sizes = np.diff(np.append(starts, len(order)))
        medians = left[order][starts + sizes // 2]
        by_vehicle = np.full(int(self.vehicle.max(initial=0)) + 1, np.nan)
        by_vehicle[followed[order][starts]] = np.where(medians > 0, np.round(medians, 1), np.nan)
        measured = by_vehicle[self.vehicle]
        return np.where(np.isnan(measured), default, measured)

    def accelerations(self, given: Floats, dt: float) -> Floats:
        """Returns accelerations as SUMO wrote them; where it wrote none, by the last step's."""
        change = np.zeros(len(self.speed))
        change[1:] = np.where(self.starts[1:], 0.0, np.diff(self.speed) / dt)
        return np.where(np.isnan(given), change, given)
