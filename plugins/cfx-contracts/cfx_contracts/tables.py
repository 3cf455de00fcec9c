"""The contract of a table of results, statement by statement."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from cfx.results.table import Column, ResultTable
from cfx_contracts import contract_of

_EXAMPLES = {
    "text": ["NA", "007"],
    "float": [1.5, np.nan],
    "int": [0, 3],
    "bool": [True, False],
}


def it_says_what_a_row_is(table: ResultTable) -> None:
    assert table.meaning.strip(), "`meaning` says what a row is: documentation lists it"
    assert table.suffix in {".parquet", ".csv"}, "`suffix` is .parquet or .csv"


def every_column_is_described(table: ResultTable) -> None:
    assert table.columns, "`columns` says which columns a table has"
    names = [column.name for column in table.columns]
    assert len(names) == len(set(names)), "each column has a name of its own"
    for column in table.columns:
        assert isinstance(column, Column), f"`columns` are of the class Column, not {column!r}"
        assert column.meaning.strip(), f"`{column.name}` has no `meaning`"
        assert column.dtype in _EXAMPLES, f"`{column.name}`: dtype is one of {', '.join(_EXAMPLES)}"
        assert column.unit or column.dtype == "text", (
            f"`{column.name}` holds numbers and has no `unit`; write 1 for one without"
        )


def what_is_written_is_read_back(table: ResultTable) -> None:
    rows = pd.DataFrame({column.name: _EXAMPLES[column.dtype] for column in table.columns})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"table{table.suffix}"
        table.write(path, [rows])
        read = table.read(path)
    for column in table.columns:
        kind = object if column.dtype == "text" else np.float64
        expected = rows[column.name].to_numpy(kind)
        np.testing.assert_array_equal(
            read[column.name].to_numpy(kind),
            expected,
            f"`{column.name}` was changed",
        )


CONTRACT = contract_of(__name__, "table")
