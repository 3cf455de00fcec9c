"""What a recording holds, in words and tables: `python -m cfx data describe FILE`."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, RenderableType
from rich.table import Table

from cfx.datasets.base import listed
from cfx.datasets.files import PARQUET, Floats, magic, sniff
from cfx.datasets.ngsim_file import read_ngsim
from cfx.datasets.tidy import read_tidy
from cfx.datasets.tidy_table import LABELS, NUMBERS
from cfx.pairs import Pair, PairSet
from cfx.style.entropy import STANDING_MPS

Marks = NDArray[np.bool_]

_THRESHOLDS = (300, 500, 700)
"""Lengths in frames for which pairs are counted."""

_QUANTILES = {
    0.0: "least",
    0.01: "1%",
    0.25: "25%",
    0.5: "median",
    0.75: "75%",
    0.99: "99%",
    1.0: "most",
}
"""Quantiles in the table of motion, and their headings."""

_LAYOUTS = {"tidy": "tidy pairs (SI units)", "ngsim": "NGSIM (feet)"}

_WIDTH = 110


class _Contents(NamedTuple):
    """A file's pairs, and what the pairs do not show."""

    layout: str
    pairs: PairSet
    rows: int
    vehicles: int
    problem: str = ""


def describe(path: Path) -> str:
    """Says what a recording holds.

    These are its rows, recordings and pairs, their motion, what was left out and why, and what
    looks wrong. The layout, tidy or NGSIM, is found from the file itself.

    Raises:
        DataError: the file cannot be used; the message says why.
    """
    path = path.expanduser()
    contents = _read(path)
    pieces: list[RenderableType] = [str(path), "", _overview(contents)]
    if len(contents.pairs):
        pieces += ["", _motion(contents.pairs)]
    pieces += ["", *_left_out(contents.pairs)]
    pieces += ["", *_problems(contents)]
    pieces += ["", f"Use it: data={contents.layout} data.path={path}"]
    text = io.StringIO()
    console = Console(file=text, width=_WIDTH, highlight=False, markup=False, emoji=False)
    for piece in pieces:
        console.print(piece, soft_wrap=isinstance(piece, str))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def _read(path: Path) -> _Contents:
    """Reads a file in either layout."""
    if magic(path) == PARQUET or _looks_tidy(sniff(path).header):
        pairs = read_tidy(path)
        vehicles = set()
        for pair in pairs:
            vehicles.add((pair.recording, pair.leader_id))
            vehicles.add((pair.recording, pair.follower_id))
        return _Contents("tidy", pairs, _frames(pairs), len(vehicles))
    rows = read_ngsim(path)
    return _Contents(
        "ngsim", rows.pairs(), rows.rows_read, rows.vehicles, rows.boundary_artefacts()
    )


def _looks_tidy(header: Sequence[str] | None) -> bool:
    if header is None:
        return False
    return len(set(header) & {*LABELS, *NUMBERS}) >= 3


def _frames(pairs: PairSet) -> int:
    return sum(len(pair) for pair in pairs)


def _overview(contents: _Contents) -> Table:
    """Returns what a file holds, a row per question."""
    pairs = contents.pairs
    recordings: dict[str, int] = {}
    for pair in pairs:
        recordings[pair.recording] = recordings.get(pair.recording, 0) + 1
    counted = [f"{name} ({count} pairs)" for name, count in recordings.items()]
    drivers = {pair.driver for pair in pairs}
    lanes = sorted({pair.lane for pair in pairs if pair.lane is not None})
    steps = sorted({pair.dt for pair in pairs})
    truth = {pair.truth_model for pair in pairs if pair.truth}

    table = Table.grid(padding=(0, 3))
    table.add_row("layout", _LAYOUTS[contents.layout])
    table.add_row("rows", f"{contents.rows:,}")
    table.add_row("vehicles", f"{contents.vehicles:,}")
    if counted:
        table.add_row("recordings", f"{len(recordings)}: {listed(counted, 6)}")
    else:
        table.add_row("recordings", "none with pairs")
    table.add_row("lanes", listed(lanes) or "not known")
    table.add_row("pairs", f"{len(pairs):,} of {len(drivers):,} drivers, {_frames(pairs):,} frames")
    table.add_row("time step", listed([f"{step:g} s" for step in steps]) or "-")
    for frames in _THRESHOLDS:
        count = sum(len(pair) >= frames for pair in pairs)
        table.add_row(f"  of at least {frames} frames", f"{count:,}")
    if truth:
        table.add_row("true parameters", f"known, of {listed(sorted(truth))}")
    return table


def _motion(pairs: PairSet) -> Table:
    """Returns how the vehicles move: quantiles over all frames."""
    table = Table(box=None, padding=(0, 2), header_style="")
    table.add_column("over all pairs")
    for heading in _QUANTILES.values():
        table.add_column(heading, justify="right")
    for name, values in _quantities(pairs):
        if not len(values):
            continue
        decimals = 0 if name == "frames" else 2
        cells = [f"{value:.{decimals}f}" for value in np.quantile(values, list(_QUANTILES))]
        table.add_row(name, *cells)
    return table


def _quantities(pairs: PairSet) -> Iterator[tuple[str, Floats]]:
    """Yields what the table of motion is about: a name with its unit, and the values."""
    speed = _joined(pairs, "follower_speed")
    gap = _joined(pairs, "gap")
    headway = _joined(pairs, "leader_position") - _joined(pairs, "follower_position")
    moving = speed >= STANDING_MPS
    yield "frames", np.array([len(pair) for pair in pairs], dtype=np.float64)
    yield "leader speed, m/s", _joined(pairs, "leader_speed")
    yield "follower speed, m/s", speed
    yield "follower acceleration, m/s2", _joined(pairs, "follower_acceleration")
    yield "gap (bumper to bumper), m", gap
    yield "space headway (front to front), m", headway
    yield f"time headway (above {STANDING_MPS:g} m/s), s", headway[moving] / speed[moving]
    yield "leader length, m", np.array([pair.leader_length for pair in pairs])


def _joined(pairs: PairSet, name: str) -> Floats:
    return np.concatenate([getattr(pair, name) for pair in pairs])


def _left_out(pairs: PairSet) -> list[str]:
    if not pairs.dropped:
        return ["Left out: nothing"]
    lines = ["Left out:"]
    for drop in pairs.dropped:
        lines.append(f"  {drop.count:,} {drop.unit}: {drop.reason}")
    return lines


def _problems(contents: _Contents) -> list[str]:
    """Returns what a recording may hold but rarely should."""
    found = list(_suspicions(contents.pairs))
    if contents.problem:
        found.append(contents.problem)
    if not found:
        return ["Problems: none found"]
    return ["Problems:", *(f"  {sentence}" for sentence in found)]


def _suspicions(pairs: PairSet) -> Iterator[str]:
    """Yields a sentence for each kind of values that a recording rarely holds."""
    if not len(pairs):
        yield "there is no leader-follower pair in it"
        return
    if len({round(pair.dt, 9) for pair in pairs}) > 1:
        yield (
            "the pairs have different time steps; a job needs one: set data.time_step, or split"
            " the file"
        )
    length = float(np.median([pair.leader_length for pair in pairs]))
    if length > 11:
        yield f"leaders are typically {length:.1f} m long: feet, or lorries only?"
    for what, wrong in _CHECKS.items():
        yield from _counted(pairs, what, wrong)


def _is_close(pair: Pair) -> Marks:
    return pair.gap < 0.5


def _is_fast(pair: Pair) -> Marks:
    return np.maximum(pair.leader_speed, pair.follower_speed) > 50


def _is_harsh(pair: Pair) -> Marks:
    return np.abs(pair.follower_acceleration) > 8


def _jumps(pair: Pair) -> Marks:
    moved = np.diff(pair.follower_position)
    return np.abs(moved - pair.follower_speed[1:] * pair.dt) > 1.0


def _reverses(pair: Pair) -> Marks:
    return np.diff(pair.follower_position) < 0


_CHECKS: dict[str, Callable[[Pair], Marks]] = {
    "frames with a gap below 0.5 m": _is_close,
    "frames with a speed above 50 m/s": _is_fast,
    "frames with an acceleration or braking above 8 m/s2": _is_harsh,
    "steps in which a position moves 1 m more or less than its speed says": _jumps,
    "steps in which a vehicle moves backwards": _reverses,
}
"""What is counted, and which frames or steps of a pair count."""


def _counted(pairs: PairSet, what: str, wrong: Callable[[Pair], Marks]) -> Iterator[str]:
    """Yields how many frames are wrong and where most of them are; nothing if none is."""
    counts = [int(np.count_nonzero(wrong(pair))) for pair in pairs]
    if any(counts):
        worst = pairs[int(np.argmax(counts))].pair_id
        yield (
            f"{sum(counts):,} {what}, in {np.count_nonzero(counts)} of {len(pairs)} pairs,"
            f" most of them in '{worst}'"
        )
