"""What a tidy file must hold, each broken rule a sentence with its row; see `cfx.data.tidy`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.core.errors import DataError
from cfx.data.files import Ints, bad_cells
from cfx.data.tidy_gaps import time_steps, with_positions
from cfx.data.tidy_table import GAP, LABELS, LANE, LENGTH, NUMBERS, TidyTable

Marks = NDArray[np.bool_]

_FACTORS = {
    1 / 0.3048: "the positions look like feet; multiply them by 0.3048",
    0.3048: "the speeds look like feet per second; multiply them by 0.3048",
    1 / 3.6: "the speeds look like km/h; divide them by 3.6",
    0.44704: "the speeds look like miles per hour; multiply them by 0.44704",
    1000.0: "the positions look like millimetres or the speeds like km/s; write m and m/s",
    100.0: "the positions look like centimetres; divide them by 100",
    0.001: "the times look like milliseconds, or the positions like kilometres; write s and m",
}
"""Distance over speed times time, if one of them has another unit than it should."""

_TOO_LITTLE_M = 10.0
"""Distance below which positions and speeds cannot be compared."""


def check(table: TidyTable) -> tuple[TidyTable, Ints, Ints]:
    """Checks everything that the layout asks for.

    Returns:
        The table, completed where it has gaps in place of other columns; the order `(N,)` that
        sorts the rows by pair (as they first appear) and frame; and where in it each pair begins.

    Raises:
        DataError: names file, row and column.
    """
    _check_cells(table)
    order, starts = _check_frames(table)
    _check_pairs(table, order, starts)
    if GAP in table.numbers:
        table = with_positions(table, order, starts)
    _check_motion(table, order, starts)
    _check_gap(table)
    return table, order, starts


def _check_cells(table: TidyTable) -> None:
    """Raises DataError for an empty name, and for a cell that is no finite or possible number."""
    for name in LABELS:
        empty = np.flatnonzero(table.labels[name].codes < 0)
        if len(empty):
            raise DataError(
                f"{table.at(empty[0], name)}: the cell is empty ({len(empty)} such cells);"
                " give a name"
            )
    numbers = table.numbers
    for name in (*NUMBERS, GAP):
        if name not in numbers:
            continue
        bad = bad_cells(numbers[name])
        if bad is not None:
            index, count, what = bad
            raise DataError(
                f"{table.at(index, name)}: is {what} ({count} such cells in this column);"
                " correct it or leave out the pair"
            )
    is_broken = numbers["frame"] != np.floor(numbers["frame"])
    _reject(table, "frame", is_broken, "is no whole number; number the frames 0, 1, 2, ...")
    for name in ("leader_speed_mps", "follower_speed_mps"):
        why = "is negative; speeds count along the lane and must be 0 or more"
        _reject(table, name, numbers[name] < 0, why)
    if LENGTH in numbers:
        why = "is no vehicle length; give metres, or 0 where positions are of rear bumpers"
        _reject(table, LENGTH, numbers[LENGTH] < 0, why)


def _reject(table: TidyTable, name: str, wrong: Marks, why: str) -> None:
    """Raises DataError if any cell of a column is wrong; names the first."""
    at = np.flatnonzero(wrong)
    if not len(at):
        return
    text = f"{table.at(at[0], name)}: {table.numbers[name][at[0]]:g} {why}"
    if len(at) > 1:
        text += f" ({len(at)} such cells)"
    raise DataError(text)


def _check_frames(table: TidyTable) -> tuple[Ints, Ints]:
    """Checks that frames are consecutive and the time step is constant.

    Returns:
        As `check`.
    """
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
            f"{table.at(b)}: the same pair and frame as row {int(a) + table.first_row}"
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


def _check_time(table: TidyTable, order: Ints, starts: Ints, within: Marks) -> None:
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


def _check_pairs(table: TidyTable, order: Ints, starts: Ints) -> None:
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
    for name in table.truth_names:
        unknown = np.isnan(table.numbers[name])
        at = np.flatnonzero(unknown[order] != unknown[first])
        if len(at):
            raise DataError(
                f"{table.at(order[at[0]], name)}: the true parameter is known in a part of the pair"
                " only; give it in every row"
            )
    if LANE in table.numbers:
        lane = table.numbers[LANE]
        is_broken = ~np.isnan(lane) & ~(np.isfinite(lane) & (lane == np.floor(lane)))
        _reject(table, LANE, is_broken, "is no lane number")


def _check_motion(table: TidyTable, order: Ints, starts: Ints) -> None:
    """Raises DataError if positions and speeds do not belong together."""
    within = np.ones(len(order), dtype=bool)
    within[starts] = False
    time = table.numbers["time_s"][order]
    for who in ("leader", "follower"):
        position = table.numbers[f"{who}_position_m"][order]
        speed = table.numbers[f"{who}_speed_mps"][order]
        moved = float(np.diff(position)[within[1:]].sum())
        expected = float((0.5 * (speed[1:] + speed[:-1]) * np.diff(time))[within[1:]].sum())
        if expected < _TOO_LITTLE_M and abs(moved) < _TOO_LITTLE_M:
            continue
        ratio = math.inf
        if expected > 0:
            ratio = moved / expected
        if not 0.8 < ratio < 1.25:
            raise DataError(
                f"{table.source}, columns {who}_position_m and {who}_speed_mps: the distance driven"
                f" is {ratio:.3g} times speed times time: {_likely_reason(ratio)}"
            )


def _likely_reason(ratio: float) -> str:
    """Returns why positions and speeds do not belong together, from how much they differ."""
    for factor, text in _FACTORS.items():
        if abs(ratio / factor - 1) < 0.05:
            return text
    if ratio < 0:
        return "positions must grow along the lane"
    return "positions must be in m, speeds in m/s and times in s"


def _check_gap(table: TidyTable) -> None:
    """Raises DataError if a leader is not ahead of its follower."""
    rear = table.numbers["leader_position_m"] - table.numbers["leader_length_m"]
    gap = rear - table.numbers["follower_position_m"]
    at = np.flatnonzero(~(gap > 0))
    if len(at):
        raise DataError(
            f"{table.at(at[0])}: the leader is behind its follower, or overlaps it: the gap is"
            f" {gap[at[0]]:.2f} m ({len(at)} such rows); cut the pair there, or correct positions"
            " and leader_length_m"
        )
