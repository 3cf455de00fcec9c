"""Recordings too many for one file: parquet files in folders, one recording each.

`pairs/recording=i80-0400/part-0.parquet` is how Arrow, Spark and pandas write a table partitioned
by `recording`: the folder's name stands for the column. Each file is read on its own, so that
reading one recording, or looking at all of them, needs the memory of the largest.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

from cfx.core.errors import DataError, nearest
from cfx.data.base import listed

_COLUMN = "recording="


def partitions(path: Path) -> list[Path]:
    """Returns the parquet files below a folder, sorted by name; a file stands for itself.

    Raises:
        DataError: the folder holds none.
    """
    if not path.is_dir():
        return [path]
    found = sorted(_files(path))
    if not found:
        raise DataError(
            f"{path}: is a folder without parquet files; set data.path to a file, or to a folder"
            f" such as pairs with pairs/{_COLUMN}NAME/part-0.parquet in it"
        )
    return found


def are_partitions(path: Path) -> bool:
    """Says whether a folder holds parquet files, in folders named by recordings or beside them."""
    return path.is_dir() and next(_files(path), None) is not None


def _files(folder: Path) -> Iterator[Path]:
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
    wanted = [file for file in files if recording_of(file) in {None, recording}]
    if not wanted:
        known = _known(files)
        raise DataError(
            f"data.recording={recording}: there is no such recording.{nearest(recording, known)}"
            f" Known: {listed(known)}."
        )
    return wanted


def _known(files: Iterable[Path]) -> list[str]:
    found = {recording_of(file) for file in files}
    return sorted(name for name in found if name is not None)
