"""Names of sites, and of vehicles that are in several recordings."""

from __future__ import annotations

import re
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from cfx.data.pairs import Pair, PairSet
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
    found: dict[tuple[str, str], str | None] = {}
    used = set()
    for pair in pairs:
        key = (pair.recording, pair.site)
        if key not in found:
            fits = [one for one in names if any(fnmatchcase(name, one) for name in key)]
            used.update(fits[:1])
            found[key] = names[fits[0]] if fits else None
    unnamed = [recording for (recording, _), site in found.items() if site is None]
    if unnamed:
        raise DataError(
            f"data.site: no pattern fits {listed(sorted(unnamed), 3)} of {pairs.source}; add one,"
            " such as '*'"
        )
    for pattern in names:
        if pattern not in used:
            raise DataError(
                f"data.site: '{pattern}' fits no recording or file of {pairs.source}; recordings:"
                f" {listed(sorted({recording for recording, _ in found}), 5)}"
            )

    def named(pair: Pair) -> Pair:
        return replace(pair, site=found[pair.recording, pair.site] or "")

    return replace(pairs, pairs=tuple(named(pair) for pair in pairs))


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
    fits = False
    for pair in pairs:
        match = expression.search(pair.follower_id)
        fits |= match is not None
        named.append(pair if match is None else replace(pair, vehicle=match[1]))
    if not fits and len(pairs):
        raise DataError(
            f"data.vehicle={pattern} fits no follower's id of {pairs.source}; ids there:"
            f" {listed(sorted({pair.follower_id for pair in pairs}), 5)}"
        )
    return replace(pairs, pairs=tuple(named))
