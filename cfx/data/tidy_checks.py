"""Checks the relations between rows of a tidy file; each error is a sentence with the row.

What single cells may hold is declared in `cfx.data.tidy.LAYOUT`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.data.cells import NameColumn
from cfx.data.files import Floats, Ints
from cfx.data.kinematics import contradiction
from cfx.data.pairs import Pair
from cfx.data.table import Table
from cfx.data.tracks import accelerations, distance_driven
from cfx.errors import DataError

log = logging.getLogger(__name__)

Marks = NDArray[np.bool_]

GAP, LENGTH, LANE = "gap_m", "leader_length_m", "lane"
TRUE = "true_"
"""What the columns of true parameters begin with."""

_AGREE_M = 0.5
"""How far a gap may be from that between the positions; beyond it one of them is wrong."""


def check(table: Table) -> tuple[Table, Ints, Ints]:
    """Checks everything that the layout asks for.

    Returns:
        The table, completed where columns were left out; the order `(N,)` that
        sorts the rows by pair (as they first appear) and frame; and where in it each pair begins.

    Raises:
        DataError: names file, row and column.
    """
    table = _with_frames_by_1(_with_names_and_frames(table))
    order, starts = _check_frames(table)
    _check_pairs(table, order, starts)
    if GAP in table.numbers:
        table = with_positions(table, order, starts)
    return table, order, starts


def _with_names_and_frames(table: Table) -> Table:
    """Returns a table that says of what recording, who, behind whom and when each row is."""
    labels, numbers = dict(table.labels), dict(table.numbers)
    pair = labels["pair_id"]
    if "recording" not in labels:
        name = Path(table.source).name.partition(".")[0]
        labels["recording"] = NameColumn(np.zeros(len(table), dtype=np.int64), [name])
    if "follower_id" not in labels:
        log.warning(
            "%s: without a column %s each pair counts as a driver of its own",
            table.source,
            table.title("follower_id"),
        )
        labels["follower_id"] = pair
    if "leader_id" not in labels:
        labels["leader_id"] = NameColumn(pair.codes, [f"ahead of {name}" for name in pair.names])
    if "frame" not in numbers:
        time = numbers["time_s"]
        order = np.lexsort((time, pair.codes))
        starts = np.flatnonzero(np.append(True, np.diff(pair.codes[order]) != 0))
        sizes = _sizes(order, starts)
        steps = time_steps(time[order], starts)
        # Single rows and repeated times, which are refused, have no step.
        first = np.round(time[order][starts] / np.where(steps > 0, steps, 1.0))
        numbers["frame"] = np.empty(len(table))
        within = np.arange(len(table)) - np.repeat(starts, sizes)
        numbers["frame"][order] = np.repeat(first, sizes) + within
    return replace(table, labels=labels, numbers=numbers)


def _with_frames_by_1(table: Table) -> Table:
    """Returns a table whose frames follow by 1, where all of them are the same number apart."""
    frame, pair = table.numbers["frame"], table.labels["pair_id"].codes
    order = np.lexsort((frame, pair))
    within = np.diff(pair[order]) == 0
    steps = np.diff(frame[order])[within]
    if not len(steps) or steps[0] < 2 or (steps != steps[0]).any():
        return table
    return replace(table, numbers={**table.numbers, "frame": np.floor(frame / steps[0])})


def _check_frames(table: Table) -> tuple[Ints, Ints]:
    """Checks that frames are consecutive and the time step is constant; returns as `check`."""
    frame, pair = table.numbers["frame"], table.labels["pair_id"].codes
    order = np.lexsort((frame, pair))
    is_new = np.append(True, np.diff(pair[order]) != 0)
    starts = np.flatnonzero(is_new)
    step = np.diff(frame[order])
    within = ~is_new[1:]

    twice = np.flatnonzero(within & (step == 0))
    if len(twice):
        a, b = sorted((order[twice[0]], order[twice[0] + 1]))
        raise DataError(
            f"{table.at(b)}: the same pair and frame as row {table.row(a)}"
            f" ({len(twice)} such rows); keep one of them"
        )
    jumps = np.flatnonzero(within & (step != 1))
    if len(jumps):
        last = frame[order[jumps[0]]]
        raise DataError(
            f"{table.at(order[jumps[0] + 1])}: the frame before is {last:g}, so frames are missing"
            f" ({len(jumps)} such gaps in all); cut the pair in two there, with two pair ids, or"
            " fill the gap"
        )
    short = np.flatnonzero(_sizes(order, starts) < 2)
    if len(short):
        raise DataError(
            f"{table.at(order[starts[short[0]]])}: the pair has a single frame"
            f" ({len(short)} such pairs); leave it out"
        )
    _check_time(table, order, starts, within)
    return order, starts


def _sizes(order: Ints, starts: Ints) -> Ints:
    """Returns how many frames each pair has."""
    return np.diff(np.append(starts, len(order)))


def _check_time(table: Table, order: Ints, starts: Ints, within: Marks) -> None:
    """Checks that time advances by a constant step within a pair.

    Args:
        within: whether a row is of the same pair as the row before, for all but the first.
    """
    time = table.numbers["time_s"][order]
    steps = np.diff(time)
    usual = np.repeat(time_steps(time, starts), _sizes(order, starts))[1:]
    back = np.flatnonzero(within & (steps <= 0))
    if len(back):
        raise DataError(
            f"{table.at(order[back[0] + 1], 'time_s')}: time does not advance from the frame"
            " before; it must, by a constant step"
        )
    odd = np.flatnonzero(within & (np.abs(steps - usual) > 0.05 * usual))
    if len(odd):
        raise DataError(
            f"{table.at(order[odd[0] + 1], 'time_s')}: the time step is {steps[odd[0]]:.6g} s here"
            f" and {usual[odd[0]]:.6g} s on average ({len(odd)} such steps); it must be constant"
            " within a pair: resample the pair, or split it"
        )


def _check_pairs(table: Table, order: Ints, starts: Ints) -> None:
    """Raises DataError if what describes a pair as a whole changes within it."""
    first = np.repeat(order[starts], _sizes(order, starts))
    described: dict[str, NDArray[Any]] = {}
    for name, labels in table.labels.items():
        if name != "pair_id":
            described[name] = labels.codes
    for name in (LENGTH, LANE):
        if name in table.numbers:
            described[name] = table.numbers[name]
    for name, values in described.items():
        differs = values[order] != values[first]
        if values.dtype.kind == "f":
            differs &= ~(np.isnan(values[order]) & np.isnan(values[first]))
        at = np.flatnonzero(differs)
        if len(at):
            raise DataError(
                f"{table.at(order[at[0]], name)}: differs from the pair's first row; a pair is one"
                " follower behind one leader in one recording and lane: give each stretch its own"
                " pair id"
            )
    for name in table.numbers:
        if not name.startswith(TRUE):
            continue
        unknown = np.isnan(table.numbers[name])
        at = np.flatnonzero(unknown[order] != unknown[first])
        if len(at):
            raise DataError(
                f"{table.at(order[at[0]], name)}: the true parameter is known in a part of the pair"
                " only; give it in every row"
            )


def check_gap(table: Table, pairs: Sequence[Pair]) -> None:
    """Raises DataError if a leader is not ahead of its follower.

    Args:
        pairs: those of the table; if one of them contradicts itself, that may be why.
    """
    rear = table.numbers["leader_position_m"] - table.numbers[LENGTH]
    gap = rear - table.numbers["follower_position_m"]
    at = np.flatnonzero(~(gap > 0))
    if not len(at):
        return
    name = table.labels["pair_id"].at(int(at[0]))
    remedy = f"cut the pair there, or correct positions and {table.title(LENGTH)}"
    for pair in pairs:
        if pair.pair_id == name:
            why = contradiction(pair)
            if why is not None:
                remedy = f"perhaps this is why: {why.text()}"
            break
    raise DataError(
        f"{table.at(at[0])}: the leader is behind its follower, or overlaps it: the gap is"
        f" {gap[at[0]]:.2f} m ({len(at)} such rows); {remedy}"
    )


# --- a column of gaps in place of lengths, positions and accelerations ---------------------------


def time_steps(time: Floats, starts: Ints) -> Floats:
    """Returns the mean time step of each pair, s.

    Args:
        time: of the rows in order, s.
        starts: where each pair begins.
    """
    ends = np.append(starts[1:], len(time)) - 1
    mean: Floats = (time[ends] - time[starts]) / np.maximum(ends - starts, 1)
    return mean


def with_positions(table: Table, order: Ints, starts: Ints) -> Table:
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
            rear = _by_pair(distance_driven, numbers["leader_speed_mps"], order, starts, steps)
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
    """Returns the length of each row's leader, `(N,)`, m: the median over the rows of its pair.

    It is what the distance of the front bumpers leaves over beside the gap.
    """
    lengths = numbers["leader_position_m"] - numbers["follower_position_m"] - numbers[GAP]
    medians = np.empty_like(lengths)
    for rows in np.split(order, starts[1:]):
        medians[rows] = np.median(lengths[rows])
    return medians


def _by_pair(
    function: Callable[[Floats, float], Floats],
    values: Floats,
    order: Ints,
    starts: Ints,
    steps: Floats,
) -> Floats:
    """Applies a function of values over time and a time step to each pair, `(N,)`."""
    result = np.empty_like(values)
    for rows, step in zip(np.split(order, starts[1:]), steps.tolist(), strict=True):
        result[rows] = function(values[rows], step)
    return result


def _check_agreement(table: Table) -> None:
    """Raises DataError where positions and lengths make another gap than the file says."""
    numbers = table.numbers
    between = numbers["leader_position_m"] - numbers[LENGTH] - numbers["follower_position_m"]
    at = np.flatnonzero(np.abs(between - numbers[GAP]) > _AGREE_M)
    if len(at):
        raise DataError(
            f"{table.at(at[0], GAP)}: is {numbers[GAP][at[0]]:.2f} m, but the positions and"
            f" {table.title(LENGTH)} make it {between[at[0]]:.2f} m ({len(at)} such rows);"
            f" leave out the columns that are less exact: the positions, or {table.title(GAP)}"
        )
