"""Reads tables and checks them against a layout of declared columns.

A reader is its layout and its meaning. The layout declares each column: its name and unit, other
spellings, what its cells may hold, and what is wrong with a cell that holds something else.
`read_table` finds the columns in a delimited text (gzipped or not) or a parquet file, reads these
alone, and checks every cell. `table_of` does the same for a data frame.

Rows are numbered as an editor shows them: the header is row 1 (blank lines are not counted).
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cfx.data.cells import (
    NameColumn,
    Unreadable,
    Written,
    in_column,
    names_in,
    numbers_or_text,
    parsed,
)
from cfx.data.files import (
    PARQUET,
    Floats,
    Ints,
    cells_of,
    decoded,
    first_bytes,
    first_line_of,
    has_letters,
    open_text,
    parquet_source,
    read_head,
    separator_of,
    unpacking,
    without_mark,
)
from cfx.data.frames import frame_of_any
from cfx.errors import DataError, first_line, listed, nearest

if TYPE_CHECKING:
    from numpy import bool_

_BLOCK = 1 << 22
"""Bytes that are parsed at once."""

_PANDAS_INDEX = "__index_level_0__"
"""A column that pandas adds to parquet files for the rows' index; it is not the user's."""


@dataclass(frozen=True)
class FileColumn:
    """One column of a layout.

    Attributes:
        name: as the layout calls it; a regular expression where `many`.
        unit: of its numbers, as the file has them; "" for names and counts.
        is_name: whether it holds names, not numbers.
        spellings: other names of the column.
        needed: whether every file has it.
        unless: name of a column beside which this one is not needed.
        many: whether it stands for every column that its name matches; each keeps its own name.
        may_be_empty: whether cells may be empty: they are NaN, or code -1.
        whole: whether its numbers are whole.
        least: smallest number that is possible.
        above: every number is greater than this.
        most: largest number that is possible.
        wrong: what is wrong with a number that is not whole or out of bounds, and what to do.
        called: the file's own name of the column, under which alone it is looked for; "": its name.
        factor: what the file's numbers are multiplied by once they are checked.
    """

    name: str
    unit: str = ""
    is_name: bool = False
    spellings: tuple[str, ...] = ()
    needed: bool = True
    unless: str = ""
    many: bool = False
    may_be_empty: bool = False
    whole: bool = False
    least: float = -np.inf
    above: float = -np.inf
    most: float = np.inf
    wrong: str = ""
    called: str = ""
    factor: float = 1.0

    @property
    def title(self) -> str:
        """What messages call the column."""
        return self.called or self.name

    @property
    def written(self) -> tuple[str, ...]:
        """The names under which it is looked for."""
        if self.called:
            return (self.called,)
        return (self.name, *self.spellings)


@dataclass(frozen=True)
class Layout:
    """The columns of a kind of file.

    Attributes:
        name: what messages call it.
        keys: what identifies a row in messages: a word, and the column that it stands for.
        elsewhere: columns of other layouts, as `plain` writes them, and what to say of a file that
            has them in place of its own.
        remedy: what to do about an empty cell.
        headerless: names of the columns of a text without a header, by their number.
        above: lines of a text above its header that are no part of the table.
        spaces: whether white space may separate columns of a text, as commas, semicolons, tabs and
            vertical bars may.
        parquet: whether it may be stored as parquet too.
        plain: turns a column's name into the form in which names are compared.
    """

    name: str
    columns: tuple[FileColumn, ...]
    keys: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    remedy: str = "correct it or remove the row"
    headerless: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    above: int = 0
    spaces: bool = False
    parquet: bool = False
    plain: Callable[[str], str] = str

    def found_in(self, source: str, names: Sequence[str], advice: str = "") -> dict[str, _Found]:
        """Returns the layout's columns among those of a file, by the names that they keep.

        Args:
            advice: what to say besides where a column is missing.

        Raises:
            DataError: a column is missing or stands twice.
        """
        at: dict[str, int] = {}
        plain: dict[str, int] = {}
        for index, name in enumerate(names):
            at.setdefault(name, index)
            plain.setdefault(self.plain(name), index)
        matches: dict[str, _Found] = {}
        taken: set[int] = set()
        missing = []
        for column in self.columns:
            own_matches = self._matches(column, at, plain)
            for match in own_matches:
                if match.at not in taken:
                    matches[match.column.name] = match
            taken.update(match.at for match in own_matches)
            if not own_matches and column.needed and not (column.unless and column.unless in at):
                missing.append(column)
        for match in matches.values():
            name = names[match.at]
            if names.count(name) > 1:
                raise DataError(
                    f"{source}: column {name} stands there more than once; remove one of them"
                )
        if missing:
            raise DataError(self._missing(source, missing, names) + advice)
        return matches

    def _matches(
        self, column: FileColumn, at: Mapping[str, int], plain: Mapping[str, int]
    ) -> list[_Found]:
        """Returns where a column is: once, or as often as its pattern matches."""
        if column.many:
            matches = []
            for name, place in at.items():
                if re.fullmatch(column.name, name):
                    matches.append(_Found(replace(column, name=name), place))
            return matches
        for name in column.written:
            if name in at:
                return [_Found(column, at[name])]
        for name in column.written:
            if self.plain(name) in plain:
                return [_Found(column, plain[self.plain(name)])]
        return []

    def _missing(self, source: str, missing: Sequence[FileColumn], names: Sequence[str]) -> str:
        """Returns what to say of columns that are not there."""
        missing = sorted(missing, key=lambda column: bool(column.unless))
        first = missing[0]
        called = " or ".join(first.written)
        of_layout = {column.title for column in self.columns}
        spare = [name for name in names if name not in of_layout]
        where = source
        if self.above:
            where += f", row {self.above + 1}"
        text = f"{where}: column {called} is missing."
        if len(names) > 1:
            text += nearest(first.title, spare)
        also = []
        spared_by: dict[str, list[str]] = {}
        for column in missing:
            if column.unless:
                spared_by.setdefault(column.unless, []).append(column.title)
            elif column is not first:
                also.append(column.title)
        if also:
            verb = "are"
            if len(also) == 1:
                verb = "is"
            text += f" So {verb} {listed(also, 5)}."
        for other, spared in spared_by.items():
            text += f" {listed(spared, 10)}: missing too, but not needed beside a column {other}."
        hints: dict[str, None] = {}
        for name in names:
            hint = self.elsewhere.get(self.plain(name), "")
            if hint:
                hints[f" {hint}"] = None
        text += "".join(hints)
        return f"{text} Columns found: {listed(names, 30) or 'none'}."


class _Found(NamedTuple):
    """A column of a layout, and its position in a file."""

    column: FileColumn
    at: int


@dataclass(frozen=True)
class Table:
    """The columns of a file or a data frame, every cell of which fits the layout.

    Attributes:
        source: what messages call it.
        numbers: columns of numbers `(N,)`, in the layout's units.
        labels: columns of names `(N,)`.
        first_row: the number of the first row in messages.
        ignored: names of the columns that are not part of the layout.
    """

    source: str
    layout: Layout
    numbers: Mapping[str, Floats]
    labels: Mapping[str, NameColumn]
    first_row: int
    ignored: Sequence[str]

    def __len__(self) -> int:
        for values in self.numbers.values():
            return len(values)
        for labels in self.labels.values():
            return len(labels.codes)
        return 0

    def row(self, index: int | np.integer[Any]) -> int:
        """Returns the number that an editor shows for the row `index` (from 0)."""
        return int(index) + self.first_row

    def at(self, index: int | np.integer[Any], column: str = "") -> str:
        """Says where a row is: the source, the row, the column, and what identifies the row."""
        text = f"{self.source}, row {self.row(index)}"
        if column:
            text += f", column {self.title(column)}"
        identity = []
        for word, key in self.layout.keys.items():
            if key in self.numbers:
                identity.append(f"{word} {self.numbers[key][index]:g}")
            elif self.labels[key].codes[index] >= 0:
                identity.append(f"{word} '{self.labels[key].at(int(index))}'")
        if identity:
            text += f" ({', '.join(identity)})"
        return text

    def title(self, column: str) -> str:
        """Returns what messages call a column."""
        for declared in self.layout.columns:
            if declared.name == column:
                return declared.title
        return column

    def unreadable(self, error: Unreadable) -> DataError:
        """Returns the error of a cell or a column that is not what it should be."""
        where = self.source
        if error.row is not None:
            where += f", row {self.row(error.row)}"
        return DataError(f"{where}, column {self.title(error.column)}: {error.what}")

    def refuse(self, column: str, wrong: NDArray[bool_], why: str) -> None:
        """Raises DataError if any cell of a column of numbers is wrong; names the first.

        Args:
            column: its name.
            wrong: marks the cells `(N,)`.
            why: what is wrong with them, and what to do.
        """
        at = np.flatnonzero(wrong)
        if not len(at):
            return
        text = f"{self.at(at[0], column)}: {self.numbers[column][at[0]]:g} {why}"
        if len(at) > 1:
            text += f" ({len(at)} such cells)"
        raise DataError(text)

    def whole(self, column: str) -> Ints:
        """Returns a column of whole numbers `(N,)`."""
        return self.numbers[column].astype(np.int64)


def read_table(path: Path, layout: Layout, labels: Mapping[str, str] | None = None) -> Table:
    """Reads the columns of a layout from a text or a parquet file, and checks every cell.

    Args:
        labels: a name for each column of names that a parquet file may lack: its cells all hold it.

    Raises:
        DataError: the file cannot be read, a column is missing, or a cell is wrong; the message
            names file, row and column.
    """
    first_bytes(path)
    if read_head(path)[:4] != PARQUET:
        return _read_text(path, layout)
    if not layout.parquet:
        raise DataError(
            f"{path}: is a parquet file; those of {layout.name} are text."
            " Pairs in the tidy layout are read with data=tidy"
        )
    try:
        file = pq.ParquetFile(parquet_source(path))
        stored = file.schema_arrow.names
        more = dict(labels or {})
        for name in stored:
            more.pop(name, None)
        matches = layout.found_in(str(path), [*stored, *more])
        used = [stored[match.at] for match in matches.values() if match.at < len(stored)]
        columns = file.read(columns=used)
        for name, value in more.items():
            columns = columns.append_column(name, pa.array([value] * len(columns)))
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: the parquet file is cut off or damaged ({first_line(error)}); write it again"
        ) from None
    return _checked(_Source(str(path), layout, [*stored, *more], 1), matches, columns)


def table_of(source: Any, layout: Layout, name: str) -> Table:
    """Returns the columns of a layout from somebody's table, every cell checked.

    Args:
        source: a data frame of any library (`cfx.data.frames`).
        name: what messages call it; its rows are counted from 1.

    Raises:
        DataError: as `read_table`; or it is no table.
    """
    frame = frame_of_any(source, name)
    matches = layout.found_in(name, frame.names, frame.advice)
    used = {}
    for match in matches.values():
        try:
            used[frame.names[match.at]] = frame.column(match.at)
        except Unreadable as error:
            raise DataError(f"{name}, column {match.column.title}: {error.what}") from None
    return _checked(_Source(name, layout, frame.names, 1), matches, pa.table(used))


# --- cells ----------------------------------------------------------------------------------------


class _Source(NamedTuple):
    """Where columns come from, and the names of all that are there."""

    name: str
    layout: Layout
    columns: Sequence[str]
    first_row: int


def _checked(source: _Source, matches: Mapping[str, _Found], columns: Any) -> Table:
    """Returns Arrow columns as a table of numbers and names, in the layout's units."""
    ignored = _ignored(source, matches)
    numbers: dict[str, Floats] = {}
    read: dict[str, Floats | Written] = {}
    labels: dict[str, NameColumn] = {}
    table = Table(source.name, source.layout, numbers, labels, source.first_row, ignored)
    for name, match in matches.items():
        cells = columns.column(source.columns[match.at])
        try:
            with in_column(name):
                if match.column.is_name:
                    labels[name] = names_in(cells)
                else:
                    _require_unitless(cells, match.column)
                    # A date has its own unit, so it is none where a setting says another one.
                    unit = match.column.unit if match.column.factor == 1.0 else ""
                    read[name] = numbers_or_text(cells, unit, is_whole=match.column.whole)
        except Unreadable as error:
            raise table.unreadable(error) from None
    try:
        numbers.update(parsed(read))
    except Unreadable as error:
        raise table.unreadable(error) from None
    if not len(table):
        raise DataError(f"{source.name}: has the right columns but no rows")
    for name, names in labels.items():
        if not matches[name].column.may_be_empty:
            _require_names(table, name, names)
    for name, values in numbers.items():
        _require_numbers(table, name, values, matches[name].column)
    for name, match in matches.items():
        if match.column.factor != 1.0:
            numbers[name] = numbers[name] * match.column.factor
    return table


def _require_unitless(cells: Any, column: FileColumn) -> None:
    """Raises Unreadable for dates, times or durations of which a setting says another unit."""
    if column.factor != 1.0 and pa.types.is_temporal(cells.type):
        raise Unreadable(
            f"holds {cells.type}, which has no other unit; leave its unit out of data.units"
        )


def _ignored(source: _Source, matches: Mapping[str, _Found]) -> list[str]:
    """Returns the names of columns that are not part of the layout."""
    used = {match.at for match in matches.values()}
    ignored = []
    for at, name in enumerate(source.columns):
        if at in used or name == _PANDAS_INDEX:
            continue
        if name in {"", "None"}:
            ignored.append(f"column {at + 1} without a name")
        else:
            ignored.append(name)
    return ignored


def _such_cells(count: int) -> str:
    return "1 such cell" if count == 1 else f"{count} such cells"


def _require_names(table: Table, name: str, labels: NameColumn) -> None:
    """Raises DataError for an empty cell of a column of names."""
    empty = np.flatnonzero(labels.codes < 0)
    if len(empty):
        raise DataError(
            f"{table.at(empty[0], name)}: the cell is empty ({_such_cells(len(empty))}); give"
            " a name"
        )


def _require_numbers(table: Table, name: str, values: Floats, column: FileColumn) -> None:
    """Raises DataError for a cell that is no finite number, or not what its column declares."""
    is_bad = ~np.isfinite(values)
    if column.may_be_empty:
        is_bad = np.isinf(values)
    at = np.flatnonzero(is_bad)
    if len(at):
        what = "infinite"
        if np.isnan(values[at[0]]):
            what = "empty or NaN"
        raise DataError(
            f"{table.at(at[0], name)}: the cell is {what} ({_such_cells(len(at))} in this column);"
            f" {table.layout.remedy}"
        )
    wrong = (values < column.least) | (values <= column.above) | (values > column.most)
    if column.whole:
        wrong |= (values != np.floor(values)) & ~np.isnan(values)
    table.refuse(name, wrong, column.wrong)


# --- delimited text -------------------------------------------------------------------------------


class _Text(NamedTuple):
    """A delimited text: its separator, and the names of its columns.

    Attributes:
        delimiter: one character; " " stands for any run of white space.
        names: of the columns.
        skipped: lines above the first row of data.
    """

    path: Path
    delimiter: str
    names: tuple[str, ...]
    skipped: int


def _read_text(path: Path, layout: Layout) -> Table:
    text = _read_header(path, layout)
    matches = layout.found_in(str(path), text.names)
    try:
        columns = _parsed(text, matches, pa.float64())
    except pa.ArrowInvalid:
        # Some cell is no plain number: read these columns as text and look closer.
        columns = _parsed(text, matches, pa.string())
    return _checked(_Source(str(path), layout, text.names, text.skipped + 1), matches, columns)


def _read_header(path: Path, layout: Layout) -> _Text:
    """Reads the header and the separator of a text file."""
    head = read_head(path)
    lines = decoded(path, head).splitlines()
    above = first_line_of(lines) + layout.above
    while above < len(lines) and not lines[above].strip():
        above += 1
    if above >= len(lines):
        raise DataError(f"{path}: the file holds no rows")
    first = without_mark(lines[above])
    has_header = has_letters(first.lower().replace("e+", "").replace("e-", ""))
    delimiter = separator_of(first, spaces=layout.spaces)
    cells = cells_of(first, delimiter)
    if not has_header:
        return _Text(path, delimiter, _names_without_header(path, layout, len(cells)), above)
    if delimiter == " " and len(cells) > 1 and not layout.spaces:
        raise DataError(f"{path}: the columns are separated by spaces; write the file with commas")
    return _Text(path, delimiter, tuple(cells), above + 1)


def _names_without_header(path: Path, layout: Layout, width: int) -> tuple[str, ...]:
    """Returns the names of a headerless text's columns; raises DataError if none are known."""
    if width in layout.headerless:
        return layout.headerless[width]
    if layout.headerless:
        widths = " or ".join([str(columns) for columns in layout.headerless])
        raise DataError(
            f"{path}: its first row has {width} columns; {layout.name}'s files without a header"
            f" have {widths}"
        )
    needed = []
    for column in layout.columns:
        if column.needed and not column.many:
            needed.append(column.title)
    raise DataError(
        f"{path}: the first row must hold the column names of {layout.name}: {listed(needed, 20)}"
    )


def _parsed(text: _Text, matches: Mapping[str, _Found], number_type: Any, spare: int = 0) -> Any:
    """Returns the columns found as one Arrow table.

    Args:
        spare: columns without a name behind the others: 1 where rows end in a comma.

    Raises:
        DataError: a row has another number of columns.
        ArrowInvalid: a cell is not of `number_type`.
    """
    broken: list[Any] = []

    def note(row: Any) -> str:
        broken.append(row)
        return "error"

    parsed_by = text.delimiter
    if text.delimiter == " ":
        parsed_by = "\t"  # `_Tabs` puts them in place of white space
    types = {}
    for match in matches.values():
        types[f"c{match.at}"] = number_type
        if match.column.is_name:
            types[f"c{match.at}"] = pa.dictionary(pa.int32(), pa.string())
    width = len(text.names) + spare
    if spare:
        types[f"c{width - 1}"] = pa.string()
    read_options = pa.csv.ReadOptions(
        # One thread: only then does pyarrow know the number of a broken row.
        use_threads=False,
        block_size=_BLOCK,
        column_names=[f"c{at}" for at in range(width)],
        skip_rows=text.skipped,
    )
    options = {
        "read_options": read_options,
        "parse_options": pa.csv.ParseOptions(delimiter=parsed_by, invalid_row_handler=note),
        "convert_options": pa.csv.ConvertOptions(column_types=types, include_columns=list(types)),
    }
    try:
        with open_text(text.path) as file, unpacking(text.path):
            source: Any = file
            if text.delimiter == " ":
                source = _Tabs(file)
            # Not open_csv: after an error its threads may wait for one another when Python exits.
            table = pa.csv.read_csv(source, **options)
    except pa.ArrowInvalid as error:
        if broken:
            row = broken[0]
            more = row.actual_columns - len(text.names)
            if spare == 0 and more == 1 and str(row.text).rstrip().endswith(parsed_by):
                return _parsed(text, matches, number_type, spare=1)
            raise DataError(
                f"{text.path}, row {row.number}: {row.actual_columns} columns instead of"
                f" {width}; is the file cut off there, or does a cell hold a separator?"
            ) from None
        if number_type == pa.string():
            raise DataError(f"{text.path}: cannot be read as a table ({error})") from None
        raise
    if spare:
        for row, cell in enumerate(table.column(f"c{width - 1}").to_pylist()):
            if cell and cell.strip():
                raise DataError(
                    f"{text.path}, row {row + text.skipped + 1}: '{cell}' stands behind the"
                    f" last of {len(text.names)} columns; does a cell hold a separator?"
                )
    titles = {f"c{match.at}": text.names[match.at] for match in matches.values()}
    return table.select(list(titles)).rename_columns(list(titles.values()))


class _Tabs(io.RawIOBase):
    """A text with tabs in place of the white space that separates its cells."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self._file = file
        self._ready = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._ready:
            lines = b"".join(self._file.readlines(_BLOCK)).splitlines()
            self._ready = b"".join([b"\t".join(line.split()) + b"\n" for line in lines])
        size = min(len(buffer), len(self._ready))
        buffer[:size] = self._ready[:size]
        self._ready = self._ready[size:]
        return size
