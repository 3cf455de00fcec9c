"""Files of SUMO's floating car data: XML, CSV and parquet, each gzipped or not where text.

https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from cfx.errors import DataError
from cfx.plugin import (
    Dropped,
    FileColumn,
    FileStart,
    Floats,
    Ints,
    Layout,
    Table,
    beginning,
    open_text,
    read_table,
    tracks,
    unpacking,
)

_BLOCK = 1 << 20

_NEEDED = ("id", "speed", "pos", "lane")
_NUMBERS = (
    *("speed", "pos", "acceleration", "leaderGap", "leaderSpeed"),
    *("posLat", "x", "y", "angle"),
)
_TEXTS = ("id", "lane", "type", "leaderID")

_OUTPUTS = {
    "netstate": "--netstate-dump",
    "trajectories": "--amitran-output",
    "tripinfos": "--tripinfo-output",
    "summary": "--summary-output",
    "emission-export": "--emission-output",
    "full-export": "--full-output",
    "routes": "--vehroute-output, or routes",
    "lanechanges": "--lanechange-output",
    "stops": "--stop-output",
    "queue-export": "--queue-output",
    "battery-export": "--battery-output",
    "elecHybrid-export": "--elechybrid-output",
    "chargingstations-export": "--chargingstations-output",
    "overheadWireSegments-export": "--overheadwiresegments-output",
    "substations-export": "--substations-output",
    "statistics": "--statistic-output",
    "collisions": "--collision-output",
    "link-output": "--link-output",
    "bt-output": "--bt-output",
    "railsignal-block-output": "--railsignal-block-output",
    "meandata": "--edgedata-output, --lanedata-output or an edgeData element",
    "detector": "a detector",
    "instantE1": "an instantaneous induction loop",
    "SSMLog": "the device ssm",
    "tlsStates": "a timedEvent of traffic lights",
    "tlsSwitches": "a timedEvent of traffic lights",
    "snapshot": "--save-state",
    "net": "--net-file, which is the road network,",
    "additional": "no option, as an input,",
    "sumoConfiguration": "--save-configuration",
    "configuration": "--save-configuration",
    "vtypeprobe": "a vTypeProbe",
    "vehicleTypeProbes": "a vTypeProbe",
}
"""Root elements of SUMO's other outputs and of its inputs, and what writes them."""

_COLUMNS_OF_OUTPUTS = {
    "lane_id;vehicle_id": "netstate",
    "actorConfig_": "trajectories",
    "tripinfo_": "tripinfos",
    "step_": "summary",
    "interval_": "meandata",
    "data_timestep": "queue-export",
    "timestep_id": "link-output",
    "performance_": "statistics",
    "stopinfo_": "stops",
    "change_": "lanechanges",
    "collision_": "collisions",
    "route_": "routes",
    "timestep=": "full-export",
    "time=": "netstate",
}
"""How the first line of their tables begins, and the root element that they are for."""

_INSTEAD = (
    "pairs are made of positions and speeds over time, which SUMO writes with --fcd-output fcd.xml"
    " --fcd-output.max-leader-distance 200 --fcd-output.acceleration --precision 6"
)

_HOW = (
    "write it with --fcd-output.attributes id,type,speed,pos,lane,acceleration,leaderID,leaderGap"
    " --fcd-output.max-leader-distance 200 --precision 6"
)


@dataclass(frozen=True)
class FcdRows:
    """The vehicles of all time steps, in the order of the file: N rows, S time steps.

    Attributes:
        path: of the file.
        times: `(S,)`, s.
        step: `(N,)`, index of each row's time step.
        numbers: SUMO's attributes in m, s and degrees, `(N,)` each; NaN where it wrote none.
        texts: SUMO's attributes that are names, `(N,)` each; "" where it wrote none.
        dropped: rows that are no vehicle in a lane.
    """

    path: Path
    times: Floats
    step: Ints
    numbers: Mapping[str, Floats]
    texts: Mapping[str, NDArray[np.str_]]
    dropped: tuple[Dropped, ...] = ()


def is_fcd(start: FileStart) -> bool:
    """Says whether a file is SUMO's floating car data, from its beginning."""
    if start.lines and start.lines[0].lstrip().startswith("<"):
        if "<fcd-export" in "\n".join(start.lines):
            return True
        return _root(start.path) in {"fcd-export", *_OUTPUTS}
    names = set(start.columns)
    if {"time", *_NEEDED} <= {_plain(name) for name in names} or "timestep_time" in names:
        return True
    return bool(_other_table(start))


def _other_table(start: FileStart) -> str:
    """Returns the root element of another output that is a table; "" if it is none of SUMO's."""
    line = start.lines[0].strip() if start.lines else ";".join(start.columns)
    for beginning_of, root in _COLUMNS_OF_OUTPUTS.items():
        if line.startswith(beginning_of) and (";" in line or len(start.columns) == 1):
            return root
    return ""


def _is_other(path: Path, root: str) -> DataError:
    """Returns that a file is another output of SUMO."""
    return DataError(f"{path}: is what SUMO writes with {_OUTPUTS[root]} (<{root}>); {_INSTEAD}")


def read_rows(path: Path) -> FcdRows:
    """Reads a file.

    Raises:
        DataError: it is cut off, or is not SUMO's FCD output; or it holds no vehicles.
    """
    with open_text(path) as file, unpacking(path):
        is_xml = file.read(_BLOCK).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    rows = _of_xml(path) if is_xml else _of_table(path)
    if not len(rows.step):
        raise DataError(f"{path}: holds no vehicles")
    back = np.flatnonzero(rows.numbers["speed"] < 0)
    if len(back):
        raise DataError(
            f"{_where(rows, int(back[0]))}: speed={rows.numbers['speed'][back[0]]:g} is negative"
            f" ({len(back)} such rows); speeds count along the lane"
        )
    return _once(rows)


def _where(rows: FcdRows, row: int) -> str:
    """Says where a row is."""
    time = rows.times[rows.step[row]]
    return f"{rows.path}, vehicle '{rows.texts['id'][row]}' at {time:g} s"


def _once(rows: FcdRows) -> FcdRows:
    """Returns rows without those that stand there twice.

    Raises:
        DataError: a vehicle has two different rows at one time.
    """
    _, vehicle = np.unique(rows.texts["id"], return_inverse=True)
    order = np.lexsort((rows.step, vehicle))
    before, after = order[:-1], order[1:]
    again = (vehicle[before] == vehicle[after]) & (rows.step[before] == rows.step[after])
    before, after = before[again], after[again]
    if not len(after):
        return rows
    differs = rows.texts["lane"][before] != rows.texts["lane"][after]
    for name in _NUMBERS:
        values = rows.numbers[name]
        both_empty = np.isnan(values[before]) & np.isnan(values[after])
        differs |= (values[before] != values[after]) & ~both_empty
    if differs.any():
        raise DataError(
            f"{_where(rows, int(after[differs][0]))}: the vehicle has two different rows"
            f" ({int(differs.sum())} such pairs of rows); keep one of them"
        )
    kept = np.ones(len(rows.step), dtype=bool)
    kept[after] = False
    dropped = tracks.count_reasons({"the same row again": ~kept}, "rows")
    return replace(
        rows,
        step=rows.step[kept],
        numbers={name: values[kept] for name, values in rows.numbers.items()},
        texts={name: values[kept] for name, values in rows.texts.items()},
        dropped=(*rows.dropped, *dropped),
    )


# --- XML ------------------------------------------------------------------------------------------


class _Root(Exception):  # noqa: N818 - no error: it ends the parser at the first element
    """The first element was seen; its name is the argument."""


def _root(path: Path) -> str:
    """Returns the name of the root element; "" if the file is no XML."""

    def begin(name: str, _: Any) -> None:
        raise _Root(name)

    parser = expat.ParserCreate()
    parser.StartElementHandler = begin
    try:
        with open_text(path) as file, unpacking(path):
            while block := file.read(_BLOCK):
                parser.Parse(block)
    except _Root as root:
        return str(root.args[0])
    except expat.ExpatError:
        pass
    return ""


class _Elements:
    """Takes the elements of the XML one after the other."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.times: list[float] = []
        self.step: list[int] = []
        self.numbers: dict[str, list[float]] = {name: [] for name in _NUMBERS}
        self.texts: dict[str, list[str]] = {name: [] for name in _TEXTS}

    def begin(self, name: str, attributes: Mapping[str, str]) -> None:
        """Takes the beginning of an element."""
        if name == "timestep":
            self.times.append(self._number(attributes, "time"))
        elif name == "vehicle":
            for needed in _NEEDED:
                if needed not in attributes:
                    raise DataError(
                        f"{self.path}, time {self.times[-1]:g} s: a vehicle has no attribute"
                        f" '{needed}'; {_HOW}"
                    )
            self.step.append(len(self.times) - 1)
            for key, numbers in self.numbers.items():
                numbers.append(self._number(attributes, key))
            for key, texts in self.texts.items():
                texts.append(attributes.get(key, ""))
        elif not self.times and name != "fcd-export":
            if name in _OUTPUTS:
                raise _is_other(self.path, name)
            raise DataError(
                f"{self.path}: is XML of <{name}>, not SUMO's FCD output (<fcd-export>); {_INSTEAD}"
            )

    def _number(self, attributes: Mapping[str, str], key: str) -> float:
        text = attributes.get(key)
        if text is None:
            return float("nan")
        try:
            return float(text)
        except ValueError:
            raise DataError(
                f"{self.path}, time step {len(self.times)}: {key}='{text}' is not a number"
            ) from None


def _of_xml(path: Path) -> FcdRows:
    """Reads XML. A DOCTYPE is refused, and with it every entity that could expand or be fetched.

    Raises:
        DataError: it is no XML, is cut off, or is not of SUMO's FCD output.
    """
    elements = _Elements(path)

    def refuse(*_: Any) -> None:
        raise DataError(f"{path}: has a DOCTYPE, which SUMO never writes; remove it")

    parser = expat.ParserCreate()
    parser.StartElementHandler = elements.begin
    parser.StartDoctypeDeclHandler = refuse
    try:
        with open_text(path) as file, unpacking(path):
            while block := file.read(_BLOCK):
                parser.Parse(block)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise DataError(
            f"{path}, line {error.lineno}: the XML is cut off or damaged"
            f" ({expat.ErrorString(error.code)}); write it again"
        ) from None
    return FcdRows(
        path,
        np.array(elements.times),
        np.array(elements.step, dtype=np.int64),
        {key: np.array(values) for key, values in elements.numbers.items()},
        {key: np.array(values, dtype=np.str_) for key, values in elements.texts.items()},
    )


# --- CSV and parquet ------------------------------------------------------------------------------


def _plain(name: str) -> str:
    """Returns an attribute's name without the elements that SUMO writes before it."""
    return re.sub(r"^(timestep_)?(vehicle_)?", "", name)


_LAYOUT = Layout(
    "SUMO's FCD output",
    (
        FileColumn("time", "s"),
        # A time step without vehicles is a row with nothing but the time; a person is in no lane.
        FileColumn("id", is_name=True, may_be_empty=True),
        FileColumn("lane", is_name=True, may_be_empty=True),
        FileColumn("type", is_name=True, may_be_empty=True, needed=False),
        FileColumn("leaderID", is_name=True, may_be_empty=True, needed=False),
        FileColumn("speed", "m/s", may_be_empty=True),
        FileColumn("pos", "m", may_be_empty=True),
        FileColumn("acceleration", "m/s2", may_be_empty=True, needed=False),
        FileColumn("leaderGap", "m", may_be_empty=True, needed=False),
        FileColumn("leaderSpeed", "m/s", may_be_empty=True, needed=False),
        FileColumn("posLat", "m", may_be_empty=True, needed=False),
        FileColumn("x", "m", may_be_empty=True, needed=False),
        FileColumn("y", "m", may_be_empty=True, needed=False),
        FileColumn("angle", "degrees", may_be_empty=True, needed=False),
    ),
    keys={"vehicle": "id"},
    parquet=True,
    plain=_plain,
)


def _of_table(path: Path) -> FcdRows:
    """Reads CSV or parquet.

    Raises:
        DataError: as `read_table`; or a vehicle in a lane has no speed or position.
    """
    start = beginning(path)
    other = _other_table(start)
    if other:
        raise _is_other(path, other)
    table = read_table(path, _LAYOUT)
    times, step = np.unique(table.numbers["time"], return_inverse=True)
    is_row = table.labels["id"].codes >= 0
    is_vehicle = is_row & (table.labels["lane"].codes >= 0)
    for name in ("speed", "pos"):
        why = f"is no number; a vehicle in a lane has a {name}"
        table.refuse(name, is_vehicle & np.isnan(table.numbers[name]), why)
    nothing = np.full(len(table), np.nan)
    numbers = {name: table.numbers.get(name, nothing)[is_vehicle] for name in _NUMBERS}
    texts = {name: _names(table, name)[is_vehicle] for name in _TEXTS}
    dropped = tracks.count_reasons({"a person, or in no lane": is_row & ~is_vehicle}, "rows")
    return FcdRows(path, times, step[is_vehicle], numbers, texts, dropped)


def _names(table: Table, name: str) -> NDArray[np.str_]:
    """Returns a column of names `(N,)`; "" where a cell is empty or the column is not there."""
    if name not in table.labels:
        return np.full(len(table), "", dtype=np.str_)
    labels = table.labels[name]
    return np.array([*labels.names, ""], dtype=np.str_)[labels.codes]
