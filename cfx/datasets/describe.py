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
from cfx.datasets.ngsim import read_ngsim
from cfx.datasets.tidy import LABELS, NUMBERS, read_tidy
from cfx.pairs import Pair, PairSet
from cfx.style.entropy import STANDING_MPS

Marks = NDArray[np.bool_]

_THRESHOLDS = (300, 500, 700)
_QUANTILES = (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
_WIDTH = 110


class _Contents(NamedTuple):
    """A file's pairs, and what the pairs do not show."""

    layout: str
    pairs: PairSet
    rows: int
    vehicles: int
    problem: str = ""


def describe(path: Path) -> str:
    """Says what a recording holds: rows, recordings, pairs, their motion, what was left out and why, and what looks wrong.

    The layout, tidy or NGSIM, is found from the file itself.

    Raises:
        DataError: the file cannot be used; the message says why.
    """
    path = path.expanduser()
    contents = _read(path)
    pieces: list[RenderableType] = [str(path), "", _overview(contents)]
    if len(contents.pairs):
        pieces += ["", _motion(contents.pairs)]
    pieces += [
        "",
        *_left_out(contents.pairs),
        "",
        *_problems(contents),
        "",
        f"Use it: data={contents.layout} data.path={path}",
    ]
    text = io.StringIO()
    console = Console(file=text, width=_WIDTH, highlight=False, markup=False, emoji=False)
    for piece in pieces:
        console.print(piece, soft_wrap=isinstance(piece, str))
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def _read(path: Path) -> _Contents:
    if magic(path) == PARQUET or _looks_tidy(sniff(path).header):
        pairs = read_tidy(path)
        vehicles = {
            (p.recording, vehicle) for p in pairs for vehicle in (p.leader_id, p.follower_id)
        }
        return _Contents("tidy", pairs, sum(map(len, pairs)), len(vehicles))
    rows = read_ngsim(path)
    return _Contents("ngsim", rows.pairs(), rows.rows_read, rows.vehicles, rows.bent())


def _looks_tidy(header: Sequence[str] | None) -> bool:
    return header is not None and len(set(header) & {*LABELS, *NUMBERS}) >= 3


def _overview(contents: _Contents) -> Table:
    pairs = contents.pairs
    table = Table.grid(padding=(0, 3))
    recordings = list(dict.fromkeys(pair.recording for pair in pairs))
    counted = [
        f"{name} ({sum(pair.recording == name for pair in pairs)} pairs)" for name in recordings
    ]
    lanes = sorted({pair.lane for pair in pairs if pair.lane is not None})
    steps = sorted({pair.dt for pair in pairs})
    table.add_row(
        "layout", {"tidy": "tidy pairs (SI units)", "ngsim": "NGSIM (feet)"}[contents.layout]
    )
    table.add_row("rows", f"{contents.rows:,}")
    table.add_row("vehicles", f"{contents.vehicles:,}")
    table.add_row(
        "recordings", f"{len(recordings)}: {listed(counted, 6)}" if counted else "none with pairs"
    )
    table.add_row("lanes", listed(lanes) if lanes else "not known")
    table.add_row(
        "pairs",
        f"{len(pairs):,} of {len({pair.driver for pair in pairs}):,} drivers, {sum(map(len, pairs)):,} frames",
    )
    table.add_row("time step", listed([f"{step:g} s" for step in steps]) if steps else "-")
    for frames in _THRESHOLDS:
        table.add_row(
            f"  of at least {frames} frames", f"{sum(len(pair) >= frames for pair in pairs):,}"
        )
    truth = {pair.truth_model for pair in pairs if pair.truth}
    if truth:
        table.add_row("true parameters", f"known, of {listed(sorted(truth))}")
    return table


def _motion(pairs: PairSet) -> Table:
    table = Table(box=None, padding=(0, 2), header_style="")
    table.add_column("over all pairs")
    for quantile in _QUANTILES:
        table.add_column(
            {0.0: "least", 0.5: "median", 1.0: "most"}.get(quantile, f"{quantile:.0%}"),
            justify="right",
        )
    for name, values in _quantities(pairs):
        if len(values):
            table.add_row(
                name,
                *(
                    f"{value:.0f}" if name == "frames" else f"{value:.2f}"
                    for value in np.quantile(values, _QUANTILES)
                ),
            )
    return table


def _quantities(pairs: PairSet) -> Iterator[tuple[str, Floats]]:
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
    return [
        "Left out:",
        *(f"  {drop.count:,} {drop.unit}: {drop.reason}" for drop in pairs.dropped),
    ]


def _problems(contents: _Contents) -> list[str]:
    """Returns what a recording may hold but rarely should."""
    found = [*_suspicions(contents.pairs), *([contents.problem] if contents.problem else [])]
    return (
        ["Problems:", *(f"  {sentence}" for sentence in found)]
        if found
        else ["Problems: none found"]
    )


def _suspicions(pairs: PairSet) -> Iterator[str]:
    if not len(pairs):
        yield "there is no leader-follower pair in it"
        return
    if len({round(pair.dt, 9) for pair in pairs}) > 1:
        yield "the pairs have different time steps; a job needs one: set data.time_step, or split the file"
    lengths = float(np.median([pair.leader_length for pair in pairs]))
    if lengths > 11:
        yield f"leaders are typically {lengths:.1f} m long: feet, or lorries only?"
    yield from _counted(pairs, "frames with a gap below 0.5 m", lambda pair: pair.gap < 0.5)
    yield from _counted(
        pairs,
        "frames with a speed above 50 m/s",
        lambda pair: np.maximum(pair.leader_speed, pair.follower_speed) > 50,
    )
    yield from _counted(
        pairs,
        "frames with an acceleration or braking above 8 m/s2",
        lambda pair: np.abs(pair.follower_acceleration) > 8,
    )
    yield from _counted(
        pairs, "steps in which a position moves 1 m more or less than its speed says", _jumps
    )
    yield from _counted(
        pairs,
        "steps in which a vehicle moves backwards",
        lambda pair: np.diff(pair.follower_position) < 0,
    )


def _jumps(pair: Pair) -> Marks:
    moved = np.diff(pair.follower_position)
    return np.abs(moved - pair.follower_speed[1:] * pair.dt) > 1.0


def _counted(pairs: PairSet, what: str, wrong: Callable[[Pair], Marks]) -> Iterator[str]:
    counts = [int(np.count_nonzero(wrong(pair))) for pair in pairs]
    if any(counts):
        worst = pairs[int(np.argmax(counts))].pair_id
        yield f"{sum(counts):,} {what}, in {np.count_nonzero(counts)} of {len(pairs)} pairs, most of them in '{worst}'"
