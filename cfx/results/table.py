"""What a table of a job's results is, which are installed, and how they are written and read.

A table is a class of its own: which columns it has, what its rows are made of, which metrics and
which lines of the console summarise it. A distribution brings one by an entry point of the group
`cfx.tables`, whose name becomes that of its file. Jobs write cfx's own tables, those of the plugins
whose components they have, and those that they name into their folder and into MLflow; `cfx.load`,
reports and figures (`Result.tables`) read them back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.files import atomic_write
from cfx.core.job_folder import unreadable
from cfx.core.memory import in_units, total_memory
from cfx.errors import DataError, PluginError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cfx.evaluation.result import Evaluation


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: its heading. In a name such as `speed_METHOD` the capitals stand for something: there
            is a column for each, and none must be there.
        unit: "" for texts, "1" for numbers without a unit.
        meaning: what it says, in a few words.
        dtype: how it is written.
        required: a file without it is damaged.
    """

    name: str
    unit: str
    meaning: str
    dtype: Literal["text", "float", "int", "bool"] = "float"
    required: bool = True

    @property
    def stands_for_several(self) -> bool:
        """Whether there is a column for each of something."""
        return any(part.isupper() and len(part) > 1 for part in self.name.split("_"))


class ResultTable(Component):
    """Base of every table of results.

    Life cycle: a job calls `rows` of each of its tables once, before anything is drawn or
    logged; where it has any, `metrics`, and at its end `console`.

    Attributes:
        meaning: what a row is, in a few words; the list of files in the documentation says it.
        columns: of the table.
        suffix: of its file, `.parquet` or `.csv`.
        order: its place among the tables of a job; smaller numbers come first.
        always: every job leaves it, whatever its protocol; a report says where it is missing.
        tracked: how MLflow keeps it too: as a `file`; as a `table` that its pages show besides; or
            not at all, "".
        always_printed: what it prints is what the job was asked for, such as forecasts; other
            tables print where the user asks for all (`output.verbose`).
        large: a job that writes it keeps it nowhere else: it may be more than fits into memory, and
            figures do not see it.
    """

    kind = "table"
    meaning: ClassVar[str]
    columns: ClassVar[tuple[Column, ...]]
    suffix: ClassVar[Literal[".parquet", ".csv"]] = ".parquet"
    order: ClassVar[int] = 1000
    always: ClassVar[bool] = False
    tracked: ClassVar[Literal["file", "table", ""]] = "file"
    always_printed: ClassVar[bool] = False
    large: ClassVar[bool] = False

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        """Returns the rows of the table, in one part or in several that follow one another.

        A table that the job already has, under its name in `Evaluation.tables`, leaves this as it
        is and is not asked.

        Args:
            evaluation: what the job's protocol has measured.

        Returns:
            Nothing, or None alone, where the job has measured nothing of it.
        """
        return ()

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        """Returns metrics for `metrics.json` and MLflow; NaN where one is not defined."""
        return {}

    def console(
        self, evaluation: Evaluation, metrics: Mapping[str, float]
    ) -> Iterable[RenderableType]:
        """Returns what the job prints about it at its end; it fits 80 columns.

        Args:
            evaluation: what the job's protocol has measured.
            metrics: of the job, under their MLflow names.
        """
        return ()

    def write(self, path: Path, parts: Iterable[pd.DataFrame]) -> None:
        """Writes parts of it, one after the other.

        Raises:
            OSError: the file cannot be written.
        """
        if self.suffix == ".csv":
            pd.concat(list(parts)).to_csv(path, index=False)
            return
        remaining = iter(parts)
        first = pa.Table.from_pandas(next(remaining), preserve_index=False)
        with pq.ParquetWriter(path, first.schema) as writer:
            writer.write_table(first)
            for part in remaining:
                writer.write_table(pa.Table.from_pandas(part, first.schema, preserve_index=False))

    def read(self, path: Path) -> pd.DataFrame:
        """Reads it back: its texts as texts, all other columns as numbers.

        Those are floats but for columns of whole numbers that hold nothing else.

        Raises:
            DataError: the file cannot be read, or holds something else.
        """
        texts, integers = self._columns_of("text"), self._columns_of("int")
        table = _load(path, texts)
        for column in self.columns:
            if column.required and not column.stands_for_several and column.name not in table:
                raise DataError(f"{path} is damaged: it has no column '{column.name}'")
        for name in table.columns.astype(str):
            if name in texts:
                table[name] = table[name].astype(str).astype(object)
                continue
            if name in integers and table[name].dtype == np.int64:
                continue
            try:
                table[name] = table[name].astype(float)
            except (TypeError, ValueError, ArithmeticError) as error:
                raise DataError(
                    f"{path} is damaged: column '{name}' holds something else than numbers"
                    f" ({error})"
                ) from error
        return table

    def _columns_of(self, dtype: str) -> list[str]:
        """Returns the names of the columns of a type."""
        return [column.name for column in self.columns if column.dtype == dtype]


class Tables(Mapping[str, pd.DataFrame]):
    """A job's tables by name; one that is not in memory is made, or read, when it is asked for."""

    def __init__(self, sources: Mapping[str, pd.DataFrame | Callable[[], pd.DataFrame]]) -> None:
        """Takes by name a table, or a function without arguments that returns it."""
        self._sources = dict(sources)

    def __getitem__(self, name: str) -> pd.DataFrame:
        source = self._sources[name]
        if not isinstance(source, pd.DataFrame):
            source = self._sources[name] = source()
        return source

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)

    def __contains__(self, name: object) -> bool:
        return name in self._sources  # the inherited method would read the table


def installed() -> tuple[registry.Installed[ResultTable], ...]:
    """Returns all tables in their order; a broken one of a plugin is left out with a warning."""
    return registry.installed("table")


def file_of(table: registry.Installed[ResultTable]) -> str:
    """Returns the name of a table's file."""
    return table.name + table.component.suffix


def parts_of(
    table: registry.Installed[ResultTable], evaluation: Evaluation
) -> Iterator[pd.DataFrame] | None:
    """Returns the rows of a table, some after the other; None where a job has none.

    Raises:
        PluginError: the rows lack a column that is declared.
    """

    def begin(component: ResultTable) -> Iterator[pd.DataFrame] | None:
        """Makes the first part, so that what a plugin does wrong is known before a file is made."""
        if table.name in evaluation.tables:
            parts = iter([evaluation.tables[table.name]])
        else:
            parts = _without_none(component.rows(evaluation))
        first = next(parts, None)
        if first is None:
            return None
        for column in component.columns:
            if column.required and not column.stands_for_several and column.name not in first:
                raise PluginError(f"it declares the column '{column.name}', its rows have none")
        return chain([first], parts)

    return table.attempt(begin, None)


def _without_none(parts: Iterable[pd.DataFrame | None]) -> Iterator[pd.DataFrame]:
    for part in parts:
        if part is not None:
            yield part


def tables_of(
    evaluation: Evaluation,
    chosen: Sequence[registry.Installed[ResultTable]],
    folder: Path | None = None,
) -> tuple[Tables, dict[str, float]]:
    """Returns the chosen tables of an evaluation, and their metrics.

    Those that an earlier job left in the folder go, if one is given; these are written there.

    Raises:
        OSError: a file cannot be written.
    """
    sources: dict[str, pd.DataFrame | Callable[[], pd.DataFrame]] = {}
    metrics: dict[str, float] = {}
    names = {table.name for table in chosen}  # installing something makes the tables anew
    for table in installed():
        parts = parts_of(table, evaluation) if table.name in names else None
        path = None if folder is None else folder / file_of(table)
        if parts is None:
            if path is not None:
                path.unlink(missing_ok=True)
            continue
        if not table.component.large:
            rows = pd.concat(list(parts))
            sources[table.name] = rows
            parts = iter([rows])
        elif path is None:
            sources[table.name] = partial(_together, table, evaluation)
        else:
            sources[table.name] = partial(table.component.read, path)
        if path is not None:
            with atomic_write(path) as temporary:
                table.component.write(temporary, parts)
    for table in installed():
        if table.name in sources:
            metrics |= _metrics_of(table, evaluation)
    return Tables(sources), metrics


def _metrics_of(
    table: registry.Installed[ResultTable], evaluation: Evaluation
) -> Mapping[str, float]:
    """Returns the metrics of a table; none where a plugin's fails."""
    nothing: Mapping[str, float] = {}
    return table.attempt(lambda component: component.metrics(evaluation), nothing)


def _together(table: registry.Installed[ResultTable], evaluation: Evaluation) -> pd.DataFrame:
    """Returns all rows of a large table."""
    return pd.concat(list(parts_of(table, evaluation) or ()))


def stored_tables(folder: Path) -> Tables:
    """Returns the tables of a finished job's folder, each of which is read when it is asked for.

    Reading one raises a DataError if its file cannot be read, or is not what a job writes.
    """
    sources: dict[str, pd.DataFrame | Callable[[], pd.DataFrame]] = {}
    for table in installed():
        path = folder / file_of(table)
        if path.exists():
            sources[table.name] = partial(table.component.read, path)
    return Tables(sources)


def _load(path: Path, texts: list[str]) -> pd.DataFrame:
    # Most of pyarrow's and pandas' errors are ValueErrors or OSErrors.
    try:
        size = float(path.stat().st_size)
        if path.suffix == ".parquet":  # a short file may mean a long table, of 8 bytes a cell
            metadata = pq.read_metadata(path)
            size = 8.0 * metadata.num_rows * metadata.num_columns
        if size > total_memory():
            raise DataError(
                f"{path} holds a table of {in_units(size)}, more than this machine's memory; no"
                " job writes so much"
            )
        if path.suffix == ".parquet":
            return pd.read_parquet(path)
        # An id such as "NA" is an id, and "007" is no number: only columns of numbers have cells
        # that mean NaN.
        header = pd.read_csv(path, nrows=0)
        numbers = header.columns.astype(str).difference(texts)
        empty = {name: ["", "nan"] for name in numbers}
        types: Any = dict.fromkeys(texts, str)
        return pd.read_csv(path, dtype=types, keep_default_na=False, na_values=empty)
    except (OSError, ValueError, ArithmeticError, pa.ArrowException) as error:
        raise unreadable(path, error) from error
