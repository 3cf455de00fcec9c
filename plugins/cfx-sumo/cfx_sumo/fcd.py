"""SUMO's floating car data: what `sumo --fcd-output FILE` writes.

https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cfx import Dataset, PairSet, Settings
from cfx.core.errors import DataError
from cfx.data.base import FileDatasetSettings, joined
from cfx.data.files import FileStart, Floats, Ints, open_text, stem
from cfx.data.tracks import NOBODY, Tracks, changes, extract_pairs

_BLOCK = 1 << 20

_NEEDED = ("id", "speed", "pos", "lane")

_HOW = (
    "write it with --fcd-output.attributes id,type,speed,pos,lane,acceleration,leaderID,leaderGap"
    " --fcd-output.max-leader-distance 200 --precision 6"
)


class SumoFcdSettings(FileDatasetSettings):
    """How to read SUMO's floating car data."""

    min_frames: int = Field(
        150, ge=2, description="shortest pair that is kept, frames of SUMO's step"
    )
    max_gap: float | None = Field(
        120.0, gt=0, description="m: farther vehicles are no leaders; null: all are"
    )
    length: float = Field(
        5.0, gt=0, description="m: of vehicles whose length nothing in the file gives"
    )
    lengths: dict[str, float] | None = Field(
        None, description="m: of vehicles by their vType, for instance {truck: 12.0}"
    )


class SumoFcdDataset(Dataset):
    """Pairs from what SUMO writes with `--fcd-output`; gzipped files are fine.

    With `--fcd-output.max-leader-distance` SUMO writes who the leader is and the bumper-to-bumper
    gap, on the next edge too. Pairs then go on over junctions, and vehicles' lengths follow from
    gaps and positions. Without it the leader is the next vehicle in the same lane, so that pairs
    end where an edge does, and lengths are those of `length` and `lengths`.

    Pairs are cut by `cfx.data.tracks.extract_pairs`. Another lane of the same edge is a lane
    change; another edge is none. Where SUMO wrote no `acceleration` it is the change of speed over
    the last step, as SUMO defines it. `driver_type` is the vType; of a vehicle whose type SUMO made
    its own (`truck@t.0` after `setTau`), the type that it had before.

    SUMO writes two decimals unless `--precision` says more: speeds are then rounded to 0.01 m/s,
    and accelerations that follow from them in steps of 0.1 s to 0.1 m/s2.
    """

    layout = "SUMO's FCD output (m)"
    schema: ClassVar[type[Settings]] = SumoFcdSettings
    settings: SumoFcdSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        if not start.lines or not start.lines[0].lstrip().startswith("<"):
            return False
        if "<fcd-export" in "\n".join(start.lines):
            return True
        return _root(start.path) == "fcd-export"

    def read(self) -> PairSet:
        parts = []
        for path in self.settings.files():
            tracks = _tracks(_parsed(path), self.settings)
            parts.append(extract_pairs(tracks, max_gap=self.settings.max_gap))
        return joined(parts)


class _Root(Exception):  # noqa: N818 - no error: it ends the parser at the first element
    """The first element was seen; its name is the argument."""


def _root(path: Path) -> str:
    """Returns the name of the root element; "" if the file is no XML."""

    def begin(name: str, _: Any) -> None:
        raise _Root(name)

    parser = expat.ParserCreate()
    parser.StartElementHandler = begin
    try:
        with open_text(path) as file:
            while block := file.read(_BLOCK):
                parser.Parse(block)
    except _Root as found:
        return str(found.args[0])
    except expat.ExpatError:
        pass
    return ""


class _Parsed:
    """The vehicles of all time steps, in the order of the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.step = -1
        self.times: list[float] = []
        self.at: list[int] = []
        self.numbers: dict[str, list[float]] = {
            "speed": [],
            "pos": [],
            "acceleration": [],
            "leaderGap": [],
        }
        self.texts: dict[str, list[str]] = {"id": [], "lane": [], "type": [], "leaderID": []}

    def begin(self, name: str, attributes: Mapping[str, str]) -> None:
        """Takes the beginning of an element."""
        if name == "timestep":
            self.step += 1
            self.times.append(self._number(attributes, "time"))
        elif name == "vehicle":
            for needed in _NEEDED:
                if needed not in attributes:
                    raise DataError(
                        f"{self.path}, time {self.times[-1]:g} s: a vehicle has no attribute"
                        f" '{needed}'; {_HOW}"
                    )
            self.at.append(self.step)
            for key, numbers in self.numbers.items():
                numbers.append(self._number(attributes, key))
            for key, texts in self.texts.items():
                texts.append(attributes.get(key, ""))
        elif self.step < 0 and name != "fcd-export":
            raise DataError(
                f"{self.path}: is XML of <{name}>, not SUMO's FCD output (<fcd-export>)"
            )

    def _number(self, attributes: Mapping[str, str], key: str) -> float:
        text = attributes.get(key)
        if text is None:
            return float("nan")
        try:
            return float(text)
        except ValueError:
            raise DataError(
                f"{self.path}, time step {self.step}: {key}='{text}' is not a number"
            ) from None


def _parsed(path: Path) -> _Parsed:
    """Reads a file. A DOCTYPE is refused, and with it every entity that could expand or be fetched.

    Raises:
        DataError: it is no XML, is cut off, or is not of SUMO's FCD output.
    """
    parsed = _Parsed(path)

    def refuse(*_: Any) -> None:
        raise DataError(f"{path}: has a DOCTYPE, which SUMO never writes; remove it")

    parser = expat.ParserCreate()
    parser.StartElementHandler = parsed.begin
    parser.StartDoctypeDeclHandler = refuse
    try:
        with open_text(path) as file:
            while block := file.read(_BLOCK):
                parser.Parse(block)
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise DataError(
            f"{path}, line {error.lineno}: the XML is cut off or damaged"
            f" ({expat.ErrorString(error.code)}); write it again"
        ) from None
    except EOFError:
        raise DataError(f"{path}: the gzip file is cut off; write it again") from None
    if not parsed.at:
        raise DataError(f"{path}: holds no vehicles")
    return parsed


def _tracks(parsed: _Parsed, settings: SumoFcdSettings) -> Tracks:
    """Returns the vehicles' rows in order, with their leaders."""
    dt = _step(parsed)
    names, vehicle = np.unique(np.array(parsed.texts["id"]), return_inverse=True)
    vehicle = vehicle + 1
    frames = np.rint(np.array(parsed.times) / dt).astype(np.int64)
    frame = frames[np.array(parsed.at)]
    numbers = {key: np.array(values) for key, values in parsed.numbers.items()}
    order = np.lexsort((frame, vehicle))
    has_leaders = not bool(np.isnan(numbers["leaderGap"]).all())
    lanes, lane = np.unique(np.array(parsed.texts["lane"]), return_inverse=True)
    own = [
        kind.removesuffix(f"@{name}")
        for name, kind in zip(parsed.texts["id"], parsed.texts["type"], strict=True)
    ]
    types, kind = np.unique(np.array(own), return_inverse=True)
    columns = _Columns(vehicle[order], frame[order], lane[order], numbers["pos"][order])
    gap: Floats | None = None
    if has_leaders:
        known = {name: number + 1 for number, name in enumerate(names.tolist())}
        leaders = [known.get(name, NOBODY) for name in parsed.texts["leaderID"]]
        leader = np.array(leaders, dtype=np.int64)[order]
        gap = np.where(leader == NOBODY, np.nan, numbers["leaderGap"][order])
    else:
        leader = columns.next_in_lane()
    lengths_of = settings.lengths or {}
    length = np.array([lengths_of.get(str(name), settings.length) for name in types])
    lengths = length[kind[order]]
    position, number_of_lane = columns.position, columns.lane
    if gap is not None:
        lengths = columns.lengths(leader, gap, lengths)
        position = columns.driven(numbers["speed"][order], dt)
        number_of_lane = columns.lane_stints(lanes)
    return Tracks(
        source=str(parsed.path),
        dt=dt,
        recordings=(stem(parsed.path),),
        recording=np.zeros(len(order), dtype=np.int64),
        vehicle=columns.vehicle,
        frame=columns.frame,
        lane=number_of_lane,
        leader=leader,
        position=position,
        speed=numbers["speed"][order],
        acceleration=columns.accelerations(numbers["acceleration"], numbers["speed"], order, dt),
        length=lengths,
        gap=gap,
        driver_type=kind[order],
        driver_types=tuple(types.tolist()),
        names=("", *names.tolist()),
    )


def _step(parsed: _Parsed) -> float:
    """Returns the time step, s; raises DataError where steps differ."""
    times = np.array(parsed.times)
    steps = np.diff(times)
    if not len(steps) or not bool((steps > 0).all()):
        raise DataError(f"{parsed.path}: the times of its steps do not advance")
    usual = float(np.median(steps))
    whole = steps / usual
    if float(np.abs(whole - np.rint(whole)).max()) > 0.05:
        raise DataError(
            f"{parsed.path}: its time steps differ ({steps.min():g} to {steps.max():g} s); a"
            " recording has one"
        )
    return round(usual, 6)


class _Columns:
    """Rows sorted by vehicle and frame, `(N,)` each, and what follows from them."""

    def __init__(self, vehicle: Ints, frame: Ints, lane: Ints, position: Floats) -> None:
        self.vehicle = vehicle
        self.frame = frame
        self.lane = lane
        self.position = position
        self.starts = changes(vehicle)
        """Where a vehicle's rows begin."""

    def next_in_lane(self) -> Ints:
        """Returns the next vehicle ahead in each row's lane, 0 where there is none."""
        order = np.lexsort((self.position, self.lane, self.frame))
        same = ~changes(self.frame[order], self.lane[order])
        leader = np.zeros(len(order), dtype=np.int64)
        behind, ahead = order[:-1][same[1:]], order[1:][same[1:]]
        leader[behind] = self.vehicle[ahead]
        return leader

    def driven(self, speed: Floats, dt: float) -> Floats:
        """Returns the distance that each vehicle has driven since its first row, m."""
        total = np.cumsum(np.where(self.starts, 0.0, speed * dt))
        vehicle = np.cumsum(self.starts) - 1
        driven: Floats = total - total[self.starts][vehicle]
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
        frames = int(self.frame.max()) + 1
        keys = self.vehicle * frames + self.frame
        at = np.minimum(np.searchsorted(keys, leader * frames + self.frame), len(keys) - 1)
        is_beside = (self.vehicle[at] == leader) & (self.frame[at] == self.frame)
        is_known = is_beside & (self.lane[at] == self.lane) & (leader != NOBODY)
        left = (self.position[at] - self.position - gap)[is_known]
        own = leader[is_known]
        order = np.lexsort((left, own))
        starts = np.flatnonzero(changes(own[order]))
        sizes = np.diff(np.append(starts, len(order)))
        medians = left[order][starts + sizes // 2]
        by_vehicle = np.full(int(self.vehicle.max()) + 1, np.nan)
        by_vehicle[own[order][starts]] = np.where(medians > 0, np.round(medians, 1), np.nan)
        measured = by_vehicle[self.vehicle]
        return np.where(np.isnan(measured), default, measured)

    def accelerations(self, given: Floats, speed: Floats, order: Ints, dt: float) -> Floats:
        """Returns accelerations as SUMO wrote them; where it wrote none, by the last step's."""
        speeds = speed[order]
        change = np.zeros(len(speeds))
        change[1:] = np.where(self.starts[1:], 0.0, np.diff(speeds) / dt)
        return np.where(np.isnan(given[order]), change, given[order])
