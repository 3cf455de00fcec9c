"""A tidy file with a column of gaps: the columns that follow from it and from the speeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cfx.core.errors import DataError
from cfx.data.files import Floats, Ints
from cfx.data.series import accelerations, driven
from cfx.data.tidy_table import GAP, LENGTH, TidyTable

_AGREE_M = 0.5
"""How far a gap may be from that between the positions; beyond it one of them is wrong."""


def time_steps(time: Floats, starts: Ints) -> Floats:
    """Returns the mean time step of each pair, s.

    Args:
        time: of the rows in order, s.
        starts: where each pair begins.
    """
    ends = np.append(starts[1:], len(time)) - 1
    mean: Floats = (time[ends] - time[starts]) / (ends - starts)
    return mean


def with_positions(table: TidyTable, order: Ints, starts: Ints) -> TidyTable:
    """Returns a table that has every column, by its gaps.

    An absent length is 0, so that the leader's position is that of its rear bumper; it follows from
    the gap where both positions are there. An absent leader's position follows from the follower's,
    or from the leader's speed. An absent follower's position follows from the gap. Absent
    accelerations are differences of speeds.

    Raises:
        DataError: the gaps contradict the positions.
    """
    numbers = dict(table.numbers)
    steps = time_steps(numbers["time_s"][order], starts)
    gap = numbers[GAP]
    has_both = {"leader_position_m", "follower_position_m"} <= numbers.keys()
    if LENGTH not in numbers:
        numbers[LENGTH] = np.zeros(len(table))
        if has_both:
            numbers[LENGTH] = _lengths(numbers, order, starts)
    if "leader_position_m" not in numbers:
        if "follower_position_m" in numbers:
            rear = numbers["follower_position_m"] + gap
        else:
            rear = _by_pair(driven, numbers["leader_speed_mps"], order, starts, steps)
        numbers["leader_position_m"] = rear + numbers[LENGTH]
    rear = numbers["leader_position_m"] - numbers[LENGTH]
    if "follower_position_m" not in numbers:
        numbers["follower_position_m"] = rear - gap
    for who in ("leader", "follower"):
        name = f"{who}_acceleration_mps2"
        if name not in numbers:
            speed = numbers[f"{who}_speed_mps"]
            numbers[name] = _by_pair(accelerations, speed, order, starts, steps)
    complete = replace(table, numbers=numbers)
    _check_agreement(complete)
    return complete


def _lengths(numbers: dict[str, Floats], order: Ints, starts: Ints) -> Floats:
    """Returns each pair's median of what its positions leave over beside the gap, `(N,)`."""
    left = numbers["leader_position_m"] - numbers["follower_position_m"] - numbers[GAP]
    result = np.empty_like(left)
    for rows in np.split(order, starts[1:]):
        result[rows] = np.median(left[rows])
    return result


def _by_pair(
    function: Callable[[Floats, float], Floats],
    values: Floats,
    order: Ints,
    starts: Ints,
    steps: Floats,
) -> Floats:
    """Returns what a function of values over time and a time step makes of each pair, `(N,)`."""
    result = np.empty_like(values)
    for rows, step in zip(np.split(order, starts[1:]), steps.tolist(), strict=True):
        result[rows] = function(values[rows], step)
    return result


def _check_agreement(table: TidyTable) -> None:
    """Raises DataError where positions and lengths make another gap than the file says."""
    numbers = table.numbers
    between = numbers["leader_position_m"] - numbers[LENGTH] - numbers["follower_position_m"]
    at = np.flatnonzero(np.abs(between - numbers[GAP]) > _AGREE_M)
    if len(at):
        raise DataError(
            f"{table.at(at[0], GAP)}: is {numbers[GAP][at[0]]:.2f} m, but the positions and"
            f" {LENGTH} make it {between[at[0]]:.2f} m ({len(at)} such rows); leave out the columns"
            f" that are less exact: the positions, or {GAP}"
        )
