"""Files of recordings: their beginnings, unpacked text, and folders of parquet files.

A recording too large for one file is a folder of parquet files, one for each recording:
`pairs/recording=i80-0400/part-0.parquet` is how Arrow, Spark and pandas write a table partitioned
by `recording`, and the folder's name stands for the column. Each file is read on its own, so that
reading one recording, or looking at all of them, needs the memory of the largest.
"""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import lzma
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cfx.errors import DataError, listed, nearest

Floats = NDArray[np.float64]
"""Signals and other real values of a file, of any shape."""

Ints = NDArray[np.int64]
"""Row numbers, frames, codes and counts, of any shape."""

PARQUET = b"PAR1"
"""First bytes of parquet files."""

_PACKINGS = {
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"\xfd7zX": "xz",
    b"BZh": "bzip2",
    b"PK\x03\x04": "zip",
}
"""First bytes of files that hold one table, packed."""

_UNPACK = "unpack it, and set data.path to the table in it"
_AS_CSV = "save the sheet as CSV"
_AS_TABLE = "write the table as CSV or parquet"

_KINDS = {
    b"7z\xbc\xaf\x27\x1c": ("a 7z archive", _UNPACK),
    b"Rar!": ("a rar archive", _UNPACK),
    b"PK\x05\x06": ("an empty zip archive", "pack it again"),
    b"\x04\x22M\x18": ("an lz4 file", _UNPACK),
    b"\x1f\x9d": ("packed by compress", _UNPACK),
    b"LZIP\x01": ("an lzip file", _UNPACK),
    b"\xd0\xcf\x11\xe0": ("an Excel workbook", _AS_CSV),
    b"ARROW1": ("an Arrow or Feather file", "give it to cfx.read as a table, or write parquet"),
    b"ORC\n": ("an ORC file", _AS_TABLE),
    b"Obj\x01": ("an Avro file", _AS_TABLE),
    b"SQLite format 3": ("an SQLite database", _AS_TABLE),
    b"\x89HDF": ("an HDF5 file (as MATLAB 7.3 and NetCDF 4 write)", _AS_TABLE),
    b"CDF\x01": ("a NetCDF file", "open it with xarray and give it to cfx.read"),
    b"CDF\x02": ("a NetCDF file", "open it with xarray and give it to cfx.read"),
    b"CDF\x05": ("a NetCDF file", "open it with xarray and give it to cfx.read"),
    b"\x93NUMPY": ("a NumPy array without names of columns", _AS_TABLE),
    b"MATLAB": ("a MATLAB file", "write the table as CSV (writetable)"),
    b"%PDF": ("a PDF document", _AS_TABLE),
    b"RDX2\n": ("an R file", "write the table as CSV (write.csv)"),
    b"RDX3\n": ("an R file", "write the table as CSV (write.csv)"),
    b"<!DOCTYPE html": ("a web page", "download the file that it leads to"),
    b"<html": ("a web page", "download the file that it leads to"),
    b"version https://git-lfs": ("a pointer of Git LFS", "fetch the file (git lfs pull)"),
    b"{": ("JSON", _AS_TABLE),
    b"[": ("JSON", _AS_TABLE),
}
"""First bytes of files that hold no table that is read: what they are, and what to do."""

_PICKLES = re.compile(rb"\x80[\x02-\x05][\x95}(\]c]")

_UTF16 = (b"\xff\xfe", b"\xfe\xff")

_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0e-\x1f]")
"""Bytes below 32 that no text has: all but tab, line feed, form feed and carriage return."""

_TAR_AT, _TAR = 257, b"ustar"
"""Where a tar archive says that it is one (POSIX.1-1988): behind the fields of its first file."""

_HEAD = 1 << 16
"""Bytes that are looked at before a file is read."""

_LINES = 200
"""Lines among which a table begins."""

_COLUMN = "recording="


class FileStart(NamedTuple):
    """The beginning of a file or folder, from which its layout is known.

    Attributes:
        magic: the first bytes; b"" for a folder.
        lines: the first lines of a text, unpacked, without remarks above; () for anything else.
    """

    path: Path
    magic: bytes
    lines: tuple[str, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of a parquet file's columns; of a text, the cells of the first line."""
        if self.magic == PARQUET:
            try:
                return tuple(pq.read_schema(parquet_source(self.path)).names)
            except (pa.ArrowException, OSError, UnicodeDecodeError):  # it is damaged
                return ()
        if not self.lines:
            return ()
        return tuple(cells_of(self.lines[0], separator_of(self.lines[0])))

    def has_columns(self, *names: str) -> bool:
        """Says whether the first line has all these cells."""
        return set(names) <= set(self.columns)


def beginning(path: Path) -> FileStart:
    """Returns the beginning of a file or folder, unpacked where it is packed.

    Raises:
        DataError: there is none, it cannot be read, or it is empty; or it is an archive of several
            files, a workbook or anything else that holds no table.
    """
    if path.is_dir():
        return FileStart(path, b"", ())
    start = first_bytes(path)
    if start in {b"\x93NUM", b"MATL"} or arrays_in_zip(path):
        return FileStart(path, start, ())
    head = read_head(path)
    text = ""
    is_utf16 = head.startswith(_UTF16)
    if not head.startswith(PARQUET) and (is_utf16 or not _CONTROL.search(head)):
        text = decoded(path, head)
    lines = text.splitlines()[:_LINES]
    lines = lines[first_line_of(lines) :]
    if lines:
        lines[0] = without_mark(lines[0])
    return FileStart(path, head[:4], tuple(lines[:20]))


_REMARK = "#"


def first_line_of(lines: Sequence[str]) -> int:
    """Returns where a text begins, behind remarks: lines that begin with #.

    The last of them is the header where numbers follow it, as NumPy writes it.
    """
    header = 0
    for at, line in enumerate(lines):
        if line.lstrip().startswith(_REMARK):
            header = at
        elif line.strip():
            is_header = lines[header].lstrip().startswith(_REMARK) and not has_letters(line)
            return header if is_header else at
    return 0


def without_mark(line: str) -> str:
    """Returns a header without the mark of a remark."""
    return line.lstrip().removeprefix(_REMARK).lstrip() if line.lstrip()[:1] == _REMARK else line


def decoded(path: Path, head: bytes) -> str:
    """Returns the beginning of a file as text.

    Raises:
        DataError: it is no text, or is in another encoding than UTF-8.
    """
    if head.startswith(_UTF16):
        raise DataError(f"{path}: is in UTF-16; save it as UTF-8")
    is_binary = _CONTROL.search(head) is not None
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # A character that the end of the block cuts in two is none of the file's faults.
        if error.start < len(head) - 4 and not is_binary:
            raise DataError(f"{path}: is no text in UTF-8; write the file again in UTF-8") from None
        text = head.decode("utf-8-sig", errors="ignore")
    if is_binary:
        raise DataError(
            f"{path}: is a binary file, not text; give a CSV or text file (packed is fine),"
            " or parquet for data=tidy"
        )
    return text


_SEPARATORS = (";", "\t", "|", ",")
"""What separates the cells of a line; a comma may be a decimal mark too, so it comes last."""


def separator_of(line: str, *, spaces: bool = False) -> str:
    """Returns what separates the cells of a line; " " where it is nothing but white space.

    Args:
        spaces: white space may separate numbers even beside commas, which are then decimal marks.
    """
    counts = {separator: line.count(separator) for separator in _SEPARATORS}
    if not has_letters(line.lower().replace("e+", "").replace("e-", "")):
        if spaces and not counts[";"] + counts["|"] and re.search(r"\t\s|[^,\s] +\S", line):
            counts["\t"] = 0  # columns are aligned, in part by tabs
        if counts[";"] + counts["\t"] + counts["|"]:
            counts[","] = 0  # nothing but commas stands in numbers
        elif spaces and len(re.findall(r"(?<![,\s])\s+(?![,\s])", line)) > counts[","]:
            return " "
    separator = max(_SEPARATORS, key=counts.__getitem__)
    return separator if counts[separator] else " "


def cells_of(line: str, separator: str) -> list[str]:
    """Returns the cells of a line, without blanks around them."""
    if separator == " ":
        return line.split()
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return list(map(str.strip, cells))


def has_letters(text: str) -> bool:
    """Says whether a text has a letter, as names of columns have and numbers have not."""
    return any(map(str.isalpha, text))


def stem(path: Path) -> str:
    """Returns a file's name without what follows its first dot."""
    return path.name.split(".")[0] or path.name


def first_bytes(path: Path) -> bytes:
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
    """Opens a text file, unpacked by its content, whatever its name.

    Raises:
        DataError: it cannot be read, is an archive of several files, or holds no table.
    """
    first_bytes(path)
    file = _unpacked(path)
    with unpacking(path):
        head = file.peek(512)[:512]
    try:
        _refuse(path, head)
    except DataError:
        file.close()
        raise
    return cast(BinaryIO, file)


def _unpacked(path: Path) -> io.BufferedReader:
    """Opens a file and unpacks it."""
    packing = _packing_of(path)
    with unpacking(path):
        if packing == "gzip":
            return io.BufferedReader(cast(io.RawIOBase, gzip.open(path, "rb")))
        if packing == "xz":
            return io.BufferedReader(cast(io.RawIOBase, lzma.open(path, "rb")))
        if packing == "bzip2":
            return io.BufferedReader(cast(io.RawIOBase, bz2.open(path, "rb")))
        if packing == "zstd":
            return io.BufferedReader(pa.input_stream(str(path), compression="zstd"))
        if packing == "zip":
            return io.BufferedReader(cast(io.RawIOBase, _in_zip(path)))
    return path.open("rb")


def _packing_of(path: Path) -> str:
    """Returns how a file is packed; "" if it is not."""
    with path.open("rb") as file:
        return _packing(file.read(6))


def _packing(start: bytes) -> str:
    """Returns how a file is packed that begins so; "" if it is not."""
    for magic, name in _PACKINGS.items():
        if start.startswith(magic):
            return name
    return ""


def _in_zip(path: Path) -> Any:
    """Opens the one table of a zip archive.

    Raises:
        DataError: it holds several files or none, or is a workbook.
    """
    with zipfile.ZipFile(path) as archive:
        names = _names_in(archive)
        if "[Content_Types].xml" in names or {"mimetype", "content.xml"} <= set(names):
            what, remedy = "an office document", "write the table as CSV"
            if "content.xml" in names or any(name.startswith("xl/") for name in names):
                what, remedy = "a workbook", _AS_CSV
            raise DataError(f"{path}: is {what}; {remedy}")
        if len(names) != 1:
            count = f"holds {len(names)} files ({listed(names, 3)})" if names else "is empty"
            raise DataError(f"{path}: the zip archive {count}; {_UNPACK}")
        return archive.open(names[0])


def _names_in(archive: zipfile.ZipFile) -> list[str]:
    """Returns the files of an archive, without those that systems add of their own."""
    names = []
    for info in archive.infolist():
        last = info.filename.rpartition("/")[2]
        if not info.is_dir() and not last.startswith(".") and "__MACOSX/" not in info.filename:
            names.append(info.filename)
    return names


def arrays_in_zip(path: Path) -> bool:
    """Says whether a file is a zip archive of NumPy arrays (.npz)."""
    if _packing_of(path) != "zip" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        names = _names_in(archive)
    return bool(names) and all(name.endswith(".npy") for name in names)


def parquet_source(path: Path) -> Path | io.BytesIO:
    """Returns what pyarrow reads a parquet file from: its path, or its bytes where it is packed."""
    if not _packing_of(path):
        return path
    with _unpacked(path) as file, unpacking(path):
        return io.BytesIO(file.read())


def _refuse(path: Path, head: bytes) -> None:
    """Raises DataError for a file that holds no table, by what it begins with, unpacked."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    reason = None
    for magic, kind in _KINDS.items():
        if head.startswith(magic) or (magic.isascii() and text.startswith(magic)):
            reason = kind
            break
    if head[_TAR_AT:].startswith(_TAR):
        reason = "a tar archive", _UNPACK
    if _PICKLES.match(head):
        reason = "a pickle, which runs whatever code it holds when it is read", _AS_TABLE
    packing = _packing(head)
    if packing:
        reason = f"packed more than once ({packing} inside)", _UNPACK
    if reason is not None:
        what, remedy = reason
        raise DataError(f"{path}: is {what}; {remedy}")


def read_head(path: Path) -> bytes:
    """Returns the first 64 kB of a file, unpacked.

    Raises:
        DataError: as `open_text`; or what packs it is damaged.
    """
    with open_text(path) as file, unpacking(path):
        return file.read(_HEAD)


@contextmanager
def unpacking(path: Path) -> Iterator[None]:
    """Turns what a damaged packed file raises into a DataError."""
    packing = _packing_of(path) or "packed"
    again = "download or write it again"
    try:
        yield
    except EOFError:
        raise DataError(f"{path}: the {packing} file is cut off; {again}") from None
    except (gzip.BadGzipFile, zlib.error, lzma.LZMAError, zipfile.BadZipFile):
        raise DataError(f"{path}: the {packing} file is cut off or damaged; {again}") from None
    except (RuntimeError, NotImplementedError) as error:
        if packing != "zip":
            raise
        raise DataError(f"{path}: the zip archive cannot be read ({error}); {_UNPACK}") from None
    except OSError as error:
        if packing not in {"zstd", "bzip2"}:
            raise
        raise DataError(
            f"{path}: the {packing} file is cut off or damaged ({error}); {again}"
        ) from None


# --- folders of parquet files ---------------------------------------------------------------------


def partitions(path: Path) -> list[Path]:
    """Returns the parquet files below a folder, sorted by name; of a file, the file itself.

    Raises:
        DataError: the folder holds none.
    """
    if not path.is_dir():
        return [path]
    files = sorted(_parquet_files(path))
    if not files:
        raise DataError(
            f"{path}: is a folder without parquet files; set data.path to a file, or to a folder"
            f" such as pairs with pairs/{_COLUMN}NAME/part-0.parquet in it"
        )
    return files


def are_partitions(path: Path) -> bool:
    """Says whether a folder holds parquet files, in folders named by recordings or beside them."""
    return path.is_dir() and next(_parquet_files(path), None) is not None


def _parquet_files(folder: Path) -> Iterator[Path]:
    """Yields the parquet files below a folder; folders that are links count, each once."""
    visited = set()
    for place, below, names in os.walk(folder, followlinks=True):
        home = os.path.realpath(place)
        if home in visited:
            below.clear()
            continue
        visited.add(home)
        below.sort()
        for name in names:
            file = Path(place, name)
            if name.endswith(".parquet") and not name.startswith((".", "_")) and file.is_file():
                yield file


def recording_of(file: Path) -> str | None:
    """Returns the recording that a file's folder is named by; None if it is not."""
    for folder in file.parents:
        if folder.name.startswith(_COLUMN):
            return unquote(folder.name.removeprefix(_COLUMN))
    return None


def of_recording(files: Sequence[Path], recording: str | None) -> list[Path]:
    """Returns the files that may hold a recording: those of others are not read.

    Args:
        files: of one or more folders.
        recording: its name; None: all of them.

    Raises:
        DataError: all files belong to other recordings.
    """
    if recording is None:
        return list(files)
    chosen, recordings = [], set()
    for file in files:
        name = recording_of(file)
        recordings.add(name or "")
        if name is None or name == recording:
            chosen.append(file)
    if not chosen:
        names = sorted(recordings)
        raise DataError(
            f"data.recording={recording}: there is no such recording.{nearest(recording, names)}"
            f" Known: {listed(names)}."
        )
    return chosen
