"""Finds the road of the demonstration: the longest stretch of three lanes or more in a network.

The network may come from an OpenStreetMap extract. A *track* is a lane that goes on to the end of
the stretch, whatever its number is on each edge: where a ramp joins, lanes are numbered anew.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.errors import DataError, SumoError

Array = NDArray[np.float64]

SHIPPED = Path(__file__).parent.parent / "assets" / "motorway.net.xml"
"""A six-lane one-way motorway of 3.2 km with an on-ramp, made by hand.

netconvert made it of `motorway.osm.xml` beside it.
"""

ABREAST = 3
"""Tracks that one pair takes: three, with its leader ahead of three versions of its follower."""

_FLAGS = (
    "--geometry.remove",
    "--junctions.join",
    "--no-turnarounds",
    "--remove-edges.isolated",
    "--keep-edges.by-vclass",
    "passenger",
)
"""Options of netconvert. `--ramps.guess` is left out: it numbers lanes anew where it guesses."""


@dataclass(frozen=True)
class Lane:
    """What is drawn of a lane.

    Attributes:
        shape: `(points, 2)`, its middle, m.
        width: m.
        inner: whether another lane of the same edge lies to its left.
    """

    shape: Array
    width: float
    inner: bool


@dataclass(frozen=True)
class Motorway:
    """A stretch of road.

    Attributes:
        net: SUMO's network file.
        edges: names of its edges, in driving direction.
        starts: `(tracks, edges)` m, where each edge begins along a track; between two edges lies
            the inside of a junction.
        ends: `(tracks, edges)` m, where each ends.
        tracks: for each track, from right to left, its lane's number on each edge.
        lanes: all lanes of the network, to draw them.
    """

    net: Path
    edges: tuple[str, ...]
    starts: Array
    ends: Array
    tracks: tuple[tuple[int, ...], ...]
    lanes: tuple[Lane, ...]

    @property
    def length(self) -> float:
        """Length of the shortest track, m."""
        return float(self.ends[:, -1].min())

    def place(self, track: int, at: float) -> tuple[int, float] | None:
        """Returns the edge (its place among `edges`) and the position on it, m.

        It is None inside a junction or outside the road.
        """
        inside = np.flatnonzero((self.starts[track] <= at) & (at < self.ends[track]))
        if not len(inside):
            return None
        edge = int(inside[0])
        return edge, at - float(self.starts[track, edge])


def read_motorway(source: Path | None, folder: Path) -> Motorway:
    """Finds the stretch in a network.

    Args:
        source: an OpenStreetMap extract (`.osm`, `.osm.xml`, also gzipped), which netconvert
            converts, or a network that it has converted (`.net.xml`); None for the motorway that
            cfx ships.
        folder: where a converted network is written.

    Raises:
        DataError: the file is neither, or has no road of three lanes that go on together.
        SumoError: netconvert is needed and not there.
    """
    if source is None:
        return _stretch(SHIPPED, "the motorway that cfx ships")
    source = source.expanduser()
    kind = _kind(source)
    net = source if kind == "net" else _convert(source, folder / "motorway.net.xml")
    return _stretch(net, str(source))


def find_netconvert() -> str | None:
    """Returns the path of netconvert, of the wheel eclipse-sumo or on the search path, or None."""
    try:
        import sumo  # of the wheel eclipse-sumo, which the extra leaves out for its size
    except ImportError:
        return shutil.which("netconvert")
    of_wheel = shutil.which("netconvert", path=str(Path(sumo.__file__).parent / "bin"))
    return of_wheel or shutil.which("netconvert")


def _kind(source: Path) -> str:
    try:
        opened = source.read_bytes()
    except OSError as error:
        raise DataError(
            f"demo.osm={source} cannot be read ({error.strerror}); name an OpenStreetMap extract"
            " (.osm.xml)"
        ) from error
    head = opened[:4096]
    if head.startswith(b"\x1f\x8b"):
        return "osm"  # gzipped; netconvert reads it
    for kind in ("osm", "net"):
        if f"<{kind}".encode() in head:
            return kind
    raise DataError(
        f"demo.osm={source} is no OpenStreetMap extract: it holds no <osm> element; export one"
        " in the format .osm (openstreetmap.org, Export), or name a SUMO network (.net.xml)"
    )


def _convert(source: Path, net: Path) -> Path:
    program = find_netconvert()
    if program is None:
        raise SumoError(
            f"demo.osm={source}: an OpenStreetMap extract needs SUMO's netconvert, which is not"
            " here: pip install eclipse-sumo"
        )
    command = [program, "--osm-files", str(source.absolute()), "--output-file", str(net), *_FLAGS]
    # Our own command, no shell.
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode or not net.is_file():
        reason = "no reason given"
        for line in done.stderr.splitlines():
            if line.startswith("Error:"):
                reason = line.removeprefix("Error:").strip()
                break
        raise DataError(
            f"demo.osm={source} is no OpenStreetMap extract that netconvert can read: {reason}"
        )
    return net


def _stretch(net: Path, name: str) -> Motorway:
    from sumolib.net import readNet

    try:
        network = readNet(str(net), withInternal=True)
    except Exception as error:  # sumolib raises whatever its XML parser and its own code do
        raise DataError(
            f"{name} is no network that SUMO can read ({type(error).__name__}: {error})"
        ) from error
    best = max(_chains(network), key=lambda chain: _length(network, chain), default=None)
    if best is None:
        raise DataError(
            f"{name} has no road of {ABREAST} lanes or more for cars: a pair needs {ABREAST}, one"
            " for each of its followers"
        )
    starts, ends, tracks = [], [], []
    for track in range(len(best[0][1])):
        begins, stops = _extent(network, best, track)
        starts.append(begins)
        ends.append(stops)
        tracks.append(tuple(lanes[track] for _, lanes in best))
    return Motorway(
        net=net.absolute(),
        edges=tuple(edge.getID() for edge, _ in best),
        starts=np.array(starts),
        ends=np.array(ends),
        tracks=tuple(tracks),
        lanes=_lanes(network),
    )


def _lanes(network: Any) -> tuple[Lane, ...]:
    """Returns all lanes for cars."""
    lanes = []
    for edge in network.getEdges(withInternal=True):
        for lane in edge.getLanes():
            if lane.allows("passenger"):
                shape = np.array([point[:2] for point in lane.getShape()])
                inner = lane.getIndex() + 1 < edge.getLaneNumber()
                lanes.append(Lane(shape, float(lane.getWidth()), inner))
    return tuple(lanes)


_Chain = list[tuple[Any, tuple[int, ...]]]
"""Edges, and on each the numbers of the lanes that go on."""


def _chains(network: Any) -> Iterator[_Chain]:
    """Yields from each edge on the stretch along which at least `ABREAST` lanes go on together."""
    for first in network.getEdges(withInternal=False):
        lanes = tuple(lane.getIndex() for lane in first.getLanes() if lane.allows("passenger"))
        if len(lanes) >= ABREAST:
            yield _chain(first, lanes)


def _chain(first: Any, lanes: tuple[int, ...]) -> _Chain:
    chain, seen = [(first, lanes)], {first.getID()}
    onward = _onward(first, lanes)
    while onward is not None and onward[2].getID() not in seen:
        kept, numbers, edge = onward
        for k, (earlier, all_lanes) in enumerate(chain):
            chain[k] = (earlier, tuple(all_lanes[place] for place in kept))
        chain.append((edge, numbers))
        seen.add(edge.getID())
        onward = _onward(edge, numbers)
    return chain


def _onward(edge: Any, lanes: tuple[int, ...]) -> tuple[list[int], tuple[int, ...], Any] | None:
    """Returns which lanes go on to the edge most lead to, their numbers there, that edge."""
    best: tuple[list[int], tuple[int, ...], Any] | None = None
    for target in edge.getOutgoing():
        number_of: dict[int, int] = {}
        for place, number in enumerate(lanes):
            free = _free_lanes(edge.getLane(number), target, number_of.values())
            if free:
                number_of[place] = min(free)
        if len(number_of) >= ABREAST and (best is None or len(number_of) > len(best[0])):
            best = (list(number_of), tuple(number_of.values()), target)
    return best


def _free_lanes(lane: Any, target: Any, taken: Iterable[int]) -> list[int]:
    """Returns the lanes of another edge that a lane leads to and no other one has taken."""
    free = []
    for link in lane.getOutgoing():
        index = link.getToLane().getIndex()
        allowed = target.getLane(index).allows("passenger") if link.getTo() == target else False
        if allowed and index not in taken:
            free.append(index)
    return free


def _extent(network: Any, chain: _Chain, track: int) -> tuple[list[float], list[float]]:
    """Returns where each edge begins and ends along a track, m."""
    at, starts, ends = 0.0, [], []
    for k, (edge, lanes) in enumerate(chain):
        lane = edge.getLane(lanes[track])
        starts.append(at)
        at += lane.getLength()
        ends.append(at)
        if k + 1 < len(chain):
            onward, numbers = chain[k + 1]
            at += _inside(network, lane, onward.getLane(numbers[track]))
    return starts, ends


def _inside(network: Any, lane: Any, target: Any) -> float:
    """Returns the length of a junction between two lanes, m; it may hold lanes in a row."""
    length, name = 0.0, ""
    for link in lane.getOutgoing():
        if link.getToLane() == target:
            name = link.getViaLaneID()
            break
    while name:
        inside = network.getLane(name)
        length += inside.getLength()
        links = inside.getOutgoing()
        name = links[0].getViaLaneID() if links else ""
    return length


def _length(network: Any, chain: _Chain) -> float:
    return _extent(network, chain, 0)[1][-1]
