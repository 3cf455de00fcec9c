"""What the names of public recordings say: their road, who drives there, how cars are numbered.

The files of these recordings do not state it in columns, but their publishers do. A file that says
otherwise of a pair, or a setting (`data.site`, `data.vehicle`), is believed first.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import NamedTuple

from cfx.data.pairs import Pair, PairSet
from cfx.data.sites import SiteNames, with_sites, with_vehicles


class KnownRecording(NamedTuple):
    """A public recording.

    Attributes:
        prefix: of the names of its recordings.
        site: where it was made.
        driver_type: of all drivers who have no label; "": not known.
        vehicle: a regular expression whose group is a car's name in a follower's id; "": a car has
            no name that it keeps over recordings.
    """

    prefix: str
    site: str
    driver_type: str = ""
    vehicle: str = ""


_OPENACC = "^[0-9]+-(.+)$"

RECORDINGS = (
    KnownRecording("i80-", "I-80", "human"),
    KnownRecording("us101-", "US-101", "human"),
    KnownRecording("us-101-", "US-101", "human"),
    KnownRecording("openacc-zalazone", "ZalaZone", vehicle=_OPENACC),
    KnownRecording("openacc-vicolungo", "Vicolungo", vehicle=_OPENACC),
    KnownRecording("openacc-jrclowspeed", "Ispra", vehicle=_OPENACC),
    KnownRecording("openacc-", "OpenACC", vehicle=_OPENACC),
    KnownRecording("tgsim-", "TGSIM freeways", "human"),
    KnownRecording("carma-", "Aberdeen", "acc", "^(.+?)(?::.*)?$"),
)
"""The first whose prefix fits counts. NGSIM recorded in 2005, before cars kept distances."""


@cache
def known_recording(recording: str) -> KnownRecording | None:
    """Returns the public recording of a name; None: it is none."""
    for recording_of_site in RECORDINGS:
        if recording.lower().startswith(recording_of_site.prefix):
            return recording_of_site
    return None


def with_names(pairs: PairSet, site: SiteNames, vehicle: str | None) -> PairSet:
    """Names sites and vehicles: by patterns, or as public recordings are known.

    Where one site alone is read, nothing is told apart by it, and what the source says holds.

    Args:
        pairs: as read.
        site: as for `cfx.data.sites.with_sites`.
        vehicle: as for `cfx.data.sites.with_vehicles`.

    Raises:
        DataError: a pattern does not fit.
    """
    if site is None and vehicle is None and len(set(pairs.sites)) > 1:
        return with_known_sites(pairs)
    return with_vehicles(with_sites(pairs, site), vehicle)


def with_known_sites(pairs: PairSet) -> PairSet:
    """Names the sites of public recordings, and the cars that are in several of them."""
    return pairs.changed(_at_known_site)


def with_known_types(pairs: PairSet) -> PairSet:
    """Says what drives the followers of public recordings, and their leaders, where they do not."""
    return pairs.changed(_of_known_type)


def _at_known_site(pair: Pair) -> Pair:
    recording = known_recording(pair.recording)
    if recording is None:
        return pair
    vehicle = pair.vehicle
    if not vehicle and recording.vehicle:
        match = re.search(recording.vehicle, pair.follower_id)
        if match is not None:
            vehicle = match[1]
    return replace(pair, site=recording.site, vehicle=vehicle)


def _of_known_type(pair: Pair) -> Pair:
    recording = known_recording(pair.recording)
    if recording is None or not recording.driver_type:
        return pair
    return replace(
        pair,
        driver_type=pair.driver_type or recording.driver_type,
        leader_driver_type=pair.leader_driver_type or recording.driver_type,
    )
