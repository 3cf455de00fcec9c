"""SUMO's floating car data: what `sumo --fcd-output FILE` writes.

https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cfx.errors import DataError, listed
from cfx.plugin import (
    Dataset,
    FileDatasetSettings,
    FileStart,
    Floats,
    Ints,
    PairSet,
    Remark,
    Settings,
    Tracks,
    extract_pairs,
    joined,
    remarks_on_leaders,
    statements,
    stem,
    tracks,
)
from cfx_sumo.fcd_lanes import Couples, Lanes
from cfx_sumo.fcd_rows import FcdRows, is_fcd, read_rows

log = logging.getLogger(__name__)

_ROUNDING = 0.02
"""m and m/s: by how much two numbers that SUMO writes with two decimals may differ."""

_MISSING = 0.05
"""Share of the vehicles of flows whose numbers are left out, from which on it is said."""

_LONGEST = 100
"""A flow whose numbers go farther than so many times the vehicles that are recorded is none."""

_LENGTH_IS_SUMOS = frozenset({"DEFAULT_VEHTYPE"})
"""vTypes that nobody declared: 5 m long, as SUMO says."""


class SumoFcdSettings(FileDatasetSettings):
    """How to read SUMO's floating car data."""

    max_gap: float | None = Field(
        120.0, gt=0, description="m: farther vehicles are no leaders; null: all are"
    )
    length: float = Field(
        5.0, gt=0, le=100, description="m: of vehicles whose length nothing in the file gives"
    )
    lengths: dict[str, Annotated[float, Field(gt=0, le=100)]] | None = Field(
        None, description="m: of vehicles by their vType, for instance {truck: 12.0}"
    )
    width: float = Field(
        1.8,
        gt=0,
        le=10,
        description="m: vehicles in one lane that are farther apart sideways drive side by side"
        " (SUMO's sublane model)",
    )


class SumoFcdDataset(Dataset):
    """Pairs from what SUMO writes with `--fcd-output`: XML or CSV, gzipped or not, or parquet.

    With `--fcd-output.max-leader-distance` SUMO writes who the leader is and the bumper-to-bumper
    gap, on the next edge too. Pairs then go on over junctions, and vehicles' lengths follow from
    gaps and positions. Without it the leader is the next vehicle in the same lane, so that pairs
    end where an edge does, and lengths are those of `length` and `lengths`.

    Pairs are cut by `cfx.data.tracks.extract_pairs`. Another lane of the same edge is a lane
    change; another edge is none. Where SUMO wrote no `acceleration` it is the change of speed over
    the last step, as SUMO defines it. `driver_type` is the vType; of a vehicle whose type SUMO made
    its own (`truck@t.0` after `setTau`), the type that it had before.

    Some vehicles follow nobody, nor does anybody follow them, though SUMO writes them in a lane:

    - one that is parked: it stands while others drive through it, or (by `x` and `y`) beside the
      lane;
    - one that drives against the lane's direction, to overtake where others come towards it.

    Their rows are left out and counted. Of vehicles in one lane that drive side by side (the
    sublane model) neither follows the other: those that are `width` apart by `posLat`, or by `x`,
    `y` and `angle`. A file that has neither does not say so; vehicles that pass each other in one
    lane are then no pair there.

    SUMO writes two decimals unless `--precision` says more: speeds are then rounded to 0.01 m/s,
    and accelerations that follow from them in steps of 0.1 s to 0.1 m/s2.
    """

    layout = "SUMO's FCD output (m)"
    schema: ClassVar[type[Settings]] = SumoFcdSettings
    settings: SumoFcdSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        return is_fcd(start)

    def read(self) -> PairSet:
        parts = []
        for path in self.settings.files():
            vehicles = _tracks(read_rows(path), self.settings)
            parts.append(extract_pairs(vehicles, max_gap=self.settings.max_gap))
        return joined(parts)


def _tracks(rows: FcdRows, settings: SumoFcdSettings) -> Tracks:
    """Returns the vehicles' rows in order, with their leaders."""
    dt = _step(rows)
    names, vehicle = np.unique(rows.texts["id"], return_inverse=True)
    vehicle = vehicle + 1
    frame = np.rint(rows.times / dt).astype(np.int64)[rows.step]
    order = np.lexsort((frame, vehicle))
    edges, lane = np.unique(rows.texts["lane"], return_inverse=True)
    numbers = {key: values[order] for key, values in rows.numbers.items()}
    every = Lanes(
        vehicle=vehicle[order],
        frame=frame[order],
        lane=lane[order],
        position=numbers["pos"],
        speed=numbers["speed"],
        lateral=numbers["posLat"],
        x=numbers["x"],
        y=numbers["y"],
        heading=np.radians(numbers["angle"]),
    )
    acceleration = every.accelerations(numbers["acceleration"], dt)
    remarks = _empty_accelerations(numbers["acceleration"])
    is_oncoming = every.is_oncoming(dt)
    couples = _without(every.passes(), is_oncoming)
    is_parked = every.is_parked(couples) & ~is_oncoming
    kept = np.flatnonzero(~is_oncoming & ~is_parked)
    couples = _at(_without(couples, is_parked), kept)
    order = order[kept]
    lanes = every.take(kept)
    beside = lanes.beside(couples, settings.width)
    leader = lanes.next_in_lane(beside)
    types, kind = _types(rows)
    kind = kind[order]
    lengths_of = settings.lengths or {}
    length = np.array([lengths_of.get(name, settings.length) for name in types])[kind]
    position, number_of_lane = lanes.position, lanes.lane
    gap: Floats | None = None
    if bool(np.isnan(rows.numbers["leaderGap"]).all()):
        _warn_of_lengths(rows, types, settings)
    else:
        number_of = {name: number + 1 for number, name in enumerate(names.tolist())}
        named = [
            number_of.get(name, tracks.NOBODY) for name in rows.texts["leaderID"][order].tolist()
        ]
        by_name = _Ahead(np.array(named), numbers["leaderGap"][kept], length)
        remarks += statements.remarks_of(
            _said_twice(lanes, by_name, numbers["leaderSpeed"][kept], dt)
        )
        leader, gap, length = _as_named(lanes, by_name, leader, beside)
        position = lanes.driven(dt)
        number_of_lane = lanes.lane_stints(edges)
    left_out = {
        "driving against its lane's direction": is_oncoming,
        "parked beside the lane": is_parked,
    }
    vehicles = Tracks(
        source=str(rows.path),
        dt=dt,
        recordings=(stem(rows.path),),
        recording=np.zeros(len(order), dtype=np.int64),
        vehicle=lanes.vehicle,
        frame=lanes.frame,
        lane=number_of_lane,
        leader=leader,
        position=position,
        speed=lanes.speed,
        acceleration=acceleration[kept],
        length=length,
        gap=gap,
        driver_type=kind,
        driver_types=types,
        ids_are_unique=True,
        names=("", *names.tolist()),
        dropped=(*rows.dropped, *tracks.count_reasons(left_out, "rows")),
        remarks=remarks,
    )
    if gap is not None:
        return vehicles
    doubts = (*_missing_of_flows(names), *remarks_on_leaders(vehicles))
    return replace(vehicles, remarks=(*remarks, *doubts))


def _empty_accelerations(recorded: Floats) -> tuple[Remark, ...]:
    """Returns that some rows have no acceleration, in a file that has them."""
    empty = int(np.count_nonzero(np.isnan(recorded)))
    if empty in {0, len(recorded)}:
        return ()
    return (
        Remark(
            f"{empty:,} of {len(recorded):,} rows have no acceleration: the change of speed over"
            " the last step stands for it"
        ),
    )


def _missing_of_flows(names: NDArray[np.str_]) -> tuple[Remark, ...]:
    """Returns that vehicles of flows are not recorded: SUMO numbers them `NAME.0`, `NAME.1`, ..."""
    flows: dict[str, list[int]] = {}
    for name in names.tolist():
        flow, _, number = name.rpartition(".")
        if flow and number.isdecimal():
            flows.setdefault(flow, []).append(int(number))
    examples: list[str] = []
    departed = recorded = 0
    for flow, numbers in flows.items():
        span = max(numbers) - min(numbers) + 1
        if span > _LONGEST * len(numbers):
            continue  # such numbers mean something else
        departed += span
        recorded += len(numbers)
        for number in sorted(set(range(min(numbers), max(numbers))) - set(numbers)):
            examples.append(f"{flow}.{number}")
    if departed - recorded < max(1.0, _MISSING * departed):
        return ()
    return (
        Remark(
            f"{departed - recorded} of {departed} vehicles of flows are not in it"
            f" ({listed(examples, 3)}): who drives behind one of them counts as following somebody"
            " else; record all vehicles (no --device.fcd.probability), or let SUMO write leaders"
            " (--fcd-output.max-leader-distance 200)"
        ),
    )


def _said_twice(
    lanes: Lanes, named: _Ahead, leader_speed: Floats, dt: float
) -> Iterator[statements.Statement]:
    """Yields what SUMO says of leaders that follows from their own rows too."""
    at, is_there = lanes.rows_of(named.leader)
    speed = np.where(is_there, lanes.speed[at], np.nan)
    yield statements.Statement(
        "leaderSpeed", leader_speed, [speed], "the leader's speed", _ROUNDING
    )
    # Vehicles' lengths are not in the file, so changes are compared, over a second.
    between = np.where(is_there, lanes.position[at] - lanes.position, np.nan)
    later = max(1, round(1.0 / dt))
    if len(between) <= later:
        return
    same = np.ones(len(between) - later, dtype=bool)
    for key in (lanes.vehicle, named.leader, lanes.lane, lanes.lane[at]):
        same &= key[later:] == key[:-later]
    same &= (lanes.lane[at] == lanes.lane)[later:]
    same &= lanes.frame[later:] - lanes.frame[:-later] == later
    said = np.where(same, named.gap[later:] - named.gap[:-later], np.nan)
    follows = np.where(same, between[later:] - between[:-later], np.nan)
    basis = "pos of a vehicle and its leader"
    yield statements.Statement("the change of leaderGap", said, [follows], basis, 2 * _ROUNDING)


def _types(rows: FcdRows) -> tuple[tuple[str, ...], Ints]:
    """Returns the vTypes, and `(N,)` which each row has; of a vehicle's own, where it came from."""
    kinds = []
    for name, kind in zip(rows.texts["id"].tolist(), rows.texts["type"].tolist(), strict=True):
        kinds.append(kind.removesuffix(f"@{name}"))
    types, kind = np.unique(np.array(kinds), return_inverse=True)
    return tuple(types.tolist()), kind


def _warn_of_lengths(rows: FcdRows, types: tuple[str, ...], settings: SumoFcdSettings) -> None:
    """Warns of vTypes whose length is nothing but the default: their gaps may be wrong."""
    has_length = _LENGTH_IS_SUMOS | set(settings.lengths or {})
    guessed = [name for name in types if name not in has_length]
    if guessed:
        log.warning(
            "%s does not say how long vehicles are: those of type %s count as %g m, and gaps behind"
            " them are off by the difference; give 'data.lengths={%s: METRES}', or let SUMO write"
            " leaders (--fcd-output.max-leader-distance 200)",
            rows.path,
            listed(guessed, 5),
            settings.length,
            guessed[-1],
        )


def _without(couples: Couples, left_out: tracks.Marks) -> Couples:
    """Returns the couples neither of whose rows is left out."""
    kept = ~left_out[couples.passed] & ~left_out[couples.passing]
    return Couples(couples.passed[kept], couples.passing[kept])


def _at(couples: Couples, kept: Ints) -> Couples:
    """Returns couples as indices into the rows that are kept, `(M,)` ascending."""
    return Couples(np.searchsorted(kept, couples.passed), np.searchsorted(kept, couples.passing))


class _Ahead(NamedTuple):
    """The leader of each row, the gap to it and the row's own vehicle's length, `(N,)` each."""

    leader: Ints
    gap: Floats
    length: Floats


def _as_named(
    lanes: Lanes, named: _Ahead, by_place: Ints, beside: Callable[[Ints, Ints], tracks.Marks]
) -> _Ahead:
    """Returns the leaders that SUMO names, and vehicles' lengths as they follow from its gaps.

    SUMO names the next vehicle in the lane even where it drives beside: there the leader is that of
    `by_place`.
    """
    leader = named.leader.copy()
    length = lanes.lengths(leader, named.gap, named.length)
    at, is_there = lanes.rows_of(leader)
    same = np.flatnonzero(is_there & (lanes.lane[at] == lanes.lane))
    wrong = same[beside(same, at[same])]
    leader[wrong] = by_place[wrong]
    at, _ = lanes.rows_of(leader)
    gap = named.gap.copy()
    gap[wrong] = (lanes.position[at] - length[at] - lanes.position)[wrong]
    return _Ahead(leader, np.where(leader == tracks.NOBODY, np.nan, gap), length)


def _step(rows: FcdRows) -> float:
    """Returns the time step, s; raises DataError where steps differ."""
    steps = np.diff(rows.times)
    if not len(steps) or not bool((steps > 0).all()):
        raise DataError(f"{rows.path}: the times of its steps do not advance")
    usual = float(np.median(steps))
    whole = steps / usual
    if float(np.abs(whole - np.rint(whole)).max()) > 0.05:
        raise DataError(
            f"{rows.path}: its time steps differ ({steps.min():g} to {steps.max():g} s); a"
            " recording has one"
        )
    return round(usual, 6)
