"""Columns of numbers of a delimited text, checked."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from pathlib import Path

import numpy as np

from cfx.core.errors import DataError, nearest
from cfx.data.base import listed
from cfx.data.files import Floats, TextTable, bad_cells, read_columns, sniff


def position(table: TextTable, *spellings: str) -> int:
    """Returns where a column is, under the first of its spellings that the header has.

    Raises:
        DataError: the header has none of them.
    """
    header = table.header or ()
    for name in spellings:
        if name in header:
            return header.index(name)
    raise DataError(
        f"{table.path}, row {table.above + 1}: column {' or '.join(spellings)} is missing."
        f"{nearest(spellings[0], header)} Columns found: {listed(header, 30)}"
    )


def read_numbers(
    path: Path, wanted: Iterable[Sequence[str]], *, may_lack: Container[str] = ()
) -> tuple[dict[str, Floats], TextTable]:
    """Reads columns, under the first of each one's spellings.

    Args:
        wanted: the spellings of each column.
        may_lack: columns that may have empty cells.

    Raises:
        DataError: a column is missing, there are no rows, or a cell holds no finite number.
    """
    table = sniff(path)
    numbers, _ = read_columns(
        table, {spellings[0]: position(table, *spellings) for spellings in wanted}, {}
    )
    if not len(next(iter(numbers.values()))):
        raise DataError(f"{path}: has a header but no rows")
    for name, values in numbers.items():
        bad = None if name in may_lack else bad_cells(values)
        if bad is not None:
            row, count, what = bad
            raise DataError(
                f"{path}, row {table.row(row)}, column {name}: the cell is {what} ({count} such"
                " cells in this column); correct it or remove the row"
            )
    return numbers, table


def refuse(table: TextTable, name: str, values: Floats, wrong: np.ndarray, what: str) -> None:
    """Raises DataError if a row is wrong: the first one, its value, and what is wrong with it."""
    at = np.flatnonzero(wrong)
    if len(at):
        raise DataError(
            f"{table.path}, row {table.row(at[0])}, column {name}: {values[at[0]]:g} {what}"
        )
