"""What a cell says: numbers and names of a table, however it stores and writes them.

Tables come from spreadsheets, databases and other programs. A number may be text with a decimal
comma, or with thousands marked by a comma, a point, a blank or an apostrophe. "11,345" alone may be
11.345 or 11345. So the cells of a column are looked at together, and where they leave it open, the
other columns of the file, which somebody wrote in one way. What remains open is refused: a wrong
guess is wrong by a factor of a thousand.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from cfx.data.files import Floats, Ints
from cfx.data.names import name_of

_ABSENT = ("", "nan", "na", "null", "none", "n/a", "#n/a", "<na>", "nat")
"""Cells that stand for no number, in small letters."""

_TIME_UNITS = {"s": 1.0, "ms": 1000.0}
"""Units of columns that may hold dates and times, and how many of them a second has."""

_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""How many of an Arrow unit of time a second has."""

_BLANKS = "\u0020\u00a0\u2009\u202f"
_APOSTROPHES = "'\u2019"
_BESIDE_MARKS = rf"^[+-]?[1-9][0-9]{{0,2}}(?:[{_BLANKS}{_APOSTROPHES}][0-9]{{3}})+(?:[.,][0-9]*)?$"
"""A number whose thousands are marked by blanks or apostrophes, which are nothing but that."""

_EXPONENT = "(?:[eE][+-]?[0-9]+)?"
_WHOLE = rf"^[+-]?(?:[0-9]+{_EXPONENT}|[iI][nN][fF](?:[iI][nN][iI][tT][yY])?)$"
_LONG_WHOLE = r"^[+-]?[0-9]{4,}(?:[.,].*)?$"
_DATE_AND_TIME = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}[T ][0-9]{2}:[0-9]{2}(?::[0-9]{2}(?:\.[0-9]+)?)?"
_DATE_AND_TIME += r"(?: ?(?:Z|[+-][0-9]{2}:?[0-9]{2}))?$"
_TIME_OF_DAY = r"^[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]+)?$"

_MARKS = {".": ",", ",": "."}
"""Decimal marks, and what marks thousands beside each."""

_SPOKEN = {".": "a point", ",": "a comma"}

_WITH_ZEROS = re.compile(r"-?[0-9]+,000")
"""A name that is a whole number with three decimals, or one of thousands."""


def _fraction(mark: str) -> str:
    """Returns the expression of a number with this decimal mark and unmarked thousands."""
    return rf"^[+-]?(?:[0-9]+\{mark}[0-9]*|\{mark}[0-9]+){_EXPONENT}$"


def _grouped(mark: str) -> str:
    """Returns the expression of a number with this decimal mark and marked thousands."""
    thousands = _MARKS[mark]
    return rf"^[+-]?[1-9][0-9]{{0,2}}(?:\{thousands}[0-9]{{3}})+(?:\{mark}[0-9]*)?$"


class Unreadable(Exception):  # noqa: N818 - it says what is wrong with cells; tables say where
    """A column's cells are not what they should be.

    Attributes:
        what: what is wrong, and what to do about it.
        row: index of the first such cell; None where the whole column is.
        column: its name.
    """

    def __init__(self, what: str, row: int | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.row = row
        self.column = ""


@dataclass(frozen=True)
class Written:
    """A column of numbers that are written as text.

    Attributes:
        text: without blanks around, and without marks of thousands that mark nothing else `(N,)`;
            "" stands for an empty cell.
        original: as the file has it.
        is_whole: whether the column's numbers are whole.
        has: by decimal mark, which cells can only be numbers with it, `(N,)`.
        may_have: by decimal mark, which cells may be numbers with it, `(N,)`.
        marks_thousands: by decimal mark, which cells would have marked thousands, `(N,)`.
    """

    text: Any
    original: Any
    is_whole: bool
    has: dict[str, NDArray[np.bool_]]
    may_have: dict[str, NDArray[np.bool_]]
    marks_thousands: dict[str, NDArray[np.bool_]]

    @classmethod
    def of(cls, column: Any, *, is_whole: bool) -> Written:
        """Looks at a column of text.

        Raises:
            Unreadable: it holds dates, units or anything else that is no number.
        """
        text = pc.fill_null(pc.utf8_trim_whitespace(column), "")
        text = pc.replace_substring(text, "\u2212", "-")
        beside = pc.match_substring_regex(text, _BESIDE_MARKS)
        bare = pc.replace_substring_regex(text, f"[{_BLANKS}{_APOSTROPHES}]", "")
        text = pc.if_else(beside, bare, text)
        is_absent = pc.is_in(pc.utf8_lower(text), value_set=pa.array(_ABSENT, text.type))
        text = pc.if_else(is_absent, "", text)
        whole = _matches(text, _WHOLE) | _marks(is_absent)
        has, may_have, marks_thousands = {}, {}, {}
        for mark in _MARKS:
            marks_thousands[mark] = _matches(text, _grouped(mark))
            may_have[mark] = whole | _matches(text, _fraction(mark)) | marks_thousands[mark]
        for mark, other in _MARKS.items():
            has[mark] = may_have[mark] & ~may_have[other]
        wrong = np.flatnonzero(~may_have["."] & ~may_have[","])
        if len(wrong):
            row = int(wrong[0])
            raise Unreadable(_no_number(column[row].as_py()), row)
        return cls(text, column, is_whole, has, may_have, marks_thousands)

    @property
    def mark(self) -> str | None:
        """The decimal mark that some cell has for sure; None where none does.

        Raises:
            Unreadable: different cells have different ones.
        """
        more_frequent, rarer = sorted(_MARKS, key=lambda mark: -int(self.has[mark].sum()))
        if not self.has[more_frequent].any():
            return None
        rows = np.flatnonzero(self.has[rarer])
        if not len(rows):
            return more_frequent
        row = int(rows[0])
        raise Unreadable(
            f"{self._cell(row)} is not a number; write decimals with {_SPOKEN[more_frequent]}"
            " in every cell",
            row,
        )

    def numbers(self, marks: Sequence[str]) -> Floats:
        """Returns the numbers `(N,)`; NaN where a cell is empty.

        Args:
            marks: decimal marks that columns of the file have for sure.

        Raises:
            Unreadable: a cell is no number, or may be two different ones.
        """
        mark = self.mark or self._mark_beside(marks)
        thousands = self.marks_thousands[mark]
        self._check_thousands(mark)
        text = self.text
        if thousands.any():
            text = pc.if_else(
                pa.array(thousands), pc.replace_substring(text, _MARKS[mark], ""), text
            )
        if mark == ",":
            text = pc.replace_substring(text, ",", ".")
        # pandas reads the decimals to the last bit, as Arrow's reader of CSV does.
        return cast(
            Floats,
            pd.to_numeric(text.to_pandas(), errors="coerce").to_numpy(np.float64, na_value=np.nan),
        )

    def _mark_beside(self, marks: Sequence[str]) -> str:
        """Returns the decimal mark of a column whose cells leave it open."""
        with_comma = np.flatnonzero(self.marks_thousands["."])  # "1,234"
        with_point = np.flatnonzero(self.marks_thousands[","])  # "1.234"
        if not len(with_comma) and not len(with_point):
            return "."  # whole numbers
        if len(with_comma) and len(with_point):  # one of them has decimals
            row = int(max(with_comma[0], with_point[0]))
            raise Unreadable(
                f"{self._cell(row)} is not a number as the cells above are; write decimals with a"
                " point in every cell, and thousands without a mark",
                row,
            )
        if len(with_point):  # a point marks decimals, unless commas do so elsewhere
            if "," not in marks:
                return "."
            row = int(with_point[0])
        else:
            if len(marks) == 1:
                return marks[0]
            row = int(with_comma[0])
        raise self._ambiguous(row)

    def _check_thousands(self, mark: str) -> None:
        """Raises Unreadable where a mark of thousands may be a decimal mark after all.

        A column in which "1,234" is 1234 marks all its thousands, and where it has decimals, marks
        them somewhere together with thousands.
        """
        thousands = self.marks_thousands[mark]
        doubtful = np.flatnonzero(thousands & self.may_have[_MARKS[mark]])
        if not len(doubtful):
            return
        row = int(doubtful[0])
        if (_matches(self.text, _LONG_WHOLE) & ~thousands).any():
            raise self._ambiguous(row)
        has_decimals = self.has[mark] & ~thousands
        if has_decimals.any() and not (self.has[mark] & thousands).any():
            raise self._ambiguous(row)

    def _ambiguous(self, row: int) -> Unreadable:
        """Returns the error that a cell may be two different numbers."""
        text = str(self.text[row].as_py())
        whole = text.replace(",", "").replace(".", "")
        decimal = text.replace(",", ".")
        return Unreadable(
            f"{self._cell(row)} may be {decimal} or {whole}, and nothing beside it says which;"
            " write decimals with a point, and thousands without a mark",
            row,
        )

    def _cell(self, row: int) -> str:
        return f"'{self.original[row].as_py()}'"


def _matches(text: Any, expression: str) -> NDArray[np.bool_]:
    return _marks(pc.match_substring_regex(text, expression))


def _marks(column: Any) -> NDArray[np.bool_]:
    """Returns a column of true and false as an array."""
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=bool)


def _no_number(cell: str) -> str:
    """Returns what to say of a cell that is no number."""
    remedy = "correct it"
    has_digits = any(map(str.isdigit, cell))
    if ":" in cell and has_digits:
        remedy = "write the seconds since a frame of your choice"
    elif "," in cell and has_digits:
        remedy = "write decimals with a point"
    elif cell[:1].isdigit() and cell[-1:].isalpha():
        remedy = "write the number alone, and say its unit in data.units"
    return f"'{cell}' is not a number; {remedy}"


# --- numbers --------------------------------------------------------------------------------------


def numbers_or_text(column: Any, unit: str, *, is_whole: bool) -> Floats | Written:
    """Returns an Arrow column of any type as numbers `(N,)`, or as numbers that are text.

    Whole numbers of any size are numbers, as nanoseconds since 1970 are. Where the unit is s or ms,
    dates with times count from 1970 in UTC, times of day from midnight, durations from their start.

    Args:
        unit: of the numbers.
        is_whole: whether they are whole.

    Raises:
        Unreadable: the column holds something else.
    """
    column = _stored(column)
    kind = column.type
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan)
    if _is_text(kind):
        text = _as_text(column)
        seconds = _seconds_of_text(text, unit)
        return Written.of(text, is_whole=is_whole) if seconds is None else seconds
    if pa.types.is_temporal(kind) and not pa.types.is_date(kind):
        if unit not in _TIME_UNITS:
            raise Unreadable(f"holds {_words(kind)}, not numbers; write it as numbers")
        return _seconds(column) * _TIME_UNITS[unit]
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        # Not safe: whole numbers beyond 2^53 are rounded, as those of a text are.
        return cast(Floats, column.cast(pa.float64(), safe=False).to_numpy())
    raise Unreadable(f"holds {_words(kind)}, not numbers; write it as numbers")


def parsed(columns: Mapping[str, Floats | Written]) -> dict[str, Floats]:
    """Returns the numbers of columns, those that are text read as all of them are written.

    Args:
        columns: of one table, by name.

    Raises:
        Unreadable: a cell is no number, or may be two different ones; names the column.
    """
    marks: list[str] = []
    for name, column in columns.items():
        if isinstance(column, Written):
            with in_column(name):
                mark = column.mark
            if mark is not None and mark not in marks:
                marks.append(mark)
    numbers = {}
    for name, column in columns.items():
        if isinstance(column, Written):
            with in_column(name):
                numbers[name] = column.numbers(marks)
        else:
            numbers[name] = column
    return numbers


@contextmanager
def in_column(name: str) -> Iterator[None]:
    """Adds the column's name to an `Unreadable` that the block raises."""
    try:
        yield
    except Unreadable as error:
        error.column = name
        raise


def _stored(column: Any) -> Any:
    """Returns a column's values: dictionaries, run lengths and extension types are resolved."""
    kind = column.type
    if isinstance(kind, pa.BaseExtensionType):
        storage = kind.storage_type
        # Anything else means more than its storage says, as the period of a number of months does.
        if kind.extension_name not in {"arrow.bool8", "arrow.json", "arrow.uuid"}:
            raise Unreadable(f"holds {kind.extension_name}, not numbers or names; write it as text")
        column, kind = column.cast(storage), storage
    if pa.types.is_run_end_encoded(kind):
        column = pc.run_end_decode(column)
        kind = column.type
    if pa.types.is_dictionary(kind):
        column = column.cast(kind.value_type)
    return column


def _is_text(kind: Any) -> bool:
    is_string = (
        pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)
    )
    return bool(is_string) or _is_binary(kind)


def _is_binary(kind: Any) -> bool:
    is_long = pa.types.is_large_binary(kind) or pa.types.is_binary_view(kind)
    return bool(pa.types.is_binary(kind) or is_long)


def _as_text(column: Any) -> Any:
    """Returns a column of text in the type in which Arrow computes with text.

    Raises:
        Unreadable: it is not in UTF-8.
    """
    if _is_binary(column.type) and not pa.types.is_binary_view(column.type):
        column = column.cast(pa.large_binary())
    try:
        if not _is_binary(column.type):
            column.validate(full=True)
        text = column.cast(pa.large_string())
        text.validate(full=True)
    except pa.ArrowException:
        raise Unreadable(
            "is no text in UTF-8; write the file again in UTF-8", _broken(column)
        ) from None
    return text


def _broken(column: Any) -> int | None:
    """Returns the index of the first cell that is no UTF-8."""
    as_bytes = column
    if not _is_binary(column.type):
        as_bytes = column.cast(pa.large_binary(), safe=False)
    for row, cell in enumerate(as_bytes):
        try:
            (cell.as_py() or b"").decode()
        except UnicodeDecodeError:
            return row
    return None


def _words(kind: Any) -> str:
    """Returns what messages call an Arrow type."""
    if pa.types.is_boolean(kind):
        return "true and false"
    if pa.types.is_date(kind):
        return "dates without times"
    return str(kind)


def _seconds(column: Any) -> Floats:
    """Returns dates with times, times of day or durations in seconds `(N,)`; NaN where empty."""
    kind = column.type
    if pa.types.is_interval(kind):
        return _seconds_of_intervals(column)
    counts = column.cast(pa.int32() if kind.bit_width == 32 else pa.int64()).cast(pa.int64())
    is_empty = _marks(pc.is_null(counts))
    whole = pc.fill_null(counts, 0).to_numpy()
    # Whole seconds and the rest apart: nanoseconds since 1970 have more digits than a float.
    seconds, rest = np.divmod(whole, _PER_SECOND[kind.unit])
    total: Floats = seconds + rest / _PER_SECOND[kind.unit]
    total[is_empty] = np.nan
    return total


def _seconds_of_intervals(column: Any) -> Floats:
    """Returns intervals in seconds `(N,)`; raises Unreadable for months, which have no length."""
    seconds = np.full(len(column), np.nan)
    for row, interval in enumerate(column.to_pylist()):
        if interval is None:
            continue
        if interval.months:
            raise Unreadable("holds months, whose length is not known; write seconds", row)
        seconds[row] = 86400.0 * interval.days + interval.nanoseconds / 1e9
    return seconds


def _seconds_of_text(text: Any, unit: str) -> Floats | None:
    """Returns dates with times, or times of day, that are written as text, in the unit `(N,)`.

    None where it is no column of time, or some cell is neither empty nor one of these.
    """
    if unit not in _TIME_UNITS or not len(text):
        return None
    trimmed = pc.fill_null(pc.utf8_trim_whitespace(text), "")
    is_absent = pc.is_in(pc.utf8_lower(trimmed), value_set=pa.array(_ABSENT, trimmed.type))
    empty = _marks(is_absent)
    if empty.all():
        return None
    cells = pc.if_else(is_absent, None, trimmed).to_pandas()
    if (_matches(trimmed, _DATE_AND_TIME) | empty).all():
        since = pd.to_datetime(cells, format="ISO8601", utc=True) - pd.Timestamp(0, tz="UTC")
    elif (_matches(trimmed, _TIME_OF_DAY) | empty).all():
        since = pd.to_timedelta(cells)
    else:
        return None
    return _seconds(pa.chunked_array(pa.array(since))) * _TIME_UNITS[unit]


# --- names ----------------------------------------------------------------------------------------


class NameColumn(NamedTuple):
    """A column of names: `codes` `(N,)` points into `names`; -1 is an empty cell."""

    codes: Ints
    names: list[str]

    def at(self, row: int) -> str:
        """Returns the name in a row; "" for an empty cell."""
        code = int(self.codes[row])
        if code < 0:
            return ""
        return self.names[code]


def names_in(column: Any) -> NameColumn:
    """Returns an Arrow column of any type as names, in the order in which they first appear.

    Raises:
        Unreadable: it holds lists or anything else that is no name, or no UTF-8.
    """
    if not isinstance(column.type, pa.BaseExtensionType) and pa.types.is_nested(column.type):
        raise Unreadable(f"holds {column.type}, not names; write a text or a number in each row")
    codes, cells = _encoded(column)
    texts = pd.Series(list(map(name_of, cells)), dtype=object).replace("", None)
    ids = texts.dropna()
    if len(ids) > 1 and ids.map(_WITH_ZEROS.fullmatch).notna().all():
        # Several ids will not all be multiples of 1000: the comma marks decimals.
        texts = texts.str.partition(",")[0]
    merged, names = pd.factorize(texts.to_numpy(dtype=object))  # an empty name has code -1
    with_missing = np.append(merged, -1).astype(np.int64)
    return NameColumn(with_missing[codes], list(names))


def _encoded(column: Any) -> tuple[Ints, list[Any]]:
    """Returns the different cells, and for each row the number of its cell, `(N,)`.

    An empty cell has the number after the last.
    """
    if not pa.types.is_dictionary(column.type):
        is_uuid = getattr(column.type, "extension_name", "") == "arrow.uuid"
        if is_uuid:
            column = pa.chunked_array(pa.array([str(cell) for cell in column.to_pylist()]))
        column = _stored(column)
        if _is_text(column.type):
            column = _as_text(column)
        elif not (pa.types.is_floating(column.type) or pa.types.is_null(column.type)):
            column = column.cast(pa.large_string())
        column = pc.dictionary_encode(column)
    elif _is_text(column.type.value_type):
        for chunk in column.chunks:
            _as_text(pa.chunked_array([chunk.dictionary]))
    column = column.unify_dictionaries().combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # no chunk at all
        return np.zeros(0, np.int64), []
    cells = column.dictionary.to_pylist()
    codes = pc.fill_null(column.indices.cast(pa.int64()), len(cells))
    return codes.to_numpy(zero_copy_only=False), cells
