"""Reads the files of a job's folder; one sentence says what is damaged."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from cfx.core.errors import DataError
from cfx.core.job_folder import parse_json, parse_yaml
from cfx.core.memory import in_units, total_memory

T = TypeVar("T")

_CELL_BYTES = 8
"""At the least."""

TEXT_COLUMNS = frozenset(
    {
        "pair_id",
        "recording",
        "leader_id",
        "road",
        "follower_id",
        "driver",
        "method",
        "network",
        "base",
        "amount",
        "scope",
        "metric",
        "parameter",
    }
)
_NAMES = TEXT_COLUMNS | {"cluster", "cluster_name"}
_FOLDERS = re.compile(r"(?<![\w.~:/-])/(?:[^/\s'\",\]]+/)+")
_OF_DATABASE = re.compile(r"(sqlite:///)/(?:[^/\s'\",\]]+/)+")
_PASSWORD = re.compile(r"(://[^/@\s:]*):[^/@\s]+@")


def optional(path: Path, read: Callable[[Path], T]) -> T | None:
    """Returns what a file holds; None if there is no such file."""
    return read(path) if path.exists() else None


def read_metrics(path: Path) -> dict[str, float]:
    """Reads `metrics.json`; NaN where a metric is not defined.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    values = {}
    try:
        for name, value in read_json(path).items():
            values[str(name)] = math.nan if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path} is damaged: a metric is no number ({error})") from error
    return values


def read_pairs(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    """Reads `pairs.csv`.

    Raises:
        DataError: the file cannot be read, or lacks a column or the policy.
    """
    table = read_table(path, columns)
    if not {"policy", "fixed"} & set(table["method"]):
        raise DataError(f"{path} is damaged: it has no row of the method 'policy' or 'fixed'")
    return table


def read_table(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    """Reads a table; all columns but names hold numbers.

    Args:
        path: of a CSV or Parquet file.
        columns: those that it must have.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    table = _load(path)
    for column in columns:
        if column not in table:
            raise DataError(f"{path} is damaged: it has no column '{column}'")
    for column in table.columns.astype(str):
        if column in TEXT_COLUMNS:
            table[column] = table[column].astype(str).astype(object)
        elif column not in _NAMES:
            try:
                table[column] = table[column].astype(float)
            except (TypeError, ValueError, ArithmeticError) as error:
                raise DataError(
                    f"{path} is damaged: column '{column}' holds something else than numbers"
                    f" ({error})"
                ) from error
    return table


def _load(path: Path) -> pd.DataFrame:
    # Most of pyarrow's and pandas' errors are ValueErrors or OSErrors.
    try:
        _check_memory(path)
        if path.suffix == ".parquet":
            return pd.read_parquet(path)
        # An id such as "NA" is an id, and "007" is no number.
        header = pd.read_csv(path, nrows=0)
        empty = {str(column): ["", "nan"] for column in header if column not in _NAMES}
        types: Any = dict.fromkeys(TEXT_COLUMNS, str)
        return pd.read_csv(path, dtype=types, keep_default_na=False, na_values=empty)
    except (OSError, ValueError, ArithmeticError, pa.ArrowException) as error:
        raise _unreadable(path, error) from error


def _check_memory(path: Path) -> None:
    """Checks that a table fits the memory: a short file may mean a long table."""
    needed = float(path.stat().st_size)
    if path.suffix == ".parquet":
        found = pq.read_metadata(path)
        needed = float(found.num_rows) * found.num_columns * _CELL_BYTES
    if needed > total_memory():
        raise DataError(
            f"{path} holds a table of {in_units(needed)}, more than this machine's memory; no job"
            " writes so much"
        )


def read_json(path: Path) -> dict[str, Any]:
    """Reads a mapping.

    Raises:
        DataError: the file cannot be read, or holds something else.
    """
    return _mapping(path, parse_json)


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a mapping; errors as of `read_json`."""
    return _mapping(path, parse_yaml)


def read_yaml_list(path: Path) -> list[Any]:
    """Reads a list; what is none is an empty one. Errors as of `read_json`."""
    content = _parsed(path, parse_yaml)
    return list(content) if isinstance(content, list) else []


def _mapping(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    content = _parsed(path, parse)
    if not isinstance(content, dict):
        raise DataError(f"{path} is damaged: it holds no mapping of names to values")
    return content


def _parsed(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> DataError:
    reason = type(error).__name__
    for line in str(error).splitlines():
        if line.strip():
            reason = line.strip()
            break
    return DataError(f"{path} cannot be read ({reason}); run the job again, or leave it out")


def public(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values without passwords of database addresses, as they may be passed on."""
    return {key: _clean(value) for key, value in values.items()}


def _clean(value: Any) -> Any:
    if isinstance(value, Mapping):
        return public(value)
    if isinstance(value, list):
        return [_clean(part) for part in value]
    if isinstance(value, str):
        return without_password(value)
    return value


def without_folders(text: str) -> str:
    """Returns a text without the folders of absolute paths, which nobody else has."""
    return _OF_DATABASE.sub(r"\1", _FOLDERS.sub("", text))


def without_password(text: str) -> str:
    """Returns a text with three stars for passwords in `postgresql://name:password@host`."""
    return _PASSWORD.sub(r"\1:***@", text)
