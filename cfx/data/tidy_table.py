"""The columns of a tidy file, whatever it is stored as; see `cfx.data.tidy` for the layout."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from cfx.core.errors import DataError, nearest
from cfx.data.base import listed
from cfx.data.files import PARQUET, Floats, Labels, as_labels, magic, parsed, read_columns, sniff
from cfx.data.partitions import recording_of

LABELS = ("recording", "pair_id", "leader_id", "follower_id")
"""Columns of names."""

SIGNAL_COLUMNS = {
    "leader_position": "leader_position_m",
    "leader_speed": "leader_speed_mps",
    "leader_acceleration": "leader_acceleration_mps2",
    "follower_position": "follower_position_m",
    "follower_speed": "follower_speed_mps",
    "follower_acceleration": "follower_acceleration_mps2",
}
"""A pair's signals, and the columns that they are written in."""

LENGTH = "leader_length_m"
NUMBERS = ("frame", "time_s", *SIGNAL_COLUMNS.values(), LENGTH)
"""Columns of numbers that every file has, unless it has a column of gaps."""

GAP = "gap_m"
WITH_GAP = ("frame", "time_s", "leader_speed_mps", "follower_speed_mps")
"""Columns of numbers that a file with gaps has at least; the others follow from them."""

DRIVER_TYPES = ("driver_type", "leader_driver_type")
LANE = "lane"
TRUE = "true_"
"""What the columns of true parameters begin with."""

TRUE_MODEL = "true_model"

_PANDAS_INDEX = "__index_level_0__"
"""A column that pandas adds to parquet files for the rows' index; it is not the user's."""


@dataclass(frozen=True)
class TidyTable:
    """The columns of a tidy file as it stands, `(N,)` each.

    Attributes:
        source: what messages call the file.
        labels: columns of names.
        numbers: columns of numbers.
        first_row: the number of the first row in messages.
        ignored: names of the columns that are not part of the layout.
    """

    source: str
    labels: Mapping[str, Labels]
    numbers: Mapping[str, Floats]
    first_row: int
    ignored: Sequence[str]

    def __len__(self) -> int:
        return len(self.numbers["frame"])

    @property
    def truth_names(self) -> list[str]:
        """Names of the columns of true parameters."""
        return [name for name in self.numbers if name.startswith(TRUE)]

    def at(self, index: int | np.integer[Any], column: str = "") -> str:
        """Says where a row is: file, row, column, pair and frame."""
        text = f"{self.source}, row {int(index) + self.first_row}"
        if column:
            text += f", column {column}"
        pair = self.labels["pair_id"]
        code = pair.codes[index]
        if code >= 0:
            text += f" (pair '{pair.names[code]}', frame {self.numbers['frame'][index]:g})"
        return text


def read_table(path: Path) -> TidyTable:
    """Reads the columns of a file, parquet or text.

    Raises:
        DataError: the file cannot be read, or columns are missing.
    """
    if magic(path) == PARQUET:
        return _read_parquet(path)
    return _read_text(path)


def table_of(frame: pd.DataFrame, source: str) -> TidyTable:
    """Returns the columns of a table.

    Raises:
        DataError: columns are missing, or one mixes numbers and text.
    """
    names = [str(name) for name in frame.columns]
    numbers, labels, ignored = _roles(source, names)
    wanted = [*numbers, *labels]
    try:
        columns = pa.Table.from_pandas(frame.set_axis(names, axis=1)[wanted], preserve_index=False)
    except pa.ArrowException as error:
        raise DataError(
            f"{source}: a column mixes numbers and text ({_first_line(error)});"
            " give each column one type"
        ) from None
    return _from_arrow(source, columns, ignored)


def _roles(source: str, names: Sequence[str]) -> tuple[dict[str, int], dict[str, int], list[str]]:
    """Returns what a file's columns are.

    Returns:
        The positions of columns of numbers, those of columns of names, and the names of the columns
        that are neither.

    Raises:
        DataError: a column is missing or stands twice.
    """
    at: dict[str, int] = {}
    twice = set()
    for index, name in enumerate(names):
        if name in at:
            twice.add(name)
        at[name] = index
    if twice:
        raise DataError(
            f"{source}: column {min(twice)} stands in the file more than once; remove one of them"
        )
    needed = WITH_GAP if GAP in at else NUMBERS
    missing = [name for name in (*LABELS, *needed) if name not in at]
    if missing:
        raise DataError(_missing(source, missing, names))
    numbers: dict[str, int] = {}
    labels: dict[str, int] = {}
    for name in (*NUMBERS, GAP, LANE):
        if name in at:
            numbers[name] = at[name]
    for name in (*LABELS, TRUE_MODEL, *DRIVER_TYPES):
        if name in at:
            labels[name] = at[name]
    ignored = []
    for name in names:
        if name.startswith(TRUE) and name != TRUE_MODEL:
            numbers[name] = at[name]
        elif name not in numbers and name not in labels:
            ignored.append(name)
    return numbers, labels, ignored


def _missing(source: str, missing: Sequence[str], names: Sequence[str]) -> str:
    """Returns what to say of columns that are not there."""
    spare = [name for name in names if name not in (*LABELS, *NUMBERS)]
    text = f"{source}: column {missing[0]} is missing.{nearest(missing[0], spare)}"
    if len(missing) > 1:
        text += f" So are {listed(missing[1:], 5)}."
    if {name.lower() for name in names} & {"vehicle_id", "local_y"}:
        text += " This looks like an NGSIM file: use data=ngsim."
    return f"{text} Columns found: {listed(names, 20)}."


def _read_text(path: Path) -> TidyTable:
    table = sniff(path)
    if table.header is None:
        raise DataError(
            f"{path}: the first row must hold the column names of the tidy layout:"
            f" {listed((*LABELS, *NUMBERS), 20)}"
        )
    if table.delimiter == " " and table.width > 1:
        raise DataError(f"{path}: the columns are separated by spaces; write the file with commas")
    numbers, labels, ignored = _roles(str(path), table.header)
    values, names = read_columns(table, numbers, labels)
    return TidyTable(str(path), names, values, 2, ignored)


def _read_parquet(path: Path) -> TidyTable:
    try:
        file = pq.ParquetFile(path)
        names = file.schema_arrow.names
        recording = None
        if "recording" not in names:
            recording = recording_of(path)
        if recording is not None:
            names = ["recording", *names]
        numbers, labels, ignored = _roles(str(path), names)
        stored = set(file.schema_arrow.names)
        columns = file.read(columns=[name for name in (*numbers, *labels) if name in stored])
        if recording is not None:
            columns = columns.append_column("recording", pa.array([recording] * len(columns)))
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: the parquet file is cut off or damaged ({_first_line(error)}); write it again"
        ) from None
    return _from_arrow(str(path), columns, ignored)


def _from_arrow(source: str, columns: Any, ignored: Sequence[str]) -> TidyTable:
    numbers, labels, _ = _roles(source, columns.schema.names)
    texts = {name: _names(source, name, columns.column(name)) for name in labels}
    values = {name: _floats(source, name, columns.column(name)) for name in numbers}
    others = [name for name in ignored if name != _PANDAS_INDEX]
    return TidyTable(source, texts, values, 1, others)


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    if not lines:
        return type(error).__name__
    return lines[0]


def _names(source: str, name: str, column: Any) -> Labels:
    """Returns a column of names.

    Raises:
        DataError: it holds something else, or bytes that are no UTF-8.
    """
    if pa.types.is_nested(column.type):
        raise DataError(
            f"{source}, column {name}: holds {column.type}, not names; write a text or a number in"
            " each row"
        )
    try:
        column.validate(full=True)
    except pa.ArrowException:
        raise DataError(
            f"{source}{_first_broken(column)}, column {name}: is no text in UTF-8; write the file"
            " again in UTF-8"
        ) from None
    return as_labels(_text(column))


def _first_broken(column: Any) -> str:
    """Returns ", row N" for the first cell that is no UTF-8; "" where no row is known."""
    row = 1
    for chunk in column.chunks:
        if not (pa.types.is_string(chunk.type) or pa.types.is_large_string(chunk.type)):
            return ""
        for cell in chunk.cast(pa.large_binary(), safe=False):
            try:
                (cell.as_py() or b"").decode()
            except UnicodeDecodeError:
                return f", row {row}"
            row += 1
    return ""


def _text(column: Any) -> Any:
    """Returns a column of ids as text; 11.0, as pandas writes it beside a missing one, reads 11."""
    if pa.types.is_floating(column.type):
        with contextlib.suppress(pa.ArrowInvalid):
            return column.cast(pa.int64()).cast(pa.string())
    return column


def _floats(source: str, name: str, column: Any) -> Floats:
    """Returns a column as numbers; raises DataError for one that holds none."""

    def complaint(at: int, cell: str) -> str:
        return f"{source}, row {at + 1}, column {name}: '{cell}' is not a number; correct it"

    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return parsed(column, complaint)
    try:
        return cast(Floats, column.cast(pa.float64()).to_numpy())
    except (pa.ArrowException, ValueError):
        raise DataError(
            f"{source}, column {name}: holds {column.type}, not numbers; write it as numbers"
        ) from None
