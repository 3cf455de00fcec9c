"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Gives the block a name beside `path`, with the same suffixes, to write to; it takes its place if the block ends well.

    If the block fails, nothing of it is left and an earlier file stays as it was.

    Raises:
        OSError: the place cannot be written.
    """
    partial = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
