"""`demo=sumo`: a job's trajectories on a motorway in SUMO.

It writes into the folder `sumo` of the job's: `demo.html` (an animation, complete in
itself), `demo.png`, `demo_drives.png` (speeds and gaps), `demo_rmse.csv` (SUMO beside memory) and
`motorway.net.xml`.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
from pydantic import Field

from cfx.plugin import DEMO_PAGE, Agent, Demo, Evaluation, PairSet, Settings, files
from cfx_sumo.demo.motorway import read_motorway
from cfx_sumo.demo.simulated import (
    FinishedJob,
    PolicyKnowledge,
    SimulatedPair,
    evaluation_in_sumo,
    fitting_pairs,
    simulate_in_sumo,
)
from cfx_sumo.installed import require_sumo

log = logging.getLogger(__name__)


class SumoDemoSettings(Settings):
    """Settings of `sumo`."""

    osm: Path | None = Field(
        None,
        description="an OpenStreetMap extract of your own (.osm.xml), or a SUMO network"
        " (.net.xml); null: a hand-made motorway",
    )
    pairs: int = Field(
        6, ge=1, description="pairs at most, spread evenly from the best to the worst improvement"
    )


class SumoDemo(Demo):
    """Recorded leaders on a motorway in SUMO, each ahead of three followers.

    The followers are the recorded driver, the policy and the default parameters. Open
    `sumo/demo.html` in the job's folder.
    """

    schema: ClassVar[type[Settings]] = SumoDemoSettings
    settings: SumoDemoSettings
    trial: ClassVar[Mapping[str, Any]] = {"pairs": 2}

    def check(self, pairs: PairSet) -> None:
        """Refuses what cannot be shown.

        Raises:
            SumoError: SUMO or its netconvert is missing.
            DataError: the road is not there, has too few lanes, or is too short for every pair.
        """
        require_sumo()
        with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as folder:
            fitting_pairs(pairs, read_motorway(self.settings.osm, Path(folder)))

    def write(
        self,
        folder: Path,
        pairs: PairSet,
        policy: Agent,
        evaluation: Evaluation,
        protocol: Mapping[str, Any],
    ) -> list[Path]:
        """Simulates in SUMO what a job has evaluated, and shows it.

        Raises:
            SumoError: SUMO is missing, or lost a vehicle.
            DataError: the road is too short, or no road.
            OSError: the folder cannot be written.
        """
        from cfx_sumo.demo.page import write_page
        from cfx_sumo.demo.picture import write_pictures

        knowledge = PolicyKnowledge.of(protocol)
        job = FinishedJob(pairs, policy, evaluation, folder.with_name("policy"), knowledge)
        with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as scratch:
            road = read_motorway(self.settings.osm, Path(scratch))
            simulated = simulate_in_sumo(job, road, self.settings.pairs)
            with files.atomic_write(folder / "motorway.net.xml") as partial:
                shutil.copyfile(road.net, partial)
        _write_errors(folder / "demo_rmse.csv", simulated)
        in_sumo = evaluation_in_sumo(evaluation, simulated)
        pictures = write_pictures(folder, road, simulated, in_sumo)
        page = write_page(folder / DEMO_PAGE, road, simulated, in_sumo, policy, pairs.source)
        return [page, *pictures, folder / "demo_rmse.csv", folder / "motorway.net.xml"]


def _write_errors(path: Path, simulated: Sequence[SimulatedPair]) -> None:
    """Writes the errors of the pairs in SUMO beside those in memory."""
    table = pd.concat([drive.table for drive in simulated], ignore_index=True)
    with files.atomic_write(path) as partial:
        table.to_csv(partial, index=False)
    log.info(
        "SUMO: %d pairs as in memory; largest difference of a speed %.1g m/s, of a gap %.1g m",
        len(simulated),
        table["difference_speed"].max(),
        table["difference_gap"].max(),
    )
