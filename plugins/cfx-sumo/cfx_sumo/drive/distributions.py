"""vTypeDistributions of a scenario: which vTypes they have as members.

TraCI lists distributions among the vTypes and does not say which are which, nor their members. So
they are read where SUMO read them: in the scenario's route files and additional files.
"""

from __future__ import annotations

import gzip
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

_KINDS = ("vType", "vTypeDistribution")


def members_of(names: Collection[str], files: Iterable[Path]) -> dict[str, tuple[str, ...]]:
    """Returns the members of those names that are vTypeDistributions.

    Args:
        names: of vTypes and vTypeDistributions.
        files: XML, perhaps compressed (`.gz`), in the order in which SUMO reads them; no more of
            them is read than it takes to find the names.
    """
    missing = set(names)
    members: dict[str, tuple[str, ...]] = {}
    for file in files:
        for element in _types_in(file):
            name = element.get("id", "")
            if name in missing:
                missing.discard(name)
                if element.tag == "vTypeDistribution":
                    # Members are named in an attribute, or stand inside the distribution.
                    inside = [vtype.get("id", "") for vtype in element.iter("vType")]
                    members[name] = (*element.get("vTypes", "").split(), *inside)
            if not missing:
                return members
    return members


def _types_in(file: Path) -> Iterator[ElementTree.Element]:
    """Yields vTypes and their distributions as they end; all else is dropped as it is read.

    Those of files that are included stand where the `include` stands.
    """
    depth = 0
    with _opened(file) as stream:
        # S314: it is the user's own file, and SUMO has read it already.
        for event, element in ElementTree.iterparse(stream, ("start", "end")):  # noqa: S314
            if event == "start":
                depth += 1
                continue
            depth -= 1
            if element.tag in _KINDS:
                yield element
            if element.tag == "include":
                yield from _types_in(file.parent / element.get("href", ""))
            if depth == 1:
                element.clear()


def _opened(file: Path) -> BinaryIO | gzip.GzipFile:
    if file.suffix == ".gz":
        return gzip.open(file)
    return file.open("rb")
