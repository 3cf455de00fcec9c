"""Describes a recording in text and tables: `python -m cfx data describe FILE`."""

from __future__ import annotations

import io
import logging
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from rich.console import Console, RenderableType
from rich.table import Table

from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.core.files import path_override
from cfx.core.registry import Entry
from cfx.data.base import Contents, Dataset, matching, rounded_down
from cfx.data.check import Check, judge
from cfx.data.files import Floats, Ints, beginning, has_letters, partitions
from cfx.data.pairs import (
    Dropped,
    Pair,
    PairSet,
    driver_names,
    frames_of_each,
    of_each,
    over_frames,
)
from cfx.data.plausible import doubts, rare
from cfx.data.resampling import frames_in_steps
from cfx.data.style import (
    ALL_TYPES,
    INDICATORS,
    NOT_KNOWN,
    STANDING_MPS,
    StyleResult,
    name_of_indicator,
    styles_by_site,
)
from cfx.errors import DataError, PluginError, listed

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

_THRESHOLDS_S = (10, 30, 70)
"""Durations for which pairs are counted, s."""

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

_TYPES = {"driver_type": "followers", "leader_driver_type": "leaders"}
"""Labels of a pair, and the questions that they answer."""

_WIDTH = 110
_WIDE = 150
"""Characters in a line, and in one of the table of styles."""

_ROUND_S = 5.0
"""A least duration that is advised is a multiple of it, s, if pairs last that long."""

_ROUNDING_S = 1e-6
"""Differences of durations that are rounding, s."""


class Description(NamedTuple):
    """What a recording holds.

    Attributes:
        text: for people.
        pairs: all of the file; none of a folder, whose files are read one after the other.
    """

    text: str
    pairs: PairSet | None


def describe(
    source: Path | str, settings: Mapping[str, Any] | None = None, options: str = ""
) -> Description:
    """Reads a recording and says what it holds.

    These are its rows, recordings and pairs, their motion, what was left out and why, and what
    looks wrong. Without settings the layout is found from the file itself: each dataset says
    whether it is its own, those of plugins too.

    Args:
        source: a file or folder, a file's URL, or a pattern of several.
        settings: of the dataset that reads it, and its `name`.
        options: what stands on the command line for these settings, after a blank.

    Raises:
        DataError: the file cannot be used; the message says why.
        ConfigError: a setting is wrong.
    """
    if settings is None:
        settings = {"name": dataset_of(source)}
    reader = _Reader(settings, options)
    if isinstance(source, Path) and reader.name == "tidy" and source.is_dir():
        return Description(_describe_partitions(source, reader), None)
    dataset = reader.of(source)
    contents = dataset.contents()
    pieces: list[RenderableType] = [
        str(source),
        "",
        _overview(dataset.layout, contents, dataset.units()),
    ]
    if len(contents.pairs):
        pieces += ["", _motion(contents.pairs)]
        pieces += _without_length(contents.pairs)
    left_out = _counts(contents.pairs.dropped)
    heading = "Left out in reading:"
    if not left_out:
        heading += " nothing"
    pieces += ["", heading, *left_out]
    if contents.pairs.ends:
        pieces += ["", "Why pairs end:", *_counts(contents.pairs.ends)]
    problems = [*_suspicions(contents, dataset.settings.check, dataset.units())]
    if contents.problem:
        problems.append(contents.problem)
    heading = "Problems:"
    if not problems:
        heading += " none found"
    pieces += ["", heading]
    for sentence in problems:
        pieces.append(f"  {sentence}")
    more, sentences = _advice(_lengths(contents.pairs), dataset.settings.min_duration)
    pieces += ["", reader.use(source) + more, *sentences]
    return Description(_text(pieces), contents.pairs)


def describe_sites(pairs: PairSet) -> str:
    """Compares the sites of pairs: a row for each, and for its types of drivers."""
    headings = ("pairs", "drivers", "minutes", "speed, m/s", "time headway, s", "gap, m")
    table = _table(
        "site", *headings, title="By site: medians over frames (5 % to 95 %)", right=1, left=1
    )
    of_site: dict[str, list[Pair]] = {}
    for pair in pairs:
        of_site.setdefault(pair.site or pair.recording, []).append(pair)
    for site, pairs_there in of_site.items():
        table.add_row(site, *_site_cells(pairs_there))
        of_type: dict[str, list[Pair]] = {}
        for pair in pairs_there:
            of_type.setdefault(pair.driver_type, []).append(pair)
        if len(of_type) > 1:
            for driver_type, pairs_of_type in of_type.items():
                table.add_row(f"  {driver_type or NOT_KNOWN}", *_site_cells(pairs_of_type))
    return _text([table], _WIDE)


def _site_cells(pairs: Sequence[Pair]) -> Iterator[str]:
    """Yields the cells of some pairs' row: counts, then how they drive."""
    seconds = 0.0
    for pair in pairs:
        seconds += pair.duration
    yield f"{len(pairs):,}"
    yield f"{len(driver_names(pairs)):,}"
    yield f"{seconds / 60:,.0f}"
    speed = over_frames(pairs, "follower_speed")
    with_length = _with_length(pairs)
    headway, at_speed = np.zeros(0), np.zeros(0)
    if with_length:
        headway = over_frames(with_length, "leader_position") - over_frames(
            with_length, "follower_position"
        )
        at_speed = over_frames(with_length, "follower_speed")
    moving = at_speed >= STANDING_MPS
    for values in (speed, headway[moving] / at_speed[moving], over_frames(pairs, "gap")):
        if not len(values):
            yield "-"
            continue
        low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
        yield f"{middle:.1f} ({low:.1f} to {high:.1f})"


def describe_style(style: StyleResult, distances: pd.DataFrame | None) -> str:
    """Says how the driving styles of sites differ, and in which indicator.

    Args:
        style: of drivers of at least two sites.
        distances: as `style_distances` returns them.
    """
    sites = styles_by_site(style)
    if sites is None:
        return "Driving style: there is one site alone; give the files of several"
    headings = ["site", "drivers", "score", "95 %"]
    weights = []
    for indicator in INDICATORS:
        words = name_of_indicator(indicator.name).replace(" ", "\n")
        headings.append(f"{words}\n{indicator.unit}")
        weights.append(f"{style.weights[indicator.name]:.2f}")
    title = "Driving style, 0 conservative to 1 aggressive: medians over drivers"
    table = _table(*headings, title=title, right=1, left=0)
    for column in table.columns:
        column.no_wrap = True
    table.add_row("entropy weight", "", "", "", *weights)
    for row in sites.to_dict("records"):
        interval, name = "-", str(row["site"])
        if row["driver_type"] != ALL_TYPES:
            name = f"  {row['driver_type']}"
        if np.isfinite(row["score_low"]):
            interval = f"{row['score_low']:.3f} to {row['score_high']:.3f}"
        medians = [f"{row[indicator.name]:.2f}" for indicator in INDICATORS]
        score = f"{row['score_median']:.3f}"
        table.add_row(name, str(row["drivers"]), score, interval, *medians)
    pieces: list[RenderableType] = [table]
    if distances is not None:
        pieces += ["", _distance_table(distances)]
    return _text(pieces, _WIDE)


def _distance_table(distances: pd.DataFrame) -> Table:
    """Returns how far the styles of any two sites are apart, a row for each two."""
    title = "How far apart: energy distance of the scores"
    table = _table("", "", "distance", "p", "differ most in", title=title, right=1, left=1)
    table.columns[1].justify = table.columns[4].justify = "left"
    for row in distances.to_dict("records"):
        ends = []
        for whose in ("", "other_"):
            site, driver_type = str(row[f"{whose}site"]), row[f"{whose}driver_type"]
            if driver_type != ALL_TYPES:
                site = f"{site}, {driver_type}"
            ends.append(site)
        most = name_of_indicator(str(row["most"]))
        table.add_row(*ends, f"{row['distance']:.3f}", f"{row['p_value']:.3f}", most)
    return table


def _table(*headings: str, title: str | None = None, right: int = 2, left: int = 2) -> Table:
    """Returns a table without rows and lines, whose first column holds names, the others numbers.

    Args:
        right, left: blanks beside a column.
    """
    table = Table(title=title, title_justify="left", box=None, padding=(0, right, 0, left))
    for heading in headings:
        table.add_column(heading, justify="right")
    table.columns[0].justify = "left"
    return table


class _Reader(NamedTuple):
    """Settings of the dataset that reads the files, and what stands for them on a command line."""

    settings: Mapping[str, Any]
    options: str

    @property
    def name(self) -> str:
        return str(self.settings["name"])

    def of(self, source: Path | str) -> Dataset:
        """Returns the dataset of a file."""
        return cast(Dataset, registry.create("dataset", {**self.settings, "path": str(source)}))

    def use(self, source: Path | str) -> str:
        """Returns the line that names the file in a job."""
        override = shlex.quote(path_override("data.path", source))
        return f"Use it: data={self.name} {override}{self.options}"


def _describe_partitions(folder: Path, reader: _Reader) -> str:
    """Says what each file of a folder holds; reads one file after the other."""
    long_s = _THRESHOLDS_S[-1]
    headings = ("recordings", "rows", "pairs", "drivers", "frames", f"of at least {long_s} s")
    table = _table("file", *headings)
    totals = np.zeros(5, np.int64)
    names: set[str] = set()
    lengths: list[tuple[int, float]] = []
    files = partitions(folder)
    for file in files:
        dataset = reader.of(file)
        contents = dataset.contents()
        pairs = contents.pairs
        recordings: set[str] = set()
        long = 0
        for pair in pairs:
            recordings.add(pair.recording)
            long += pair.lasts(long_s)
        drivers = len(driver_names(pairs))
        counts = np.array([contents.rows, len(pairs), drivers, pairs.frames, long])
        totals += counts
        names |= recordings
        lengths += _lengths(pairs)
        cells = _grouped_digits(counts)
        table.add_row(str(file.relative_to(folder)), listed(sorted(recordings), 2), *cells)
    table.add_row("all", f"{len(names):,}", *_grouped_digits(totals))
    more, sentences = _advice(lengths, dataset.settings.min_duration)
    layout = f"{dataset.layout}, {len(files)} files, read one after the other"
    one_file = "A recording alone: python -m cfx data describe FILE"
    one_recording = "One recording of it: data.recording=NAME"
    use = reader.use(folder) + more
    return _text([str(folder), "", layout, "", table, "", one_file, use, *sentences, one_recording])


def _grouped_digits(counts: Ints) -> list[str]:
    """Returns numbers as people write them: 12,345."""
    return [f"{count:,}" for count in counts.tolist()]


def _text(pieces: Sequence[RenderableType], width: int = _WIDTH) -> str:
    """Returns paragraphs and tables as one text."""
    text = io.StringIO()
    console = Console(file=text, width=width, highlight=False, markup=False, emoji=False)
    for piece in pieces:
        console.print(piece, soft_wrap=isinstance(piece, str))
    return "\n".join(map(str.rstrip, text.getvalue().splitlines()))


def dataset_of(source: Path | str) -> str:
    """Returns the name of the dataset that reads a file; cfx's own are asked before plugins'.

    Args:
        source: a file or folder, or the URL of a file; or a pattern of several, of which the first
            is looked at.

    Raises:
        DataError: it cannot be read, or has columns that none of them knows.
    """
    path = matching(source)[0]
    start = beginning(path)
    layouts = []
    # Sorting is stable: cfx's own come first, each group by name.
    entries = sorted(registry.entries("dataset"), key=lambda entry: entry.distribution != OWN)
    for entry in entries:
        cls = _usable(entry)
        if cls is None:
            continue
        if cls.recognises(start):
            return entry.name
        if cls.layout:
            layouts.append(f"{cls.layout} (data={entry.name})")
    if start.magic and not start.lines and not start.columns:
        raise DataError(
            f"{source}: is a binary file that no dataset knows. Known layouts:"
            f" {'; '.join(layouts)}. Write a table as CSV or parquet (docs/how-to/own-recording.md)"
        )
    if start.lines and start.lines[0].lstrip().startswith("<"):
        raise DataError(
            f"{source}: is XML, of which SUMO's FCD output alone is read (<fcd-export>); write a"
            " table as CSV or parquet (docs/how-to/own-recording.md)"
        )
    if start.path.is_dir():
        raise DataError(
            f"{source}: is a folder that no dataset reads as a whole; name the files in it, or give"
            f" a pattern such as '{start.path / '*.csv'}'. Known layouts: {'; '.join(layouts)}."
        )
    if has_letters("".join(start.columns)):
        raise DataError(
            f"{source}: no dataset knows this layout. Columns found: {listed(start.columns, 20)}."
            f" Known layouts: {'; '.join(layouts)}. {_own_columns(source, start.columns)}"
        )
    return "ngsim"  # whose reader says what is wrong with a file without column names


_AHEAD = "lead|ahead|front|prec|target|other"
_QUANTITIES = {
    "pair_id": "^(pair|trip|ride|run|event|session|id|drive)[ _-]?(id|no|number)?$",
    "time": "^(t|time|timestamp|seconds|sec|zeit)([ _(]|$)",
    "leader_speed": rf"({_AHEAD}).*(speed|vel|kmh|km/h|mph|mps)|(speed|vel|^v).*({_AHEAD})|^vl$",
    "speed": "speed|vel|^v([ _(]|$)|kmh|km/h|mph|mps",
    "gap": "gap|dist|spacing|range|clearance|abstand",
}
"""What a table of pairs has at least, and what its columns are called elsewhere."""

_WRITTEN_UNITS = {
    "km/h": "km/?h|kph",
    "mph": "mph",
    "ft/s": "ft/s|fps|ft_s",
    "ms": "(^|[ _(])(ms|millis)",
    "us": "(^|[ _(])(us|micros)",
    "ns": "(^|[ _(])(ns|nanos)",
    "ft": "(^|[ _(])(ft|feet)([ _)]|$)",
}
"""Units that names of columns end in."""


def _own_columns(source: Path | str, columns: Sequence[str]) -> str:
    """Returns what to write for a table whose columns have names of their own."""
    column_of: dict[str, str] = {}
    units = []
    for quantity, expression in _QUANTITIES.items():
        for name in columns:
            if name not in column_of.values() and re.search(expression, name.lower()):
                column_of[quantity] = name
                break
        unit = _unit_in(column_of.get(quantity, ""), quantity)
        if unit:
            units.append((quantity, unit))
    words = []
    for quantity in _QUANTITIES:
        words.append(f"data.columns.{quantity}={shlex.quote(column_of.get(quantity, 'COLUMN'))}")
    for quantity, unit in units:
        words.append(f"data.units.{quantity}={unit}")
    return (
        "If it is a table of pairs, a row for each pair and frame, say what its columns are, and"
        f" their units: cfx data describe {shlex.quote(str(source))} {' '.join(words)}"
        " (docs/how-to/own-recording.md); else see docs/readers.md"
    )


def _unit_in(name: str, quantity: str) -> str:
    """Returns the unit that a column's name says it has; "" if none."""
    units_of = {"time": ("ms", "us", "ns"), "gap": ("ft",)}
    for unit in units_of.get(quantity, ("km/h", "mph", "ft/s")):
        if quantity != "pair_id" and re.search(_WRITTEN_UNITS[unit], name.lower()):
            return unit
    return ""


def _usable(entry: Entry) -> type[Dataset] | None:
    """Returns a dataset's class; None, and a warning, for a plugin that is broken."""
    if registry.namesakes(entry):
        return None
    try:
        return cast(type[Dataset], registry.get("dataset", entry.name))
    except PluginError as error:
        log.warning("%s", error)
        return None


def _lengths(pairs: PairSet) -> list[tuple[int, float]]:
    """Returns the frames of each pair, and its time step, s."""
    lengths = []
    for pair in pairs:
        lengths.append((len(pair), round(pair.dt, 9)))  # 0.1 is the same step however it was made
    return lengths


def _advice(pairs: Sequence[tuple[int, float]], usual: float) -> tuple[str, list[str]]:
    """Returns the options that a job needs to use at least half of the pairs, and what it keeps.

    Args:
        pairs: frames and time steps, of all files.
        usual: how long a pair lasts at least, s, that a job keeps unless told otherwise.
    """
    if not pairs:
        return "", []
    options = ""
    _, recorded_steps = np.array(pairs).T
    step = float(recorded_steps.max())
    if recorded_steps.min() < step:
        options = f" data.time_step={step:g}"
    in_steps = [frames_in_steps(frames, dt, step) for frames, dt in pairs]
    durations = np.sort(np.array(in_steps) * step)
    median = float(durations[(len(durations) - 1) // 2])
    min_duration = usual
    if np.count_nonzero(durations >= usual - _ROUNDING_S) * 2 < len(durations):
        min_duration = rounded_down(median)
        if min_duration > _ROUND_S:
            min_duration = min_duration // _ROUND_S * _ROUND_S
        options += f" data.min_duration={min_duration:g}"
    kept = np.count_nonzero(durations >= min_duration - _ROUNDING_S)
    if kept == len(durations):
        return options, [f"It keeps all {kept:,} pairs."]
    shortest = rounded_down(float(durations[0]))
    return options, [
        f"It keeps {kept:,} of {len(durations):,} pairs and leaves out {len(durations) - kept:,}"
        f" shorter than {min_duration:g} s; data.min_duration={shortest:g} keeps all."
    ]


def _without_length(pairs: PairSet) -> list[str]:
    """Returns a sentence on leaders whose length is not known; nothing where all are."""
    unknown = len(pairs) - len(_with_length(pairs))
    if not unknown:
        return []
    return [
        f"The length of {unknown:,} of {len(pairs):,} leaders is not known: their positions are of"
        " rear bumpers, and from front to front they are farther than the gap by their length"
    ]


def _with_length(pairs: Sequence[Pair]) -> list[Pair]:
    """Returns the pairs whose leader's length is known."""
    return [pair for pair in pairs if pair.leader_length > 0]


def _overview(layout: str, contents: Contents, units: Mapping[str, str]) -> Table:
    """Returns what a file holds, a row per question."""
    pairs = contents.pairs
    recordings: Counter[str] = Counter()
    lanes: set[int] = set()
    steps: set[float] = set()
    truth: set[str] = set()
    for pair in pairs:
        recordings[pair.recording] += 1
        steps.add(pair.dt)
        if pair.lane is not None:
            lanes.add(pair.lane)
        if pair.truth:
            truth.add(pair.truth_model)

    table = Table.grid(padding=(0, 3))
    table.add_row("layout", layout)
    table.add_row("rows", f"{contents.rows:,}")
    table.add_row("vehicles", _vehicles(contents))
    if units:
        read_in = []
        for name, unit in units.items():
            read_in.append(f"{name.replace('_', ' ')} in {unit}")
        table.add_row("units", f"as read: {listed(read_in, 10)}; converted to SI units")
    with_pairs = "none with pairs"
    if recordings:
        with_pairs = f"{len(recordings)}: {listed(_with_counts(recordings), 6)}"
    table.add_row("recordings", with_pairs)
    table.add_row("lanes", listed(sorted(lanes)) or "not known")
    drivers = len(driver_names(pairs))
    table.add_row("pairs", f"{len(pairs):,} of {drivers:,} drivers, {pairs.frames:,} frames")
    table.add_row("time step", listed(list(map("{:g} s".format, sorted(steps)))) or "-")
    for duration in _THRESHOLDS_S:
        long = 0
        for pair in pairs:
            long += pair.lasts(duration)
        table.add_row(f"  of at least {duration} s", f"{long:,}")
    for name, title in _TYPES.items():
        types: Counter[str] = Counter()
        for pair in pairs:
            types[getattr(pair, name) or "not known"] += 1
        if set(types) - {"not known"}:
            table.add_row(title, listed(_with_counts(types)))
    if truth:
        table.add_row("true parameters", f"known, of {listed(sorted(truth))}")
    return table


def _vehicles(contents: Contents) -> str:
    """Returns how many vehicles a file names, and which it does not."""
    if not contents.unnamed:
        return f"{contents.vehicles:,}"
    if not contents.vehicles:
        return f"not known: {contents.unnamed}"
    return f"{contents.vehicles:,}; {contents.unnamed}"


def _with_counts(pairs: Mapping[str, int]) -> list[str]:
    """Returns names with the number of pairs that each has."""
    return [f"{name} ({count} pairs)" for name, count in pairs.items()]


def _motion(pairs: PairSet) -> Table:
    """Returns how the vehicles move: quantiles over all frames."""
    table = _table("over all pairs", *_QUANTILES.values())
    for name, values in _quantities(pairs):
        if not len(values):
            continue
        decimals = 2
        if name == "frames":
            decimals = 0
        quantiles = np.quantile(values, list(_QUANTILES)).tolist()
        cells = [f"{value:.{decimals}f}" for value in quantiles]
        table.add_row(name, *cells)
    return table


def _quantities(pairs: PairSet) -> Iterator[tuple[str, Floats]]:
    """Yields what the table of motion is about: a name with its unit, and the values."""
    speed = over_frames(pairs, "follower_speed")
    gap = over_frames(pairs, "gap")
    yield "frames", np.array(frames_of_each(pairs), dtype=np.float64)
    yield "leader speed, m/s", over_frames(pairs, "leader_speed")
    yield "follower speed, m/s", speed
    yield "follower acceleration, m/s2", over_frames(pairs, "follower_acceleration")
    yield "gap (bumper to bumper), m", gap
    with_length = _with_length(pairs)
    if not with_length:
        moving = speed >= STANDING_MPS
        yield f"time gap (above {STANDING_MPS:g} m/s), s", gap[moving] / speed[moving]
        return
    speed = over_frames(with_length, "follower_speed")
    headway = over_frames(with_length, "leader_position") - over_frames(
        with_length, "follower_position"
    )
    moving = speed >= STANDING_MPS
    yield "space headway (front to front), m", headway
    yield f"time headway (above {STANDING_MPS:g} m/s), s", headway[moving] / speed[moving]
    yield "leader length, m", np.array(of_each(with_length, "leader_length"))


def _counts(counts: Sequence[Dropped]) -> list[str]:
    lines = []
    for dropped in counts:
        lines.append(f"  {dropped.count:,} {dropped.unit}: {dropped.reason}")
    return lines


def _suspicions(contents: Contents, check: Check, units: Mapping[str, str]) -> Iterator[str]:
    """Yields a sentence for each kind of values that a recording rarely holds."""
    pairs = contents.pairs
    if not len(pairs):
        yield "there is no leader-follower pair in it"
        return
    steps, without_length = set(), 0
    for pair in pairs:
        steps.add(round(pair.dt, 9))
        without_length += pair.leader_length == 0
    if len(steps) > 1:
        yield (
            "the pairs have different time steps; a job needs one: set data.time_step, or split"
            " the file"
        )
    if without_length and not contents.has_gaps:
        yield (
            f"{without_length} pairs have leaders of length 0: their gaps are bumper to bumper if"
            " leader positions are those of rear bumpers, and too long by a vehicle if not"
        )
    verdict = judge(pairs, check, units)
    if verdict.words:
        yield f"{verdict.words}; {verdict.consequence}"
    yield from doubts(pairs)
    yield from rare(pairs)
