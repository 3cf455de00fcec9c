"""Tables of other programs: pandas, polars, pyarrow, xarray, DuckDB and what else holds columns.

narwhals knows data frames of many libraries, Arrow's interface the others. A column becomes an
Arrow column when it is asked for, so that those that nobody reads are not converted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from cfx.data.cells import Unreadable
from cfx.errors import ConfigError, DataError, first_line

_HOW = "give a path, a list of paths, a data frame, or what cfx.read returned"

_ONE_COLUMN = (
    "is one column; give a data frame with a row per pair and frame, and a column for each quantity"
)


class Frame(NamedTuple):
    """A table whose columns become Arrow columns when they are asked for.

    Attributes:
        names: of the columns.
        column: returns the Arrow column at a place.
        advice: what to say where a column is missing; "" if nothing.
    """

    names: list[str]
    column: Callable[[int], Any]
    advice: str = ""


def frame_of_any(source: Any, name: str) -> Frame:
    """Returns a table of any library.

    Raises:
        DataError: it is none.
    """
    try:
        frame = frame_of_source(source)
    except ConfigError as error:
        raise DataError(f"{name}: {error}") from None
    if frame is None:
        raise DataError(f"{name}: a {type(source).__name__} is no data frame; give one")
    return frame


def frame_of_source(source: Any) -> Frame | None:
    """Returns a table, or several as one; None for what is no table.

    Args:
        source: a data frame, a mapping of columns, rows that are mappings, or a list of tables.

    Raises:
        ConfigError: it is a part of a table, or columns that do not make one.
    """
    if isinstance(source, Frame):
        return source
    if source is None or isinstance(source, str | bytes | Path):
        return None
    frame = _as_pandas(source)
    if frame is not None:
        return _of_pandas(frame)
    if isinstance(source, list | tuple):
        return _of_several(source)
    table = _as_arrow(source)
    if table is not None:
        return _of_arrow(table)
    return None


def _as_pandas(source: Any) -> pd.DataFrame | None:
    """Returns what is pandas' own, or becomes it without a detour; None for anything else.

    Raises:
        ConfigError: as `frame_of_source`.
    """
    if isinstance(source, pd.DataFrame):
        return source
    _refuse_parts(source)
    if isinstance(source, Mapping) and not hasattr(source, "to_dataframe"):
        return _of_columns(source)
    if isinstance(source, np.ndarray):
        if source.dtype.names is None:
            raise ConfigError(f"an array has no names of columns; {_HOW}")
        return pd.DataFrame(source)
    if hasattr(source, "to_dataframe") and not hasattr(source, "__arrow_c_stream__"):
        return _of_grid(source)
    return None


def _refuse_parts(source: Any) -> None:
    """Raises ConfigError for a single column."""
    kind = type(source).__name__
    if kind in {"Series", "DataArray", "Index", "Column", "Array"}:
        raise ConfigError(f"a {kind} {_ONE_COLUMN}")
    if isinstance(source, pa.Array | pa.ChunkedArray) and not pa.types.is_struct(source.type):
        raise ConfigError(f"a {kind} {_ONE_COLUMN}")


def _of_columns(columns: Mapping[Any, Any]) -> pd.DataFrame:
    """Returns a mapping from names to columns as a data frame.

    Raises:
        ConfigError: they do not make a table.
    """
    for name, column in columns.items():
        if isinstance(column, pd.DataFrame):
            raise ConfigError(f"'{name}' is a table; give several tables as a list")
    try:
        return pd.DataFrame({str(name): _listed(column) for name, column in columns.items()})
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"a {type(columns).__name__} is no table: {first_line(error)}; give each column as"
            " many values as there are rows"
        ) from None


def _listed(column: Any) -> Any:
    """Returns a column that is a generator, or another library's, as pandas takes it."""
    if isinstance(column, pa.Array | pa.ChunkedArray):
        return column.to_pandas()
    if (
        isinstance(column, Iterable)
        and not isinstance(column, str)
        and not hasattr(column, "__len__")
    ):
        return list(column)
    return column


def _of_grid(source: Any) -> pd.DataFrame:
    """Returns what xarray holds, without the cells of its grid that hold nothing.

    On a grid of pairs and frames, cells beyond the end of a pair are empty, though what describes
    the pair as a whole is known there too.
    """
    frame: pd.DataFrame = source.to_dataframe()
    dimensions = set(getattr(source, "sizes", ()))
    over_time = []
    for name, variable in getattr(source, "data_vars", {}).items():
        if set(variable.dims) == dimensions:
            over_time.append(name)
    return frame.dropna(how="all", subset=over_time or None).reset_index()


def _as_arrow(source: Any) -> Any:
    """Returns the table of a library that has Arrow's interface or that narwhals knows, or None."""
    import narwhals

    if isinstance(source, pa.Array | pa.ChunkedArray):
        return pa.Table.from_struct_array(source)
    if isinstance(source, pa.Table):
        return source
    frame = narwhals.from_native(source, pass_through=True)
    if isinstance(frame, narwhals.LazyFrame):
        frame = frame.collect()
    if isinstance(frame, narwhals.DataFrame):
        return frame.to_arrow()
    if hasattr(source, "__arrow_c_stream__") or hasattr(source, "__arrow_c_array__"):
        return pa.table(source)
    if hasattr(source, "to_table"):  # pyarrow's datasets and scanners
        return source.to_table()
    return None


def _of_several(sources: Iterable[Any]) -> Frame | None:
    """Returns tables below one another, or rows that are mappings; None for anything else.

    Raises:
        ConfigError: some are tables and others are not; or a column has different types.
    """
    sources = list(sources)
    if not sources:
        return None
    if all(map(_is_row, sources)):
        return _of_pandas(pd.DataFrame(sources))
    tables: list[Frame] = []
    others: list[Any] = []
    for source in sources:
        table = frame_of_source(source)
        if table is None:
            others.append(source)
        else:
            tables.append(table)
    if not tables:
        return None
    if others:
        raise ConfigError(
            f"some of the list are tables, and one is a {type(others[0]).__name__}; give tables"
            " alone, or paths alone"
        )
    names: dict[str, None] = {}
    for table in tables:
        names |= dict.fromkeys(table.names)

    def column(at: int) -> Any:
        return _one_column(tables, list(names)[at])

    return Frame(list(names), column, tables[0].advice)


def _is_row(source: object) -> bool:
    """Says whether a source is one row: a mapping whose values are no columns."""
    if not isinstance(source, Mapping):
        return False
    for value in source.values():
        if isinstance(value, Iterable) and not isinstance(value, str):
            return False
    return True


def _one_column(tables: list[Frame], name: str) -> Any:
    """Returns a column of several tables; one that lacks it has empty cells."""
    columns, types = [], []
    for table in tables:
        if name in table.names:
            column = table.column(table.names.index(name))
            types.append(column.type)
        else:
            column = pa.chunked_array([pa.nulls(len(table.column(0)))])
        columns.append(pa.table({name: column}))
    try:
        joined = pa.concat_tables(columns, promote_options="permissive")
    except pa.ArrowException:
        raise ConfigError(
            f"column {name} is {types[0]} in one of the tables and {types[-1]} in another; give it"
            " one type"
        ) from None
    return joined.column(0)


# --- pandas and Arrow -----------------------------------------------------------------------------


def _of_arrow(table: Any) -> Frame:
    """Returns an Arrow table; what pandas has stored of an index are columns like others."""
    return Frame([str(name).strip() for name in table.column_names], table.column)


def _of_pandas(frame: pd.DataFrame) -> Frame:
    """Returns a data frame of pandas; levels of its index that have names are columns too."""
    names, places = [], []
    for at, name in enumerate(frame.columns):
        names.append(_flat(name))
        places.append(frame.iloc[:, at])
    unnamed = 0
    levels: list[Any] = list(frame.index.names)
    for level, name in enumerate(levels):
        if name is None:
            unnamed += 1
        elif _flat(name) not in names:
            names.append(_flat(name))
            places.append(frame.index.get_level_values(level).to_series(index=frame.index))
    advice = ""
    if unnamed and not isinstance(frame.index, pd.RangeIndex):
        advice = (
            " The table's index has no name: if it is one of them, name it"
            " (frame.rename_axis('pair_id'))."
        )

    def column(at: int) -> Any:
        return _column_of_pandas(places[at])

    return Frame(names, column, advice)


def _flat(name: Any) -> str:
    """Returns a column's name; of one with several levels, these joined: ("leader", "id")."""
    if not isinstance(name, tuple):
        return str(name).strip()
    levels = map(str.strip, map(str, name))
    return "_".join(filter(None, levels))  # a level without a name is ""


def _column_of_pandas(series: pd.Series) -> Any:
    """Returns an Arrow column.

    Raises:
        Unreadable: its type is none that a table of numbers and names has.
    """
    if isinstance(series.dtype, pd.SparseDtype):
        series = pd.Series(np.asarray(series))
    if isinstance(series.dtype, pd.DatetimeTZDtype):
        series = series.dt.tz_convert(None)  # in UTC, as all instants are read
    if series.dtype == object and _mixes(series):
        series = series.map(str, na_action="ignore")
    try:
        column = pa.Array.from_pandas(series)
    except (pa.ArrowException, OverflowError, ValueError, TypeError) as error:
        raise Unreadable(
            f"holds {_type_of(series)}, which is neither numbers nor names ({first_line(error)})"
        ) from None
    return column if isinstance(column, pa.ChunkedArray) else pa.chunked_array([column])


def _mixes(series: pd.Series) -> bool:
    """Says whether some cells are text and others numbers: Arrow wants one type, as files have."""
    if not pd.api.types.infer_dtype(series, skipna=True).startswith("mixed"):
        return False
    for kind in {type(cell) for cell in series.dropna()}:
        if not issubclass(kind, str | int | float | np.number):
            return False
    return True


def _type_of(series: pd.Series) -> str:
    if series.dtype == object:
        return f"objects ({pd.api.types.infer_dtype(series, skipna=True)})"
    return str(series.dtype)
