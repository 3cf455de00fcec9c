"""Files of recordings: their beginnings, unpacked text, and folders of parquet files.

A recording too large for one file is a folder of parquet files, one for each recording:
`pairs/recording=i80-0400/part-0.parquet` is how Arrow, Spark and pandas write a table partitioned
by `recording`, and the folder's name stands for the column. Each file is read on its own, so that
reading one recording, or looking at all of them, needs the memory of the largest.
"""

from __future__ import annotations

import gzip
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple, cast
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

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\x03\x04"
PARQUET = b"PAR1"
"""First bytes of files."""

_HEAD = 1 << 16
"""Bytes that are looked at before a file is read."""

_COLUMN = "recording="


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
        """The names of a parquet file's columns; of a text, the cells of the first line."""
        if self.magic == PARQUET:
            try:
                return tuple(pq.read_schema(self.path).names)
            except (pa.ArrowException, OSError, UnicodeDecodeError):  # it is damaged
                return ()
        if not self.lines:
            return ()
        return tuple([cell.strip().strip('"') for cell in re.split("[,;]", self.lines[0])])

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
    start = first_bytes(path)
    if start.startswith(_ZIP):
        return FileStart(path, start, ())
    head = read_head(path)
    try:
        text = head.decode("utf-8-sig", errors="strict" if len(head) < _HEAD else "ignore")
    except UnicodeDecodeError:
        text = ""
    if "\0" in text:
        text = ""
    return FileStart(path, start, tuple(text.splitlines()[:20]))


def has_letters(text: str) -> bool:
    """Says whether a text has a letter, as names of columns have and numbers have not."""
    return any(character.isalpha() for character in text)


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
    """Opens a text file, unpacking gzip by its content, whatever its name."""
    start = first_bytes(path)
    if start.startswith(_ZIP):
        raise DataError(f"{path}: is a zip archive; unpack it and set data.path to the file inside")
    if start.startswith(_GZIP):
        return cast(BinaryIO, gzip.open(path, "rb"))
    return path.open("rb")


def read_head(path: Path) -> bytes:
    """Returns the first 64 kB of a text file, unpacked.

    Raises:
        DataError: the file cannot be read, or its gzip is damaged.
    """
    with open_text(path) as file, unpacking(path):
        return file.read(_HEAD)


@contextmanager
def unpacking(path: Path) -> Iterator[None]:
    """Turns what a damaged gzip file raises into a DataError."""
    try:
        yield
    except EOFError:
        raise DataError(f"{path}: the gzip file is cut off; download or write it again") from None
    except (gzip.BadGzipFile, zlib.error):
        raise DataError(f"{path}: the gzip file is damaged; download or write it again") from None


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
    seen = set()
    for place, below, names in os.walk(folder, followlinks=True):
        home = os.path.realpath(place)
        if home in seen:
            below.clear()
            continue
        seen.add(home)
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
        known = sorted(recordings)
        raise DataError(
            f"data.recording={recording}: there is no such recording.{nearest(recording, known)}"
            f" Known: {listed(known)}."
        )
    return chosen
