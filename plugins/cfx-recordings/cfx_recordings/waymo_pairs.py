"""Car-following pairs of the Waymo Open Dataset, as its extractors published them.

X. Hu, Z. Zheng, D. Chen, X. Zhang and J. Sun (2022), Processing, assessing, and enhancing the Waymo
autonomous vehicle open dataset for driving behavior research, Transportation Research Part C 134,
103490; Mendeley Data, 10.17632/wfn2c3437n.2, CC BY 4.0.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from cfx.errors import DataError
from cfx.plugin import (
    Contents,
    Dataset,
    Dropped,
    FileColumn,
    FileDatasetSettings,
    FileStart,
    Floats,
    Ints,
    Layout,
    PairSet,
    Settings,
    Table,
    joined,
    read_table,
    statements,
    stem,
    tracks,
)
from cfx_recordings.series import Series, frames_at, pairs_of

DT = 0.1
"""Seconds between two rows of a vehicle."""

AUTOMATED = 0
"""Number of Waymo's own vehicle in every segment."""

_TIME, _LENGTH = "local_time", "length"

_OTHER_SPEEDS = ("position_based_speed", "speed_based_speed")
"""Speeds of other estimates: they are compared with the one that is used, where they are there."""


def _motion(name: str, earlier: str, unit: str) -> FileColumn:
    return FileColumn(name, unit, spellings=(earlier,), may_be_empty=True)


_LAYOUT = Layout(
    "the Waymo pairs",
    (
        FileColumn("segment_id"),
        FileColumn("local_veh_id"),
        FileColumn("follower_id"),
        FileColumn("leader_id"),
        FileColumn(_TIME, "s"),
        FileColumn(_LENGTH, "m", above=0, wrong="is no vehicle length"),
        _motion("filter_pos", "processed_position", "m"),
        _motion("filter_speed", "processed_speed", "m/s"),
        _motion("filter_accer", "processed_accer", "m/s2"),
        *[FileColumn(name, "m/s", needed=False, may_be_empty=True) for name in _OTHER_SPEEDS],
    ),
)


class WaymoPairsDataset(Dataset):
    """Pairs of one CSV file, `all_seg_paired_cf_trj_final_with_large_vehicle.csv` for instance.

    A pair is a `segment_id` with a `follower_id` and a `leader_id`. The file holds the rows of both
    vehicles, and `local_veh_id` says whose a row is. Positions are those of the middle of a
    vehicle's box along the path, so that the front bumper is half a `length` farther. Only times at
    which both vehicles have a row count.

    **NameColumn.** Vehicle 0 is Waymo's: its type is automated, all others are human.

    **Drivers.** `local_veh_id` counts anew in each segment, so a recording is a segment. Waymo's
    vehicle is vehicle 0 of every segment.
    """

    layout = "Waymo car-following pairs (Hu et al. 2022)"
    schema: ClassVar[type[Settings]] = FileDatasetSettings
    settings: FileDatasetSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        return start.has_columns("segment_id", "local_veh_id", "follower_id", "leader_id")

    def read(self) -> PairSet:
        return self.contents().pairs

    def contents(self) -> Contents:
        files = [read_table(path, _LAYOUT) for path in self.settings.files()]
        vehicles = 0
        for file in files:
            whole = np.stack([file.numbers["segment_id"], file.numbers["local_veh_id"]])
            vehicles += len(np.unique(whole, axis=1).T)
        rows = sum(len(file) for file in files)
        return Contents(joined([_pairs(file) for file in files]), rows, vehicles)


def _pairs(file: Table) -> PairSet:
    """Returns the pairs of a file, in the order of segment, follower and leader."""
    numbers = file.numbers
    keys = [numbers[name] for name in ("leader_id", "follower_id", "segment_id")]
    order = np.lexsort((numbers[_TIME], *keys))
    starts = np.flatnonzero(tracks.changes(*[key[order] for key in keys]))
    series = []
    alone = 0
    for rows in np.split(order, starts[1:]):
        pair = _series(file, {name: values[rows] for name, values in numbers.items()})
        if pair is None:
            alone += len(rows)
        else:
            series.append(pair)
    dropped = []
    if alone:
        dropped.append(
            Dropped("the other vehicle of the pair has no row at that time", alone, "rows")
        )
    said = []
    for name in _OTHER_SPEEDS:
        if name in numbers:
            said.append(
                statements.Statement(name, numbers[name], [numbers["filter_speed"]], "its speed")
            )
    remarks = statements.remarks_of(said)
    return pairs_of(series, file.source, dropped=dropped, remarks=remarks)


def _series(file: Table, rows: Mapping[str, Floats]) -> Series | None:
    """Returns one pair's series; None where its vehicles have no time in common."""
    segment = f"{stem(Path(file.source))}-{rows['segment_id'][0]:g}"
    follower, leader = int(rows["follower_id"][0]), int(rows["leader_id"][0])
    of_follower = np.flatnonzero(rows["local_veh_id"] == follower)
    of_leader = np.flatnonzero(rows["local_veh_id"] == leader)
    if not len(of_follower) or not len(of_leader):
        return None
    frame = frames_at(rows[_TIME], DT, f"{file.source}, segment {segment}")
    _require_once(file, segment, frame, of_follower)
    _require_once(file, segment, frame, of_leader)
    both, in_follower, in_leader = np.intersect1d(
        frame[of_follower], frame[of_leader], assume_unique=True, return_indices=True
    )
    if not len(both):
        return None
    behind, ahead = of_follower[in_follower], of_leader[in_leader]
    signals = {}
    length = {}
    for who, at in (("follower", behind), ("leader", ahead)):
        length[who] = float(np.median(rows[_LENGTH][at]))
        signals[f"{who}_position"] = rows["filter_pos"][at] + length[who] / 2
        signals[f"{who}_speed"] = rows["filter_speed"][at]
        signals[f"{who}_acceleration"] = rows["filter_accer"][at]
    return Series(
        name=f"{segment}-{follower}-{leader}",
        recording=segment,
        leader_id=str(leader),
        follower_id=str(follower),
        dt=DT,
        frame=both,
        signals=signals,
        leader_length=length["leader"],
        driver_types=(_type(follower),),
        leader_driver_type=_type(leader),
    )


def _require_once(file: Table, segment: str, frame: Ints, rows: Ints) -> None:
    """Raises DataError where a vehicle has two rows at one time."""
    if len(np.unique(frame[rows])) < len(rows):
        raise DataError(
            f"{file.source}: a vehicle of {segment} has two rows of one pair at the same"
            f" {_TIME}; keep one of them"
        )


def _type(vehicle: int) -> str:
    if vehicle == AUTOMATED:
        return "automated"
    return "human"
