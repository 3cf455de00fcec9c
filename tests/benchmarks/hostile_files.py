"""Hostile but plausible files: each is read as it is meant, or refused with the column and reason.

    python -m tests.benchmarks.hostile_files --files 1000 --data ../shared/data

A file is a layout that cfx reads, some pairs of a recording (made-up ones without `--data`), and
one to three corruptions, drawn from a seed. Harmless ones change how the file is written, not what
it says: it must be read equal to the clean one, or what is left out must be counted. Harmful ones
make it say something else: it must be refused, for the right reason. Read otherwise than it is
meant and without a word: that is the bar, and there must be none.

Prints a row for each corruption, as docs/hostile_files.md has it, and each file that was not
answered right.
"""

from __future__ import annotations

import argparse
import bz2
import csv
import gzip
import logging
import lzma
import re
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import torch

from cfx.core import registry
from cfx.data.pairs import Pair, PairSet
from cfx.errors import CfxError, in_words
from cfx.models.krauss import Krauss
from tests.benchmarks.spoiled_files import BOTH, LAYOUTS, Layout, Signals, chosen, of
from tests.drives import wavy_pairs

FOOT = 0.3048
WRITTEN = ("tidy", "tidy with gaps", "OpenACC", "NGSIM", "highD", "Waymo", "SUMO")
"""Layouts that are text, whose writing can be changed."""

TIMES = ("time_s", "Time", "local_time", "timestep_time", "frame", "Frame_ID", "Global_Time")
IDS = ("Vehicle_ID", "id", "local_veh_id", "leader_id", "follower_id", "segment_id", "Preceding")
TOLERANCE = 2e-3


# --- files ----------------------------------------------------------------------------------------


@dataclass
class File:
    """A table of text, and how it is written.

    Attributes:
        path: of the file.
        above: lines above the table.
        table: its cells; numbers are numbers until they are written.
        mark, thousands: in numbers.
        write: what becomes of the text last.
    """

    path: Path
    above: list[str]
    table: pd.DataFrame
    rng: np.random.Generator
    separator: str = ","
    mark: str = "."
    thousands: str = ""
    number: str = ".6f"
    blanks: bool = False
    quoted: bool = False
    as_text: Callable[[str], bytes] = str.encode
    packed: str = ""
    parquet: bool = False
    cells: dict[tuple[int, str], str] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, rng: np.random.Generator) -> File:
        lines = path.read_text().splitlines()
        above = []
        while lines and lines[0].split(",")[0] in {
            "Date",
            "Vehicle_order",
            "Number_of_vehicles",
            "ACC",
            "Distance_setting",
        }:
            above.append(lines.pop(0))
        table = pd.read_csv(path, skiprows=len(above))
        return cls(path, above, table, rng)

    @property
    def numbers(self) -> list[str]:
        """Columns of numbers with decimals that are neither times nor ids."""
        found = []
        for name in self.table:
            if self.table[name].dtype.kind == "f" and name not in {*TIMES, *IDS}:
                found.append(str(name))
        return found

    def written(self) -> None:
        """Writes the file anew."""
        table = self.table
        if self.parquet:
            self.path = self.path.with_suffix(".parquet")
            table.to_parquet(self.path, index=False)
            return
        text = pd.DataFrame({name: self._texts(table[name]) for name in table})
        for (row, name), cell in self.cells.items():
            text.loc[text.index[row], name] = cell
        quoting = csv.QUOTE_ALL if self.quoted else csv.QUOTE_MINIMAL
        body = text.to_csv(index=False, sep=self.separator, quoting=quoting)
        above = [line.replace(",", self.separator) for line in self.above]
        content = self.as_text("\n".join([*above, body]))
        self.path.unlink()
        if self.packed == ".gz":
            content = gzip.compress(content, mtime=0)
        elif self.packed == ".xz":
            content = lzma.compress(content)
        elif self.packed == ".bz2":
            content = bz2.compress(content)
        elif self.packed == ".zst":
            content = bytes(pa.Codec("zstd").compress(content, asbytes=True))
        target = self.path.with_name(self.path.name + self.packed)
        if self.packed == ".zip":
            with zipfile.ZipFile(target, "w") as archive:
                archive.writestr(self.path.name, content)
        else:
            target.write_bytes(content)
        self.path = target

    def _texts(self, column: pd.Series) -> list[str]:
        texts = []
        for cell in column.tolist():
            texts.append(self._text(cell, is_number=column.dtype.kind == "f"))
        return texts

    def _text(self, cell: Any, *, is_number: bool) -> str:
        if pd.isna(cell):
            return ""
        text = str(cell)
        if is_number:
            text = f"{cell:,{self.number}}" if self.thousands else f"{cell:{self.number}}"
            text = text.replace(",", "T").replace(".", self.mark).replace("T", self.thousands)
        return f" {text} " if self.blanks else text


class Case(NamedTuple):
    """A corruption.

    Attributes:
        name: in words.
        reason: what is said where it is refused, a regular expression; "" where it is harmless.
        signals: changes what a pair's signals say, before they are written.
        file: changes how the file is written.
        layouts: which layouts it can be in.
        may: its right answer is either; what is said where it is refused.
        kept: of signals that are changed without harm, whether they are what the file then means.
    """

    name: str
    reason: str = ""
    signals: Callable[[Signals, np.random.Generator], Signals] | None = None
    file: Callable[[File], None] | None = None
    layouts: Sequence[str] = tuple(LAYOUTS)
    may: str = ""
    kept: bool = False


# --- what is done to signals ----------------------------------------------------------------------


def times(factor: float, what: str, who: Sequence[str] = BOTH) -> Any:
    def change(signals: Signals, _: np.random.Generator) -> Signals:
        names = [name for name in ("gap", "time") if name == what] or of(who, what)
        found = {name: signals[name] * factor for name in names if name in signals}
        if what == "speed" and "relative_speed" in signals:
            found["relative_speed"] = signals["relative_speed"] * factor
        return signals | found

    return change


def thinned(signals: Signals, _: np.random.Generator) -> Signals:
    return {name: values[::2] for name, values in signals.items()}


def renumbered(signals: Signals, rng: np.random.Generator) -> Signals:
    found = thinned(signals, rng)
    return found | {"time": signals["time"][: len(found["time"])]}


def moved(signals: Signals, _: np.random.Generator) -> Signals:
    return signals | {name: signals[name] + 40_000.0 for name in of(BOTH, "position")}


def integrated(share: float) -> Any:
    """Positions that follow the new speed of each step (1), the old one (0) or their mean."""

    def change(signals: Signals, _: np.random.Generator) -> Signals:
        step = signals["time"][1] - signals["time"][0]
        found = {}
        for who in BOTH:
            speed, position = signals[f"{who}_speed"], signals[f"{who}_position"]
            driven = np.zeros(len(speed))
            driven[1:] = np.cumsum(share * speed[1:] + (1 - share) * speed[:-1]) * step
            found[f"{who}_position"] = position[0] + driven
        gap = found["leader_position"] - found["follower_position"]
        before = signals["leader_position"] - signals["follower_position"]
        lift = max(0.0, float((before - gap).max()))
        found["leader_position"] = found["leader_position"] + lift
        return signals | found

    return change


def swapped(what: str) -> Any:
    first, second = of(BOTH, what)

    def change(signals: Signals, _: np.random.Generator) -> Signals:
        found = signals | {first: signals[second], second: signals[first]}
        if "relative_speed" in signals:
            found["relative_speed"] = found["leader_speed"] - found["follower_speed"]
        return found

    return change


def late(what: str) -> Any:
    def change(signals: Signals, _: np.random.Generator) -> Signals:
        name = f"follower_{what}"
        values = signals[name]
        return signals | {name: np.concatenate([np.repeat(values[0], 15), values[:-15]])}

    return change


def constant(what: str) -> Any:
    def change(signals: Signals, _: np.random.Generator) -> Signals:
        name = f"follower_{what}"
        return signals | {name: np.full(len(signals[name]), float(np.median(signals[name])))}

    return change


def leaps(signals: Signals, rng: np.random.Generator) -> Signals:
    values = signals["follower_speed"].copy()
    values[int(rng.integers(20, len(values) - 20))] += 300.0
    return signals | {"follower_speed": values}


# --- what is done to files ------------------------------------------------------------------------


def set_to(**values: Any) -> Callable[[File], None]:
    def change(file: File) -> None:
        for name, value in values.items():
            setattr(file, name, value)

    return change


def shuffled_rows(file: File) -> None:
    file.table = file.table.sample(frac=1.0, random_state=int(file.rng.integers(1 << 30)))


def shuffled_columns(file: File) -> None:
    order = file.rng.permutation(len(file.table.columns))
    file.table = file.table.iloc[:, order]


def more_columns(file: File) -> None:
    file.table = file.table.assign(note="a;b", weather=3, signal_db=-70.5)


def float_ids(file: File) -> None:
    for name in IDS:
        if name in file.table and file.table[name].dtype.kind == "i":
            cells = [f"{number}{file.mark}0" for number in file.table[name].tolist()]
            file.table[name] = cells


def duplicated_rows(file: File) -> None:
    at = int(file.rng.integers(0, max(1, len(file.table) - 60)))
    file.table = pd.concat([file.table, file.table.iloc[at : at + 50]])


def duplicated_other(file: File) -> None:
    """A block of rows again, with other values."""
    at = int(file.rng.integers(0, max(1, len(file.table) - 60)))
    block = file.table.iloc[at : at + 50].copy()
    for name in file.numbers:
        block[name] += 0.5
    file.table = pd.concat([file.table, block])


def missing_rows(file: File) -> None:
    at = int(file.rng.integers(30, len(file.table) - 30))
    file.table = file.table.drop(file.table.index[at : at + 7])


def empty_cells(file: File) -> None:
    name = str(file.rng.choice(file.numbers))
    at = int(file.rng.integers(30, len(file.table) - 30))
    file.table.iloc[at : at + 5, file.table.columns.get_loc(name)] = np.nan


def a_cell(text: str) -> Callable[[File], None]:
    def change(file: File) -> None:
        name = str(file.rng.choice(file.numbers))
        file.cells[int(file.rng.integers(len(file.table))), name] = text

    return change


def other_mark(file: File) -> None:
    name = str(file.rng.choice(file.numbers))
    row = int(file.rng.integers(len(file.table)))
    number = float(file.table[name].iloc[row])
    other = {".": ",", ",": "."}[file.mark]
    file.cells[row, name] = f"{number:.6f}".replace(".", other)


def without_column(file: File) -> None:
    needed = [name for name in file.numbers if re.search("(?i)speed|v_vel|xvelocity", name)]
    file.table = file.table.drop(columns=needed[:1])


def column_twice(file: File) -> None:
    names = [name for name in file.numbers if re.search("(?i)speed|v_vel|xvelocity", name)]
    file.as_text = lambda text: (
        text.replace("\n", f"{file.separator}1\n")
        .replace(f"{file.separator}1\n", f"{file.separator}{names[0]}\n", 1)
        .encode()
    )


def cut_off(file: File) -> None:
    file.as_text = lambda text: text.encode()[: int(0.7 * len(text))].rsplit(b",", 1)[0]


def windows(text: str) -> bytes:
    return b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode() + b"\r\n\r\n"


def umlauts(file: File) -> None:
    file.table = file.table.assign(note="Straße")
    file.as_text = lambda text: text.encode("latin-1")


def dates(file: File) -> None:
    for name in ("time_s", "Time", "local_time"):
        if name in file.table:
            since = pd.to_timedelta(file.table[name].round(3), unit="s")
            file.table[name] = (pd.Timestamp("2026-03-01") + since).astype(str)


def epochs(file: File) -> None:
    for name in ("time_s", "Time", "local_time", "timestep_time"):
        if name in file.table:
            file.table[name] = file.table[name] + 1_767_225_600.0


def later_frames(file: File) -> None:
    for name in ("frame", "Frame_ID"):
        if name in file.table:
            file.table[name] += 5000
    if "Global_Time" in file.table:
        file.table["Global_Time"] += 500_000


def a_leader_less(file: File) -> None:
    """All rows of one leader are missing."""
    name = next(
        name for name in ("Vehicle_ID", "local_veh_id", "vehicle_id", "id") if name in file.table
    )
    if name == "local_veh_id":
        rows = (file.table[name] == 7) & (file.table["segment_id"] == 0)
    else:
        rows = file.table[name] == file.table[name].iloc[0]
    file.table = file.table[~rows]


def ids_again(file: File) -> None:
    """The second half of the vehicles has the ids of the first half, later on."""
    name = "Vehicle_ID" if "Vehicle_ID" in file.table else "id"
    frame = "Frame_ID" if "Frame_ID" in file.table else "frame"
    leader = "Preceding" if "Preceding" in file.table else "precedingId"
    half = 2 * (int(file.table[name].max()) // 4)
    again = file.table[name] > half
    file.table.loc[again, frame] += int(file.table[frame].max()) + 50
    for column in (name, leader):
        rows = again & (file.table[column] > half)
        file.table.loc[rows, column] -= half
    file.table = file.table.drop(columns=[one for one in ("Global_Time",) if one in file.table])


def leaders_swapped(file: File) -> None:
    """Two followers have each other's leader."""
    name = next(name for name in ("Preceding", "precedingId", "leader_id") if name in file.table)
    leaders = [number for number in pd.unique(file.table[name]) if number][:2]
    swap = {leaders[0]: leaders[-1], leaders[-1]: leaders[0]}
    file.table[name] = file.table[name].replace(swap)


def lengths_in_feet(file: File) -> None:
    for name in ("leader_length_m", "width", "length"):
        if name in file.table:
            file.table[name] /= FOOT


def trembling_times(file: File) -> None:
    for name in ("time_s", "Time", "local_time"):
        if name in file.table:
            jitter = file.rng.uniform(-0.0015, 0.0015, len(file.table))
            file.table[name] = file.table[name] + jitter


def no_values(file: File) -> None:
    """Numbers that stand for no value, as recorders write them."""
    name = str(file.rng.choice(file.numbers))
    at = int(file.rng.integers(30, len(file.table) - 30))
    file.table.iloc[at : at + 5, file.table.columns.get_loc(name)] = -9999.0


def row_of_units(file: File) -> None:
    units = file.separator.join(["[-]"] * len(file.table.columns))
    file.as_text = lambda text: _inserted(text, len(file.above) + 1, units)


def header_again(file: File) -> None:
    """As where several files were put into one."""
    file.as_text = lambda text: _inserted(text, 200, text.splitlines()[len(file.above)])


def remark_on_top(file: File) -> None:
    file.as_text = lambda text: _inserted(text, 0, "# exported by a recorder")


def sums_below(file: File) -> None:
    sums = file.separator.join(["mean"] * len(file.table.columns))
    file.as_text = lambda text: f"{text}{sums}\n".encode()


def _inserted(text: str, at: int, line: str) -> bytes:
    lines = text.splitlines()
    return "\n".join([*lines[:at], line, *lines[at:], ""]).encode()


def texts_in_parquet(file: File) -> None:
    file.parquet = True
    for name in file.numbers:
        file.table[name] = [f"{number:.6f}".replace(".", ",") for number in file.table[name]]


def decimals_in_parquet(file: File) -> None:
    import decimal

    file.parquet = True
    for name in file.numbers:
        cells = [decimal.Decimal(f"{number:.6f}") for number in file.table[name]]
        file.table[name] = pd.Series(cells, index=file.table.index, dtype=object)


EMPTY = "is empty|empty or NaN|missing|no number|columns instead of|instead of"
TEXT = WRITTEN
TREMBLE = ("tidy", "tidy with gaps", "OpenACC", "Waymo")
NO_VALUES = "negative|leaps|acceleration is|behind|-9999|no vehicle length|against|steps differ"
METRIC = tuple(name for name in LAYOUTS if name != "NGSIM")
SI = ("tidy", "highD", "Waymo", "Lyft", "SUMO")
FULL = ("tidy", "NGSIM", "highD", "Waymo", "Lyft", "SUMO")
STEP = "time step|times in|steps differ"
CASES: tuple[Case, ...] = (
    Case("decimal commas, semicolons", file=set_to(mark=",", separator=";"), layouts=TEXT),
    Case("decimal commas in quotes", file=set_to(mark=",", quoted=True), layouts=TEXT),
    Case("thousands with commas", file=set_to(thousands=",", quoted=True), layouts=TEXT),
    Case(
        "thousands with points", file=set_to(mark=",", thousands=".", separator=";"), layouts=TEXT
    ),
    Case(
        "thousands with blanks",
        file=set_to(mark=",", thousands="\u00a0", separator=";"),
        layouts=TEXT,
    ),
    Case("thousands with apostrophes", file=set_to(thousands="'"), layouts=TEXT),
    Case("exponents", file=set_to(number=".9e"), layouts=TEXT),
    Case("tabs", file=set_to(separator="\t"), layouts=TEXT),
    Case("vertical bars", file=set_to(separator="|"), layouts=TEXT),
    Case("blanks around cells", file=set_to(blanks=True), layouts=TEXT),
    Case("byte-order mark, line ends of Windows", file=set_to(as_text=windows), layouts=TEXT),
    Case("gzip", file=set_to(packed=".gz"), layouts=TEXT),
    Case("zip", file=set_to(packed=".zip"), layouts=TEXT),
    Case("zstd", file=set_to(packed=".zst"), layouts=TEXT),
    Case("xz", file=set_to(packed=".xz"), layouts=TEXT),
    Case("order of columns", file=shuffled_columns, layouts=TEXT),
    Case("order of rows", file=shuffled_rows, layouts=TEXT, may="does not advance|do not advance"),
    Case("columns of no use", file=more_columns, layouts=TEXT),
    Case("ids as floats", file=float_ids, layouts=TEXT),
    Case(
        "rows again",
        file=duplicated_rows,
        layouts=TEXT,
        may="does not advance|two rows|same pair and frame|do not advance|twice",
    ),
    Case(
        "dates in place of times",
        file=dates,
        layouts=("tidy", "tidy with gaps", "OpenACC", "Waymo"),
    ),
    Case(
        "times since 1970",
        file=epochs,
        layouts=("tidy", "tidy with gaps", "OpenACC", "Waymo", "SUMO"),
    ),
    Case(
        "frames from 5000 on",
        file=later_frames,
        layouts=("tidy", "tidy with gaps", "NGSIM", "highD"),
    ),
    Case("text in parquet", file=texts_in_parquet, layouts=("tidy", "tidy with gaps", "SUMO")),
    Case(
        "decimals in parquet", file=decimals_in_parquet, layouts=("tidy", "tidy with gaps", "SUMO")
    ),
    Case(
        "another origin",
        signals=moved,
        layouts=("tidy", "NGSIM", "highD", "Waymo", "SUMO", "Lyft"),
        kept=True,
    ),
    Case(
        "every second frame",
        signals=thinned,
        layouts=("tidy", "tidy with gaps", "NGSIM", "highD", "SUMO", "FollowNet"),
        kept=True,
    ),
    Case("integrated by new speeds", signals=integrated(1.0), layouts=FULL, kept=True),
    Case("integrated by old speeds", signals=integrated(0.0), layouts=FULL, kept=True),
    Case("ids again", file=ids_again, layouts=("NGSIM", "highD")),
    Case(
        "rows missing", file=missing_rows, layouts=TEXT, may="frames are missing|differ|time step"
    ),
    Case("cells empty", file=empty_cells, layouts=TEXT, may=EMPTY),
    Case(
        "a leader not recorded",
        file=a_leader_less,
        layouts=("NGSIM", "highD", "Waymo", "SUMO"),
        may="no leader-follower pair",
    ),
    Case("speeds in km/h", "look like km/h", times(3.6, "speed"), layouts=METRIC),
    Case("speeds in m/s beside feet", "look like m/s", times(FOOT, "speed"), layouts=("NGSIM",)),
    Case("positions in m beside feet", "look like m,", times(FOOT, "position"), layouts=("NGSIM",)),
    Case(
        "leader's speeds in mph",
        "look like mph|row 3",
        times(2.23694, "speed", BOTH[:1]),
        layouts=METRIC,
    ),
    Case(
        "positions in feet",
        "look like ft",
        times(1 / FOOT, "position"),
        layouts=SI,
    ),
    Case(
        "gaps in feet",
        "look like ft",
        times(1 / FOOT, "gap"),
        layouts=("tidy with gaps", "OpenACC", "FollowNet"),
    ),
    Case("accelerations in g", "look like g_0", times(1 / 9.80665, "acceleration"), layouts=SI),
    Case("accelerations with the other sign", "sign", times(-1.0, "acceleration"), layouts=FULL),
    Case("speeds with the other sign", "is negative|against", times(-1.0, "speed")),
    Case(
        "positions with the other sign",
        "must grow|is behind its follower|sign turned|against its lane",
        times(-1.0, "position"),
        layouts=FULL,
    ),
    Case(
        "times doubled",
        STEP,
        times(2.0, "time"),
        layouts=(
            "tidy",
            "tidy with gaps",
            "FollowNet",
            "highD",
            "SUMO",
            "Waymo",
            "Lyft",
            "OpenACC",
            "NGSIM",
        ),
    ),
    Case(
        "times in ms",
        STEP,
        times(1000.0, "time"),
        layouts=("tidy", "tidy with gaps", "SUMO", "Waymo", "Lyft", "OpenACC"),
    ),
    Case(
        "every second row, numbered anew",
        STEP,
        renumbered,
        layouts=(
            "tidy",
            "tidy with gaps",
            "NGSIM",
            "highD",
            "SUMO",
            "Waymo",
            "Lyft",
            "FollowNet",
            "OpenACC",
        ),
    ),
    Case("speeds of leader and follower swapped", "swapped", swapped("speed")),
    Case(
        "positions of leader and follower swapped",
        "is behind its follower|swapped|the gap changes -",
        swapped("position"),
        layouts=FULL,
    ),
    Case(
        "an acceleration late",
        "s later|same time",
        late("acceleration"),
        layouts=FULL,
    ),
    Case(
        "an acceleration constant",
        "in every frame",
        constant("acceleration"),
        layouts=FULL,
    ),
    Case("a speed leaps", "leaps|the acceleration is|row 3", leaps),
    Case(
        "rows again with other values",
        "two (different )?rows|same pair and frame|does not advance|twice|do not advance|time step",
        file=duplicated_other,
        layouts=TEXT,
    ),
    Case("a word in a cell", "is not a number", file=a_cell("error"), layouts=TEXT),
    Case("a unit in a cell", "is not a number", file=a_cell("12.5 m"), layouts=TEXT),
    Case(
        "another decimal mark in a cell",
        "is not a number|may be|columns instead",
        file=other_mark,
        layouts=TEXT,
    ),
    Case("a column missing", "missing|no two vehicles|no such", file=without_column, layouts=TEXT),
    Case("a column twice", "more than once", file=column_twice, layouts=TEXT),
    Case(
        "cut off in a row", "cut off|instead of|empty|missing|no number", file=cut_off, layouts=TEXT
    ),
    Case("times that tremble by 1.5 ms", file=trembling_times, layouts=TREMBLE),
    Case(
        "leaders of two followers swapped",
        file=leaders_swapped,
        layouts=("NGSIM", "highD"),
        may="no leader-follower pair|by which another",
    ),
    Case(
        "lengths in feet",
        "feet|behind|no leader-follower pair|dhw",
        file=lengths_in_feet,
        layouts=("tidy", "highD", "Waymo"),
    ),
    Case("-9999 in cells", file=no_values, layouts=TEXT, may=NO_VALUES),
    Case("a row of units below the header", "is not a number", file=row_of_units, layouts=TEXT),
    Case("the header again below", "is not a number", file=header_again, layouts=TEXT),
    Case("a remark above the header", file=remark_on_top, layouts=TEXT),
    Case("a row of means at the end", "is not a number", file=sums_below, layouts=TEXT),
    Case("UTF-16", "UTF-16", file=set_to(as_text=lambda text: text.encode("utf-16")), layouts=TEXT),
    Case("Latin-1", "UTF-8", file=umlauts, layouts=TEXT),
)


# --- one file -------------------------------------------------------------------------------------


ANSWERS = ("right", "unnamed", "refused wrongly", "warned", "crash", "silent")
"""What becomes of a file: it is answered right; refused for another reason; refused though it is
right; read with a warning, or what is left out counted; none of these."""


@dataclass(frozen=True)
class Outcome:
    """What became of a file.

    Attributes:
        said: why it was refused; "" where it was read.
        wrong: how what was read differs from what it means; "" where it does not.
        warned: what was warned of, or counted as left out.
    """

    number: int
    layout: str
    cases: tuple[Case, ...]
    said: str
    wrong: str
    warned: str

    @property
    def is_harmless(self) -> bool:
        return not any(case.reason for case in self.cases)

    @property
    def answer(self) -> str:
        """What the answer was: one of `ANSWERS`."""
        if self.wrong.startswith("crash"):
            return "crash"
        if self.said:
            reasons = [case.reason or case.may for case in self.cases if case.reason or case.may]
            if any(re.search(reason, self.said) for reason in reasons):
                return "right"
            return "refused wrongly" if self.is_harmless else "unnamed"
        if self.is_harmless and not self.wrong:
            return "right"
        if self.warned:
            return "warned"
        # Harm that changes nothing that is read, as accelerations do in files that have none.
        return "silent" if self.wrong else "right"


_ABSENT = {"rows missing", "a leader not recorded"}
"""Corruptions that leave out what a file then cannot say."""

_OF_CLEAN_FILES = re.compile(
    "does not say how long vehicles are|without a column follower_id|are noisy: averages"
)
"""Warnings of files that are as they should be."""


class _Warnings(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if not _OF_CLEAN_FILES.search(record.getMessage()):
            self.said.append(record.getMessage())


def drawn(
    number: int, recordings: Sequence[Sequence[Pair]], folder: Path, only: Sequence[str] = ()
) -> Outcome:
    """Makes the file of a number and reads it.

    Args:
        only: names of corruptions; (): drawn.
    """
    rng = np.random.default_rng(number)
    name = list(LAYOUTS)[number % (len(LAYOUTS) - 1)]  # all but the plugin
    layout = LAYOUTS[name]
    possible = [case for case in CASES if name in case.layouts and _fits(case, layout)]
    if only:
        cases = tuple(case for case in possible if case.name in only)
    else:
        count = int(rng.choice([1, 2, 3], p=[0.6, 0.25, 0.15]))
        cases = _compatible([possible[at] for at in rng.permutation(len(possible))], count)
    pairs = recordings[int(rng.integers(len(recordings)))]
    originals = [layout.signals(pair) for pair in pairs]
    lengths = [(pair.leader_length or 4.5) / layout.foot for pair in pairs]
    meant = [dict(signals) for signals in originals]
    for case in cases:
        if case.signals is not None:
            originals = [case.signals(signals, rng) for signals in originals]
            if case.kept:
                meant = [case.signals(signals, rng) for signals in meant]
    settings = dict(layout.write(folder, originals, lengths))
    if name in WRITTEN:
        settings = _rewritten(name, folder, settings, cases, rng)
    heard = _Warnings()
    logging.getLogger("cfx").addHandler(heard)
    said = wrong = ""
    try:
        dataset: Any = registry.get("dataset", layout.dataset)
        read = dataset(min_duration=1, accelerations="recorded", **settings).load()
        counted = []
        for one in read.dropped:
            if one.unit != "columns" and one.reason != "no vehicle ahead":
                counted.append(one.reason)
        absent = any(case.name in _ABSENT for case in cases)
        said_so = bool(absent or counted or heard.said)
        wrong = differs(read, meant, lengths, layout, counted=said_so)
        heard.said += counted if wrong else []
    except CfxError as error:
        said = str(error)
    except Exception as error:  # a crash is no answer
        wrong = f"crash: {in_words(error)}"
    finally:
        logging.getLogger("cfx").removeHandler(heard)
    return Outcome(number, name, cases, said, wrong, "; ".join(heard.said))


def _fits(case: Case, layout: Layout) -> bool:
    """Says whether a layout has what a corruption changes."""
    if case.signals is None or not layout.gaps:
        return True
    return "acceleration" not in case.name and "position" not in case.name


def _compatible(cases: Sequence[Case], count: int) -> tuple[Case, ...]:
    """Returns the first corruptions that do not undo one another."""
    taken: list[Case] = []
    fields: set[str] = set()
    for case in cases:
        mine = _touched(case)
        if len(taken) < count and not mine & fields:
            taken.append(case)
            fields |= mine
    return tuple(sorted(taken, key=CASES.index))


_ROWS = {"ids again", "a leader not recorded", "frames from 5000 on"}
_TIME = {"times that tremble by 1.5 ms", "dates in place of times", "times since 1970"}
_BYTES = {
    "a row of units below the header",
    "the header again below",
    "a remark above the header",
    "a row of means at the end",
    "UTF-16",
    "Latin-1",
    "cut off in a row",
    "a column twice",
}


def _touched(case: Case) -> set[str]:
    """Returns what a corruption changes, so that no two change the same."""
    name, touched = case.name, {"number", "separator", "cells", "time"}
    if case.signals is not None:
        touched = {"signals"}
    elif name in {"gzip", "zip", "zstd", "xz"}:
        touched = {"packed"}
    elif "rows" in name or name in _ROWS:
        touched = {"rows"}
    elif name == "leaders of two followers swapped":
        touched = {"leaders", "rows"}
    elif name == "lengths in feet":
        touched = {"signals", "lengths"}
    elif name in _TIME:
        touched = {"time", "number"}
    elif name in {"order of columns", "columns of no use"}:
        touched = {name, "bytes"}
    elif name in _BYTES or "byte-order" in name:
        touched = {"bytes", "separator", "cells"}
    elif "cell" in name and "around" not in name:
        touched = {"cells", "rows", "number"}
    return touched


def _rewritten(
    name: str,
    folder: Path,
    settings: dict[str, Any],
    cases: Sequence[Case],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Changes how the files of a layout are written; returns the settings that read them."""
    if name == "SUMO":
        settings["path"] = _fcd_table(Path(settings["path"]))
    pattern = Path(settings["path"])
    paths = sorted(folder.glob(pattern.name)) if "*" in pattern.name else [pattern]
    written = []
    for path in paths:
        file = File.of(path, rng)
        for case in cases:
            if case.file is not None:
                case.file(file)
        file.written()
        written.append(file.path)
    return settings | {"path": written if len(written) > 1 else written[0]}


def _fcd_table(path: Path) -> Path:
    """Writes SUMO's XML as the table that SUMO writes."""
    from xml.etree import ElementTree

    rows = []
    for step in ElementTree.parse(path).getroot():  # noqa: S314 - a file of ours
        for vehicle in step:
            row: dict[str, Any] = {"timestep_time": float(step.attrib["time"])}
            for key, value in vehicle.attrib.items():
                row[f"vehicle_{key}"] = value
            rows.append(row)
    table = pd.DataFrame(rows)
    for key in ("speed", "pos", "acceleration"):
        table[f"vehicle_{key}"] = table[f"vehicle_{key}"].astype(float)
    target = path.with_suffix(".csv")
    table.to_csv(target, index=False)
    path.unlink()
    return target


def differs(
    read: PairSet,
    meant: Sequence[Mapping[str, np.ndarray]],
    lengths: Sequence[float],
    layout: Layout,
    *,
    counted: bool,
) -> str:
    """Returns how pairs that were read differ from those that a file means; "" if they do not.

    Args:
        counted: what is left out was counted or warned of, so that pairs may be missing.
    """
    taken = [0] * len(meant)
    for pair in read:
        at = _place(pair, meant, layout)
        if at is None:
            return f"pair {pair.pair_id} has other speeds"
        number, start = at
        signals = {
            name: values[start : start + len(pair)] for name, values in meant[number].items()
        }
        taken[number] += len(pair)
        if "gap" in signals:
            gap = signals["gap"]
        else:
            gap = signals["leader_position"] - signals["follower_position"]
            length = 5.0 if layout.dataset == "sumo_fcd" else lengths[number]
            gap = gap - length
        expected = {"gap": gap * layout.foot}
        for who in BOTH:
            for what in ("speed", "acceleration"):
                if f"{who}_{what}" in signals:
                    expected[f"{who}_{what}"] = signals[f"{who}_{what}"] * layout.foot
        for name, values in expected.items():
            away = np.abs(getattr(pair, name) - values).max()
            room = TOLERANCE if layout.dataset != "sumo_fcd" or name != "gap" else 2 * TOLERANCE
            if away > room:
                return f"pair {pair.pair_id}: {name} is off by {away:.3g}"
        step = float(meant[number]["time"][1] - meant[number]["time"][0])
        if abs(pair.dt / step - 1) > 1e-3:
            return f"pair {pair.pair_id}: the step is {pair.dt:g} s, not {step:g} s"
    if not counted and taken != [len(signals["time"]) for signals in meant]:
        return f"frames are missing and not counted: {taken}"
    return ""


def _place(
    pair: Pair, meant: Sequence[Mapping[str, np.ndarray]], layout: Layout
) -> tuple[int, int] | None:
    """Returns which pair one is a stretch of, and from which frame on, by both speeds."""
    for number, signals in enumerate(meant):
        leader = signals["leader_speed"] * layout.foot
        follower = signals["follower_speed"] * layout.foot
        for start in range(len(leader) - len(pair) + 1):
            if abs(follower[start] - pair.follower_speed[0]) > TOLERANCE:
                continue
            run = slice(start, start + len(pair))
            near = np.abs(follower[run] - pair.follower_speed).max() < TOLERANCE
            if near and np.abs(leader[run] - pair.leader_speed).max() < TOLERANCE:
                return number, start
    return None


# --- all of them ----------------------------------------------------------------------------------


def recordings_of(data: Path | None) -> list[list[Pair]]:
    """Returns real pairs where there are some, and made-up ones."""
    true = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8], [1.5, 0.2]], dtype=torch.float64)
    recordings = [list(wavy_pairs(Krauss(), true, frames=400).pairs)]
    if data is not None:
        for name in ("I-80", "ZalaZone"):
            cut = []
            for pair in chosen(data, name)[:4]:
                signals = {key: getattr(pair, key)[:400] for key in _SIGNALS}
                cut.append(replace(pair, **signals))
            recordings.append(cut)
    return recordings


_SIGNALS = [f"{who}_{what}" for who in BOTH for what in ("position", "speed", "acceleration")]


def outcomes(numbers: Sequence[int], data: Path | None) -> Iterator[Outcome]:
    recordings = recordings_of(data)
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder:
            yield drawn(number, recordings, Path(folder))


def rows_of(found: Sequence[Outcome]) -> list[list[str]]:
    """Returns a row for each corruption: files, answers, precision and recall of its reason."""
    rows = []
    for case in CASES:
        mine = [one for one in found if case in one.cases]
        counts = [sum(one.answer == answer for one in mine) for answer in ANSWERS]
        precision = recall = "-"
        alone = [one for one in mine if len(one.cases) == 1]
        if case.reason:
            named = [one for one in found if one.said and re.search(case.reason, one.said)]
            right = [one for one in named if not one.is_harmless]
            precision = f"{len(right)} of {len(named)}"
            caught = [one for one in alone if one.answer == "right"]
            recall = f"{len(caught)} of {len(alone)}"
        meant = (case.reason and "refused") or (case.may and "equal or refused") or "equal"
        rows.append([case.name, meant, str(len(mine)), *map(str, counts), precision, recall])
    return rows


HEADINGS = ("corruption", "right answer", "files", *ANSWERS, "precision", "recall alone")


def table_of(found: Sequence[Outcome]) -> str:
    lines = ["| " + " | ".join(HEADINGS) + " |", "| --- | --- |" + " ---: |" * (len(HEADINGS) - 2)]
    for row in rows_of(found):
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first file")
    parser.add_argument("--data", type=Path, default=None)
    arguments = parser.parse_args()
    logging.getLogger("cfx").propagate = False
    data = arguments.data if arguments.data is not None and arguments.data.is_dir() else None
    numbers = range(arguments.first, arguments.first + arguments.files)
    found = list(outcomes(numbers, data))
    print(table_of(found))
    for answer in ANSWERS:
        print(f"{answer}: {sum(one.answer == answer for one in found)} of {len(found)}")
    for one in found:
        if one.answer != "right":
            names = ", ".join(case.name for case in one.cases)
            print(
                f"{one.answer}: file {one.number}, {one.layout}: {names}: {one.wrong} {one.said}"
                f" {one.warned[:200]}"
            )


if __name__ == "__main__":
    main()
