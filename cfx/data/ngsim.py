"""NGSIM's own files: vehicle trajectories at 10 Hz, in feet.

U.S. Department of Transportation, Federal Highway Administration: *Next Generation Simulation
(NGSIM) Vehicle Trajectories and Supporting Data*, data.transportation.gov, dataset 8ect-6jqj. In
the public domain.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from cfx.core.component import Settings
from cfx.core.errors import DataError
from cfx.data.base import Contents, Dataset, FileDatasetSettings, joined
from cfx.data.files import FileStart, stem
from cfx.data.ngsim_rows import Rows, read_ngsim
from cfx.data.pairs import PairSet

log = logging.getLogger(__name__)


class NgsimSettings(FileDatasetSettings):
    """Settings of the NGSIM reader."""

    location: str | None = Field(
        None,
        description="keep this location of a multi-location export alone (i-80, us-101); null: all",
    )
    trim: float = Field(
        0.0,
        ge=0,
        description="s: leave so much out at both ends of each vehicle's rows, where smoothing has"
        " left artefacts in its speeds",
    )


class NgsimDataset(Dataset):
    """Pairs from a file as NGSIM publishes it.

    The file has 18 columns (arterials: 24) without a header, or is CSV with one; gzip is fine.

    **A pair** is a maximal run of consecutive frames in which one vehicle has the same leader
    (`Preceding`) in the same lane. Only frames count at which the leader's own row exists, in the
    same lane, with its rear bumper ahead of the follower's front; any other frame ends the run and
    is counted. Positions are `Local_Y`, speeds and accelerations `v_Vel` and `v_Acc` as recorded;
    1 ft = 0.3048 m exactly. Runs of a single frame are no pairs.

    **Recordings.** A file may hold several, in which vehicle ids and frames start anew. Each row's
    `Global_Time - 100 ms * Frame_ID` is the instant at which its recording's frame 0 lies, the same
    for all its rows: rows whose instants differ by more than a minute are of different recordings,
    even if these overlap in time. They are named `LOCATION-1`, `LOCATION-2` in order of time
    (`LOCATION` if there is one alone; the file's name stands in where there is no `Location`
    column). Without a usable clock (no `Global_Time`, or one that a spreadsheet has rounded) each
    location counts as one recording.

    **Several files** hold several recordings, as NGSIM's own downloads do. Where two of them call
    theirs alike, as all three of I-80 are `i-80`, the file's name is put before the recording's.

    **Boundary artefacts of smoothing** (M. Montanino and V. Punzo 2015, Trajectory data
    reconstruction and simulation-based validation against macroscopic traffic patterns,
    Transportation Research Part B 80, treat the errors of these recordings). In NGSIM's I-80 as
    published, vehicles seem to speed up by some 1 m/s2 during the first three seconds of their
    rows, and to slow down as much during the last three: all of them, wherever they are, as
    smoothing over too few rows does. A driver who follows such a leader seems to foresee it, and a
    policy learns that. Where a file is like that, the log says so; `trim=3` leaves these rows out,
    and counts them.

    **Duplicates.** Rows that agree in every column read here are counted and dropped, as real
    exports hold some; rows that contradict each other are an error.

    In the opposite direction of an arterial `Local_Y` decreases; such frames count as "leader
    behind its follower".
    """

    layout = "NGSIM (feet)"
    schema: ClassVar[type[Settings]] = NgsimSettings
    settings: NgsimSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:
        plain = {re.sub(r"[^a-z]", "", name.lower()) for name in start.columns}
        return len(plain & {"vehicleid", "frameid", "localy", "vvel"}) >= 2

    def read(self) -> PairSet:
        return self._pairs(self._rows())

    def contents(self) -> Contents:
        files = self._rows()
        problems = [rows.boundary_artefacts() for rows in files]
        return Contents(
            self._pairs(files),
            sum(rows.rows_read for rows in files),
            sum(rows.vehicles for rows in files),
            "; ".join(problem for problem in problems if problem),
        )

    def _rows(self) -> list[Rows]:
        """Returns the rows of each file."""
        return [read_ngsim(path, self.settings.location) for path in self.settings.files()]

    def _pairs(self, files: Sequence[Rows]) -> PairSet:
        parts = []
        for rows in _with_different_names(files):
            if self.settings.trim:
                parts.append(rows.trimmed(self.settings.trim).pairs())
                continue
            artefacts = rows.boundary_artefacts()
            if artefacts:
                log.info("%s: %s", rows.source, artefacts)
            parts.append(rows.pairs())
        return joined(parts)


def _with_different_names(parts: Sequence[Rows]) -> list[Rows]:
    """Returns the rows of several files; no two recordings have the same name.

    Vehicles' ids start anew in each recording.

    Raises:
        DataError: two of the files are named alike, too.
    """
    counts: Counter[str] = Counter()
    for rows in parts:
        counts.update(rows.recordings)
    files: dict[str, str] = {}
    result = []
    for rows in parts:
        own = []
        for recording in rows.recordings:
            name = _name_in(rows, recording, is_shared=counts[recording] > 1)
            if name in files:
                raise DataError(
                    f"{files[name]} and {rows.source}: both recordings would be called '{name}';"
                    " rename one of the files"
                )
            own.append(name)
        files |= dict.fromkeys(own, rows.source)
        result.append(replace(rows, recordings=tuple(own)))
    return result


def _name_in(rows: Rows, name: str, *, is_shared: bool) -> str:
    """Returns a recording's name; the file's stands before one that several files share."""
    file = stem(Path(rows.source))
    if not is_shared:
        return name
    if name == file:
        return file
    return f"{file}-{name}"
