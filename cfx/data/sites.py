"""Names of sites, and of vehicles that are in several recordings."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from cfx.data.pairs import PairSet
from cfx.errors import DataError, listed

SiteNames = str | dict[str, str] | None
"""One site for all recordings, or the site of each pattern of recordings or files."""


def _with_one_group(pattern: str) -> str:
    try:
        groups = re.compile(pattern).groups
    except re.error as error:
        raise PydanticCustomError(
            "vehicle",
            "'{pattern}' is no regular expression ({error})",
            {"pattern": pattern, "error": str(error)},
        ) from None
    if groups != 1:
        raise PydanticCustomError(
            "vehicle",
            "'{pattern}' needs one group, the vehicle's name, such as '^[0-9]+-(.+)$'",
            {"pattern": pattern},
        )
    return pattern


VehiclePattern = Annotated[str, AfterValidator(_with_one_group)]
"""A regular expression whose one group is a vehicle's name."""


def with_sites(pairs: PairSet, names: SiteNames) -> PairSet:
    """Names the site of each pair.

    Args:
        pairs: as read.
        names: the site of all pairs, or by patterns such as `i80-*` of a recording's name or its
            file's; the first that fits holds. None: what the source says.

    Raises:
        DataError: a pattern fits no recording, or a recording has no pattern that fits.
    """
    if names is None:
        return pairs
    if isinstance(names, str):
        return replace(pairs, pairs=tuple(replace(pair, site=names) for pair in pairs))
    pattern_of: dict[tuple[str, str], str] = {}
    unnamed = []
    for pair in pairs:
        recording_and_file = (pair.recording, pair.site)
        if recording_and_file in pattern_of:
            continue
        pattern = _first_that_fits(names, recording_and_file)
        if pattern is None:
            unnamed.append(pair.recording)
            pattern = ""
        pattern_of[recording_and_file] = pattern
    if unnamed:
        raise DataError(
            f"data.site: no pattern fits {listed(sorted(unnamed), 3)} of {pairs.source}; add one,"
            " such as '*'"
        )
    for pattern in names:
        if pattern not in pattern_of.values():
            recordings = {recording for recording, _ in pattern_of}
            raise DataError(
                f"data.site: '{pattern}' fits no recording or file of {pairs.source}; recordings:"
                f" {listed(sorted(recordings), 5)}"
            )
    named = []
    for pair in pairs:
        named.append(replace(pair, site=names[pattern_of[pair.recording, pair.site]]))
    return replace(pairs, pairs=tuple(named))


def _first_that_fits(patterns: Iterable[str], names: Iterable[str]) -> str | None:
    """Returns the first pattern that fits one of some names; None if none does."""
    for pattern in patterns:
        for name in names:
            if fnmatchcase(name, pattern):
                return pattern
    return None


def with_vehicles(pairs: PairSet, pattern: str | None) -> PairSet:
    """Names each follower's vehicle by what a pattern finds in its id.

    Where the pattern does not fit an id, what the source says holds.

    Args:
        pairs: as read.
        pattern: a regular expression with one group; None: what the source says.

    Raises:
        DataError: it fits no follower's id.
    """
    if pattern is None:
        return pairs
    expression = re.compile(pattern)
    named = []
    fits_any = False
    for pair in pairs:
        match = expression.search(pair.follower_id)
        fits_any |= match is not None
        if match is None:
            named.append(pair)
        else:
            named.append(replace(pair, vehicle=match[1]))
    if not fits_any and len(pairs):
        ids = {pair.follower_id for pair in pairs}
        raise DataError(
            f"data.vehicle={pattern} fits no follower's id of {pairs.source}; ids there:"
            f" {listed(sorted(ids), 5)}"
        )
    return replace(pairs, pairs=tuple(named))
