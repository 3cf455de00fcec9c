"""Reading delimited text, plain or gzipped, column by column, with errors that name the row.

Rows are numbered as an editor shows them: the header is row 1 (blank lines are not counted).
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
from numpy.typing import NDArray

from cfx.core.errors import DataError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\x03\x04"
PARQUET = b"PAR1"
"""First bytes of files."""

_HEAD = 1 << 16
"""Bytes that are looked at before a file is read."""

_BLOCK = 1 << 22
"""Bytes that are read at once."""

_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_UTF8_MARK = b"\xef\xbb\xbf"
_OTHER_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars"}
_ABSENT = ("", "nan", "na", "null", "none", "n/a", "#n/a")
"""Cells that stand for no number, in small letters."""


class Labels(NamedTuple):
    """A column of names: `codes` `(N,)` points into `names`; -1 is an empty cell."""

    codes: Ints
    names: list[str]


class FileStart(NamedTuple):
    """The beginning of a file or folder, from which its layout is known.

    Attributes:
        magic: the first bytes; b"" for a folder.
        lines: the first lines of a text, unpacked; () for anything else.
    """

    path: Path
    magic: bytes
    lines: tuple[str, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """The cells of the first line, where commas separate them."""
        if not self.lines:
            return ()
        return tuple(cell.strip().strip('"') for cell in self.lines[0].split(","))

    def has_columns(self, *names: str) -> bool:
        """Says whether the first line has all these cells."""
        return set(names) <= set(self.columns)


def beginning(path: Path) -> FileStart:
    """Returns the beginning of a file or folder.

    Raises:
        DataError: there is none, it cannot be read, or it is empty.
    """
    if path.is_dir():
        return FileStart(path, b"", ())
    start = magic(path)
    if start.startswith(_ZIP):
        return FileStart(path, start, ())
    with open_text(path) as file:
        head = _guarded(path, lambda: file.read(_HEAD))
    try:
        text = head.decode("utf-8-sig", errors="strict" if len(head) < _HEAD else "ignore")
    except UnicodeDecodeError:
        text = ""
    if "\0" in text:
        text = ""
    return FileStart(path, start, tuple(text.splitlines()[:20]))


@dataclass(frozen=True)
class TextTable:
    """A delimited text file whose first line has been looked at.

    Attributes:
        delimiter: "," or " ", the latter for any run of white space.
        header: the column names as written; None if the first line holds data.
        width: number of columns.
        above: lines above the header that are no part of the table.
    """

    path: Path
    delimiter: str
    header: tuple[str, ...] | None
    width: int
    above: int = 0

    def row(self, index: int | np.integer[Any]) -> int:
        """Returns the row number that an editor shows for the data row `index` (from 0)."""
        if self.header is None:
            return int(index) + 1
        return int(index) + 2 + self.above


def stem(path: Path) -> str:
    """Returns a file's name without what follows its first dot."""
    return path.name.split(".")[0] or path.name


def magic(path: Path) -> bytes:
    """Returns the first bytes of a file.

    Raises:
        DataError: the file is missing, a folder, unreadable or empty.
    """
    if not path.exists():
        where = ""
        if not path.parent.is_dir():
            where = f" (nor is there a folder {path.parent})"
        raise DataError(f"{path}: no such file{where}; set data.path to the file to read")
    if path.is_dir():
        raise DataError(f"{path}: is a folder; set data.path to one file in it")
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    if not start:
        raise DataError(f"{path}: the file is empty; download or write it again")
    return start


def open_text(path: Path) -> BinaryIO:
    """Opens a text file, unpacking gzip by its content, whatever its name."""
    start = magic(path)
    if start.startswith(_ZIP):
        raise DataError(f"{path}: is a zip archive; unpack it and set data.path to the file inside")
    if start.startswith(_GZIP):
        return cast(BinaryIO, gzip.open(path, "rb"))
    return path.open("rb")


def sniff(path: Path) -> TextTable:
    """Looks at the beginning of a text file.

    Raises:
        DataError: it is no text, not in UTF-8, or its columns are separated by neither commas nor
            white space.
    """
    with open_text(path) as file:
        head = _guarded(path, lambda: file.read(_HEAD))
    if head.startswith(_UTF16):
        raise DataError(f"{path}: is in UTF-16; save it as UTF-8")
    first = ""
    for line in _decoded(path, head).splitlines():
        if line.strip():
            first = line
            break
    if not first:
        raise DataError(f"{path}: the file holds no rows")
    exponents_removed = first.lower().replace("e+", "").replace("e-", "")
    has_header = any(character.isalpha() for character in exponents_removed)
    delimiter = " "
    names = first.split()
    if "," in first:
        delimiter = ","
        names = _comma_separated(first)
    else:
        _refuse_other_separators(path, first, has_header=has_header)
    header = None
    if has_header:
        header = tuple(names)
    return TextTable(path, delimiter, header, len(names))


def _comma_separated(line: str) -> list[str]:
    """Returns the cells of one line of CSV."""
    options = pa.csv.ReadOptions(autogenerate_column_names=True)
    table = pa.csv.read_csv(io.BytesIO(line.encode() + b"\n"), read_options=options)
    (row,) = table.to_pylist()
    return [str(cell).strip() for cell in row.values()]


def _refuse_other_separators(path: Path, line: str, *, has_header: bool) -> None:
    """Raises DataError for a line whose columns neither commas nor white space separate."""
    for separator, plural in _OTHER_SEPARATORS.items():
        is_white_space = separator == "\t" and not has_header
        if separator in line and not is_white_space:
            raise DataError(
                f"{path}: the columns are separated by {plural}; write the file with commas"
            )


def _decoded(path: Path, head: bytes) -> str:
    """Returns the beginning of a file as text; raises DataError if it is none."""
    is_binary = any(byte < 32 and byte not in b"\t\n\r\f" for byte in head)
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # A character that the end of the block cuts in two is none of the file's faults.
        if error.start < len(head) - 4:
            is_binary = True
        text = head.decode("utf-8-sig", errors="ignore")
    if is_binary:
        raise DataError(
            f"{path}: is a binary file, not text; give a CSV or text file (gzip is fine),"
            " or parquet for data=tidy"
        )
    return text


def _guarded(path: Path, read: Callable[[], Any]) -> Any:
    """Calls `read` and turns what a damaged gzip file raises into one sentence."""
    try:
        return read()
    except EOFError:
        raise DataError(f"{path}: the gzip file is cut off; download or write it again") from None
    except (gzip.BadGzipFile, zlib.error):
        raise DataError(f"{path}: the gzip file is damaged; download or write it again") from None


class _Lines(io.RawIOBase):
    """Feeds pyarrow whole lines.

    White space is turned into commas where it separates the columns.
    """

    def __init__(self, table: TextTable) -> None:
        super().__init__()
        self._table = table
        self._file = open_text(table.path)
        self._rest = b""
        self._ready = b""
        self._is_first = True

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self._file.close()
        super().close()

    def readinto(self, buffer: Any) -> int:
        while not self._ready:
            block = _guarded(self._table.path, lambda: self._file.read(_BLOCK))
            if not block and not self._rest:
                return 0
            self._take(block)
        size = min(len(buffer), len(self._ready))
        buffer[:size] = self._ready[:size]
        self._ready = self._ready[size:]
        return size

    def _take(self, block: bytes) -> None:
        """Makes the whole lines of what was read ready, and keeps the rest; b"" ends the file."""
        everything = self._rest + block
        end = len(everything)
        if block:
            end = everything.rfind(b"\n") + 1  # 0 where no line ends: wait for more
        text = everything[:end]
        self._rest = everything[end:]
        if text and self._is_first:
            text = text.removeprefix(_UTF8_MARK)
            self._is_first = False
        if self._table.delimiter == " ":
            text = b"".join(b",".join(line.split()) + b"\n" for line in text.splitlines())
        self._ready = text


def read_columns(
    table: TextTable, numbers: Mapping[str, int], labels: Mapping[str, int]
) -> tuple[dict[str, Floats], dict[str, Labels]]:
    """Reads the columns wanted, and only these.

    Args:
        numbers: name to report -> position of each column of numbers. Thousands separators
            ("1,113,433") are understood.
        labels: name -> position of each column of text.

    Returns:
        Columns `(N,)`; an empty or NaN cell is NaN, or code -1. All have the same length, which may
        be 0.

    Raises:
        DataError: a row has another number of columns, or a cell that should be a number is none:
            with row and column.
    """
    try:
        batches = _batches(table, numbers, labels, pa.float64())
    except pa.ArrowInvalid:
        # Some cell is no plain number: read these columns as text and look closer.
        batches = _batches(table, numbers, labels, pa.string())
    values = {}
    for name, at in numbers.items():
        values[name] = _as_floats(table, name, batches.column(f"c{at}"))
    texts = {name: as_labels(batches.column(f"c{at}")) for name, at in labels.items()}
    return values, texts


def _batches(
    table: TextTable, numbers: Mapping[str, int], labels: Mapping[str, int], number_type: Any
) -> Any:
    """Returns the columns as one pyarrow table with columns c0, c1, ..."""
    broken: list[Any] = []

    def note(row: Any) -> str:
        broken.append(row)
        return "error"

    types = {f"c{at}": number_type for at in numbers.values()}
    for at in labels.values():
        types[f"c{at}"] = pa.dictionary(pa.int32(), pa.string())
    read_options = pa.csv.ReadOptions(
        # One thread: only then does pyarrow know the number of a broken row.
        use_threads=False,
        block_size=_BLOCK,
        column_names=[f"c{at}" for at in range(table.width)],
        skip_rows=table.above + int(table.header is not None),
    )
    parse_options = pa.csv.ParseOptions(invalid_row_handler=note)
    convert_options = pa.csv.ConvertOptions(column_types=types, include_columns=list(types))
    try:
        with _Lines(table) as lines, pa.PythonFile(lines, mode="r") as file:
            reader = pa.csv.open_csv(
                file,
                read_options=read_options,
                parse_options=parse_options,
                convert_options=convert_options,
            )
            return reader.read_all()
    except pa.ArrowInvalid as error:
        if broken:
            row = broken[0]
            raise DataError(
                f"{table.path}, row {row.number}: {row.actual_columns} columns instead of"
                f" {table.width}; is the file cut off there, or does a cell hold a separator?"
            ) from None
        if number_type == pa.string():
            raise DataError(f"{table.path}: cannot be read as a table ({error})") from None
        raise


def _as_floats(table: TextTable, name: str, column: Any) -> Floats:
    def complaint(index: int, cell: str) -> str:
        where = f"{table.path}, row {table.row(index)}, column {name}"
        return f"{where}: '{cell}' is not a number; correct it"

    if pa.types.is_floating(column.type):
        return cast(Floats, column.to_numpy().astype(np.float64, copy=False))
    return parsed(column, complaint)


def parsed(column: Any, complaint: Callable[[int, str], str]) -> Floats:
    """Turns a pyarrow column of text into numbers `(N,)`.

    "1,234" is read as 1234, and an empty cell as NaN.

    Raises:
        DataError: a cell is no number; `complaint(index, cell)` is the message.
    """
    text = pc.replace_substring(pc.utf8_trim_whitespace(column), ",", "").to_pandas()
    values: Floats = pd.to_numeric(text, errors="coerce").to_numpy(
        dtype=np.float64, na_value=np.nan
    )
    absent = text.isna() | text.str.lower().isin(_ABSENT)
    wrong = np.flatnonzero(np.isnan(values) & ~absent.to_numpy(dtype=bool))
    if len(wrong):
        raise DataError(complaint(int(wrong[0]), column[int(wrong[0])].as_py()))
    return values


def as_labels(column: Any) -> Labels:
    """Turns a pyarrow column of text into codes and names.

    Names keep the order in which they first appear.
    """
    encoded = column
    if not pa.types.is_dictionary(column.type):
        encoded = pc.dictionary_encode(column.cast(pa.string()))
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.unify_dictionaries().combine_chunks()
    if isinstance(encoded, pa.ChunkedArray):  # no chunk at all
        return Labels(np.zeros(0, np.int64), [])
    written: list[str | None] = []
    for name in encoded.dictionary.to_pylist():
        written.append(str(name).strip() or None)
    merged, names = pd.factorize(np.array(written, dtype=object))  # an empty name has code -1
    codes = pc.fill_null(encoded.indices, len(written)).to_numpy(zero_copy_only=False)
    return Labels(np.append(merged, -1).astype(np.int64)[codes], list(names))


def bad_cells(values: Floats) -> tuple[int, int, str] | None:
    """Returns what is wrong with a column of numbers.

    Returns:
        The index of the first cell that is no finite number, how many such cells there are, and
        what that one is; None if all are finite.
    """
    wrong = np.flatnonzero(~np.isfinite(values))
    if not len(wrong):
        return None
    what = "infinite"
    if np.isnan(values[wrong[0]]):
        what = "empty or NaN"
    return int(wrong[0]), len(wrong), what
