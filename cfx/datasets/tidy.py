"""The tidy pair layout: the door through which any dataset enters.

One row per pair and frame, SI units, a constant time step within a pair, no gaps:

| column | unit | meaning |
| --- | --- | --- |
| `recording`, `pair_id` | | names; a pair id is unique in the file |
| `leader_id`, `follower_id`, `frame` | | as in the source; frames are consecutive |
| `time_s` | s | |
| `leader_position_m`, `follower_position_m` | m | front bumper, along the lane |
| `leader_speed_mps`, `follower_speed_mps` | m/s | |
| `leader_acceleration_mps2`, `follower_acceleration_mps2` | m/s2 | |
| `leader_length_m` | m | net gap = leader position - leader length - follower position |
| `lane` | | optional, one value for each pair |
| `true_model`, `true_NAME` | | optional: a synthetic driver's model and its parameters over time |
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cfx.component import Settings
from cfx.datasets.base import Dataset, FileDatasetSettings, joined, listed
from cfx.datasets.files import (
    PARQUET,
    Floats,
    Ints,
    Labels,
    as_labels,
    bad_cells,
    magic,
    parsed,
    read_columns,
    sniff,
)
from cfx.errors import DataError, OutputError, nearest
from cfx.files import atomic_write
from cfx.pairs import SIGNALS, Dropped, Pair, PairSet

LABELS = ("recording", "pair_id", "leader_id", "follower_id")
_UNITS = {"position": "m", "speed": "mps", "acceleration": "mps2"}
_SIGNAL_COLUMNS = {name: f"{name}_{_UNITS[name.split('_')[1]]}" for name in SIGNALS}
NUMBERS = ("frame", "time_s", *_SIGNAL_COLUMNS.values(), "leader_length_m")
_LANE, _TRUE, _TRUE_MODEL = "lane", "true_", "true_model"

_FACTORS = {
    1 / 0.3048: "the positions look like feet; multiply them by 0.3048",
    0.3048: "the speeds look like feet per second; multiply them by 0.3048",
    1 / 3.6: "the speeds look like km/h; divide them by 3.6",
    0.44704: "the speeds look like miles per hour; multiply them by 0.44704",
    1000.0: "the positions look like millimetres or the speeds like km/s; write m and m/s",
    100.0: "the positions look like centimetres; divide them by 100",
    0.001: "the times look like milliseconds, or the positions like kilometres; write s and m",
}
"""Distance driven over speed times time, if one of them has another unit than it should."""


class TidyDataset(Dataset):
    """Pairs in the tidy layout (see the module), from parquet or CSV; gzipped CSV is fine. Rows may be in any order.

    Several files are read as one: a recording may go on in another file, a pair may not.

    Columns beyond the layout are ignored and counted. Everything else that does not fit is an error that names row and column.
    """

    schema: ClassVar[type[Settings]] = FileDatasetSettings
    settings: FileDatasetSettings

    def read(self) -> PairSet:
        return joined([read_tidy(path) for path in self.settings.files()])


@dataclass(frozen=True)
class _Table:
    """The columns of a tidy file as it stands, `(N,)` each; `first_row` is the number of its first row in messages."""

    source: str
    labels: Mapping[str, Labels]
    numbers: Mapping[str, Floats]
    first_row: int
    ignored: Sequence[str]

    def __len__(self) -> int:
        return len(self.numbers["frame"])

    def at(self, index: int | np.integer[Any], column: str = "") -> str:
        """Says where a row is: file, row, pair and frame."""
        pair = self.labels["pair_id"]
        code = pair.codes[index]
        named = (
            f" (pair '{pair.names[code]}', frame {self.numbers['frame'][index]:g})"
            if code >= 0
            else ""
        )
        return f"{self.source}, row {int(index) + self.first_row}{f', column {column}' if column else ''}{named}"


def read_tidy(path: Path) -> PairSet:
    """Reads a tidy file.

    Raises:
        DataError: the file cannot be read or does not keep to the layout.
    """
    table = _read_parquet(path) if magic(path) == PARQUET else _read_text(path)
    return _pairs(table)


def pairs_from_frame(frame: pd.DataFrame, source: str = "table") -> PairSet:
    """Takes pairs from a table in the tidy layout.

    Args:
        source: what messages call the table; its rows are counted from 1.

    Raises:
        DataError: the table does not keep to the layout.
    """
    names = [str(name) for name in frame.columns]
    numbers, labels, ignored = _roles(source, names)
    wanted = [*numbers, *labels]
    try:
        columns = pa.Table.from_pandas(frame.set_axis(names, axis=1)[wanted], preserve_index=False)
    except pa.ArrowException as error:
        raise DataError(
            f"{source}: a column mixes numbers and text ({_first_line(error)}); give each column one type"
        ) from None
    return _pairs(_from_arrow(source, columns, ignored))


def _pairs(table: _Table) -> PairSet:
    if not len(table):
        raise DataError(f"{table.source}: has the right columns but no rows")
    _check_cells(table)
    order, starts = _check_frames(table)
    _check_pairs(table, order, starts)
    _check_motion(table, order, starts)
    dropped = (
        (
            Dropped(
                f"not part of the layout: {listed(table.ignored)}", len(table.ignored), "columns"
            ),
        )
        if table.ignored
        else ()
    )
    return PairSet(tuple(_build(table, order, starts)), table.source, dropped)


# --- reading ---------------------------------------------------------------------------------------------------------


def _roles(source: str, names: Sequence[str]) -> tuple[dict[str, int], dict[str, int], list[str]]:
    """Returns the positions of number columns and of label columns, and the names of the columns that are neither.

    Raises:
        DataError: a column is missing or stands twice.
    """
    twice = sorted({name for name in names if list(names).count(name) > 1})
    if twice:
        raise DataError(
            f"{source}: column {twice[0]} stands in the file more than once; remove one of them"
        )
    missing = [name for name in (*LABELS, *NUMBERS) if name not in names]
    if missing:
        spare = [name for name in names if name not in (*LABELS, *NUMBERS)]
        ngsim = (
            " This looks like an NGSIM file: use data=ngsim."
            if {n.lower() for n in names} & {"vehicle_id", "local_y"}
            else ""
        )
        others = f" So are {listed(missing[1:], 5)}." if len(missing) > 1 else ""
        raise DataError(
            f"{source}: column {missing[0]} is missing.{nearest(missing[0], spare)}{others}{ngsim}"
            f" Columns found: {listed(names, 20)}."
        )
    at = {name: index for index, name in enumerate(names)}
    truth = [name for name in names if name.startswith(_TRUE) and name != _TRUE_MODEL]
    optional = [_LANE] if _LANE in at else []
    numbers = {name: at[name] for name in (*NUMBERS, *optional, *truth)}
    labels = {name: at[name] for name in (*LABELS, *([_TRUE_MODEL] if _TRUE_MODEL in at else []))}
    return numbers, labels, [name for name in names if name not in numbers and name not in labels]


def _read_text(path: Path) -> _Table:
    table = sniff(path)
    if table.header is None:
        raise DataError(
            f"{path}: the first row must hold the column names of the tidy layout: {listed((*LABELS, *NUMBERS), 20)}"
        )
    if table.delimiter == " " and table.width > 1:
        raise DataError(f"{path}: the columns are separated by spaces; write the file with commas")
    numbers, labels, ignored = _roles(str(path), table.header)
    values, names = read_columns(table, numbers, labels)
    return _Table(str(path), names, values, 2, ignored)


def _read_parquet(path: Path) -> _Table:
    try:
        file = pq.ParquetFile(path)
        numbers, labels, _ = _roles(str(path), file.schema_arrow.names)
        ignored = [
            name for name in file.schema_arrow.names if name not in numbers and name not in labels
        ]
        columns = file.read(columns=[*numbers, *labels])
    except (pa.ArrowException, OSError) as error:
        raise DataError(
            f"{path}: the parquet file is cut off or damaged ({_first_line(error)}); write it again"
        ) from None
    return _from_arrow(str(path), columns, ignored)


def _from_arrow(source: str, columns: Any, ignored: Sequence[str]) -> _Table:
    numbers, labels, _ = _roles(source, columns.schema.names)
    return _Table(
        source,
        {name: as_labels(_text(columns.column(name))) for name in labels},
        {name: _floats(source, name, columns.column(name)) for name in numbers},
        1,
        [
            name for name in ignored if name != "__index_level_0__"
        ],  # pandas' own row index, not the user's column
    )


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def _text(column: Any) -> Any:
    """Returns a column of ids as text; 11.0, as pandas writes integers beside a missing one, reads 11."""
    if pa.types.is_floating(column.type):
        with contextlib.suppress(pa.ArrowInvalid):
            return column.cast(pa.int64()).cast(pa.string())
    return column


def _floats(source: str, name: str, column: Any) -> Floats:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return parsed(
            column,
            lambda at, cell: (
                f"{source}, row {at + 1}, column {name}: '{cell}' is not a number; correct it"
            ),
        )
    try:
        return cast(Floats, column.cast(pa.float64()).to_numpy())
    except (pa.ArrowException, ValueError):
        raise DataError(
            f"{source}, column {name}: holds {column.type}, not numbers; write it as numbers"
        ) from None


# --- checks ----------------------------------------------------------------------------------------------------------


def _check_cells(table: _Table) -> None:
    """Raises DataError for an empty name, and for a cell that is no finite number or one that cannot be."""
    for name in LABELS:
        empty = np.flatnonzero(table.labels[name].codes < 0)
        if len(empty):
            raise DataError(
                f"{table.at(empty[0], name)}: the cell is empty ({len(empty)} such cells); give a name"
            )
    for name in NUMBERS:
        if bad := bad_cells(table.numbers[name]):
            index, count, what = bad
            raise DataError(
                f"{table.at(index, name)}: is {what} ({count} such cells in this column); correct it or leave out the pair"
            )
    frame = table.numbers["frame"]
    _reject(
        table,
        "frame",
        frame != np.floor(frame),
        "is no whole number; number the frames 0, 1, 2, ...",
    )
    for name in ("leader_speed_mps", "follower_speed_mps"):
        _reject(
            table,
            name,
            table.numbers[name] < 0,
            "is negative; speeds count along the lane and must be 0 or more",
        )
    _reject(
        table,
        "leader_length_m",
        table.numbers["leader_length_m"] <= 0,
        "is no vehicle length; give metres",
    )


def _reject(table: _Table, name: str, wrong: NDArray[np.bool_], why: str) -> None:
    at = np.flatnonzero(wrong)
    if len(at):
        count = f" ({len(at)} such cells)" if len(at) > 1 else ""
        raise DataError(f"{table.at(at[0], name)}: {table.numbers[name][at[0]]:g} {why}{count}")


def _check_frames(table: _Table) -> tuple[Ints, Ints]:
    """Checks that frames are consecutive and the time step is constant.

    Returns:
        The order `(N,)` that sorts the rows by pair (as they first appear) and frame, and where in it each pair begins.
    """
    frame, pair = table.numbers["frame"], table.labels["pair_id"].codes
    order = np.lexsort((frame, pair))
    new = np.append(True, np.diff(pair[order]) != 0)
    starts = np.flatnonzero(new)
    step = np.diff(frame[order])
    within = ~new[1:]
    if len(twice := np.flatnonzero(within & (step == 0))):
        a, b = sorted((order[twice[0]], order[twice[0] + 1]))
        raise DataError(
            f"{table.at(b)}: the same pair and frame as row {int(a) + table.first_row} ({len(twice)} such rows); keep one of them"
        )
    if len(jump := np.flatnonzero(within & (step != 1))):
        last = frame[order[jump[0]]]
        raise DataError(
            f"{table.at(order[jump[0] + 1])}: the frame before is {last:g}, so frames are missing ({len(jump)} such gaps in all);"
            " cut the pair in two there, with two pair ids, or fill the gap"
        )
    sizes = np.diff(np.append(starts, len(order)))
    if len(short := np.flatnonzero(sizes < 2)):
        raise DataError(
            f"{table.at(order[starts[short[0]]])}: the pair has a single frame ({len(short)} such pairs); leave it out"
        )
    _check_time(table, order, starts, within)
    return order, starts


def _check_time(table: _Table, order: Ints, starts: Ints, within: NDArray[np.bool_]) -> None:
    time = table.numbers["time_s"][order]
    steps = np.diff(time)
    per_row = np.repeat(_time_steps(time, starts), np.diff(np.append(starts, len(order))))[1:]
    if len(back := np.flatnonzero(within & (steps <= 0))):
        raise DataError(
            f"{table.at(order[back[0] + 1], 'time_s')}: time does not advance from the frame before; it must, by a constant step"
        )
    if len(odd := np.flatnonzero(within & (np.abs(steps - per_row) > 0.05 * per_row))):
        raise DataError(
            f"{table.at(order[odd[0] + 1], 'time_s')}: the time step is {steps[odd[0]]:.6g} s here and {per_row[odd[0]]:.6g} s on"
            f" average ({len(odd)} such steps); it must be constant within a pair: resample the pair, or split it"
        )


def _time_steps(time: Floats, starts: Ints) -> Floats:
    """Returns the mean time step of each pair, s."""
    ends = np.append(starts[1:], len(time)) - 1
    mean: Floats = (time[ends] - time[starts]) / (ends - starts)
    return mean


def _check_pairs(table: _Table, order: Ints, starts: Ints) -> None:
    """Raises DataError if what describes a pair as a whole changes within it."""
    first = np.repeat(order[starts], np.diff(np.append(starts, len(order))))
    described: dict[str, NDArray[Any]] = {
        name: labels.codes for name, labels in table.labels.items() if name != "pair_id"
    }
    described |= {
        name: table.numbers[name] for name in ("leader_length_m", _LANE) if name in table.numbers
    }
    for name, values in described.items():
        differs = values[order] != values[first]
        if values.dtype.kind == "f":
            differs &= ~(np.isnan(values[order]) & np.isnan(values[first]))
        if len(at := np.flatnonzero(differs)):
            raise DataError(
                f"{table.at(order[at[0]], name)}: differs from the pair's first row; a pair is one follower behind one leader in"
                " one recording and lane: give each stretch its own pair id"
            )
    for name in _truth_names(table):
        unknown = np.isnan(table.numbers[name])
        if len(at := np.flatnonzero(unknown[order] != unknown[first])):
            raise DataError(
                f"{table.at(order[at[0]], name)}: the true parameter is known in a part of the pair only; give it in every row"
            )
    if _LANE in table.numbers:
        lane = table.numbers[_LANE]
        _reject(table, _LANE, ~np.isnan(lane) & (lane != np.floor(lane)), "is no lane number")


def _check_motion(table: _Table, order: Ints, starts: Ints) -> None:
    """Raises DataError if positions and speeds do not belong together, or a leader is not ahead of its follower."""
    within = np.ones(len(order), dtype=bool)
    within[starts] = False
    time = table.numbers["time_s"][order]
    for who in ("leader", "follower"):
        position, speed = (
            table.numbers[f"{who}_position_m"][order],
            table.numbers[f"{who}_speed_mps"][order],
        )
        driven = float(np.diff(position)[within[1:]].sum())
        expected = float((0.5 * (speed[1:] + speed[:-1]) * np.diff(time))[within[1:]].sum())
        if expected < 10 and abs(driven) < 10:  # too little movement to tell
            continue
        ratio = driven / expected if expected > 0 else np.inf
        if 0.8 < ratio < 1.25:
            continue
        guess = next(
            (text for factor, text in _FACTORS.items() if abs(ratio / factor - 1) < 0.05), ""
        )
        if not guess:
            guess = (
                "positions must grow along the lane"
                if ratio < 0
                else "positions must be in m, speeds in m/s and times in s"
            )
        raise DataError(
            f"{table.source}, columns {who}_position_m and {who}_speed_mps: the distance driven is {ratio:.3g} times speed times"
            f" time: {guess}"
        )
    gap = (
        table.numbers["leader_position_m"]
        - table.numbers["leader_length_m"]
        - table.numbers["follower_position_m"]
    )
    if len(at := np.flatnonzero(~(gap > 0))):
        raise DataError(
            f"{table.at(at[0])}: the leader is behind its follower, or overlaps it: the gap is {gap[at[0]]:.2f} m ({len(at)} such"
            " rows); cut the pair there, or correct positions and leader_length_m"
        )


# --- building --------------------------------------------------------------------------------------------------------


def _truth_names(table: _Table) -> list[str]:
    return [name for name in table.numbers if name.startswith(_TRUE)]


def _build(table: _Table, order: Ints, starts: Ints) -> list[Pair]:
    numbers = {name: values[order] for name, values in table.numbers.items()}
    steps = _time_steps(numbers["time_s"], starts)
    ends = np.append(starts[1:], len(order))
    pairs = []
    for start, end, step in zip(starts.tolist(), ends.tolist(), steps.tolist(), strict=True):
        label = {
            name: labels.names[code] if (code := labels.codes[order[start]]) >= 0 else ""
            for name, labels in table.labels.items()
        }
        truth = {
            name.removeprefix(_TRUE): numbers[name][start:end]
            for name in _truth_names(table)
            if not np.isnan(numbers[name][start])
        }
        lane = numbers[_LANE][start] if _LANE in numbers else np.nan
        signals: dict[str, Any] = {
            signal: numbers[column][start:end] for signal, column in _SIGNAL_COLUMNS.items()
        }
        pairs.append(
            Pair(
                pair_id=label["pair_id"],
                recording=label["recording"],
                leader_id=label["leader_id"],
                follower_id=label["follower_id"],
                first_frame=int(numbers["frame"][start]),
                dt=_simplest(step),
                leader_length=float(numbers["leader_length_m"][start]),
                **signals,
                lane=None if np.isnan(lane) else int(lane),
                truth=truth,
                truth_model=label.get(_TRUE_MODEL, ""),
            )
        )
    return pairs


def _simplest(step: float) -> float:
    """Returns the time step that a mean of rounded times stands for: 0.1 for 0.09999999998, 1/30 for 0.0333333."""
    for largest in (100, 10_000):
        simple = Fraction(step).limit_denominator(largest)
        if simple > 0 and abs(float(simple) - step) < 1e-6 * step:
            return float(simple)
    return step


# --- writing ---------------------------------------------------------------------------------------------------------


def write_tidy(pairs: PairSet, path: Path | str) -> None:
    """Writes pairs in the tidy layout; reading the file gives the same pairs to the last bit, truth included.

    The file appears whole or not at all. `time_s` is frame times time step.

    Args:
        path: ends in .parquet, .csv or .csv.gz.

    Raises:
        OutputError: the name ends otherwise, or the file cannot be written.
    """
    path = Path(path).expanduser()
    if not path.name.lower().endswith((".parquet", ".csv", ".csv.gz")):
        raise OutputError(f"{path}: a tidy file is named .parquet, .csv or .csv.gz")
    table = _as_table(pairs)
    try:
        with atomic_write(path) as temporary:
            _write(table, temporary, path.name.lower())
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); choose another folder or free some space"
        ) from None


def _write(table: Any, temporary: Path, name: str) -> None:
    if name.endswith(".parquet"):
        pq.write_table(table, temporary, compression="zstd")
        return
    with pa.output_stream(
        str(temporary), compression="gzip" if name.endswith(".gz") else None
    ) as stream:
        pa.csv.write_csv(table, stream)


def _as_table(pairs: PairSet) -> Any:
    sizes = [len(pair) for pair in pairs]

    def per_pair(values: Sequence[Any], kind: Any) -> Any:
        return pa.array(values, kind).take(pa.array(np.repeat(np.arange(len(sizes)), sizes)))

    def over_time(arrays: Sequence[Floats]) -> Any:
        return pa.array(np.concatenate(arrays) if arrays else np.zeros(0), pa.float64())

    frames = [pair.first_frame + np.arange(len(pair)) for pair in pairs]
    columns: dict[str, Any] = {
        name: per_pair([getattr(pair, name) for pair in pairs], pa.string()) for name in LABELS
    }
    columns["frame"] = pa.array(
        np.concatenate(frames) if frames else np.zeros(0, np.int64), pa.int64()
    )
    columns["time_s"] = over_time(
        [np.asarray(frame * pair.dt, np.float64) for frame, pair in zip(frames, pairs, strict=True)]
    )
    columns |= {
        column: over_time([getattr(pair, signal) for pair in pairs])
        for signal, column in _SIGNAL_COLUMNS.items()
    }
    columns["leader_length_m"] = per_pair([pair.leader_length for pair in pairs], pa.float64())
    if any(pair.lane is not None for pair in pairs):
        columns[_LANE] = per_pair([pair.lane for pair in pairs], pa.int64())
    if any(pair.truth_model for pair in pairs):
        columns[_TRUE_MODEL] = per_pair([pair.truth_model for pair in pairs], pa.string())
    for name in dict.fromkeys(name for pair in pairs for name in pair.truth):
        columns[_TRUE + name] = over_time(
            [pair.truth.get(name, np.full(len(pair), np.nan)) for pair in pairs]
        )
    return pa.table(columns)
