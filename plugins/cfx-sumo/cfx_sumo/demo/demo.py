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

import numpy as np
import pandas as pd
from pydantic import Field

from cfx import Demo, PairSet, Settings
from cfx.core.files import atomic_write
from cfx.evaluation.demo import PAGE
from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx.policies.agent import Agent
from cfx.report.figures.pairs import evenly_spread
from cfx_sumo.demo.motorway import Motorway, read_motorway
from cfx_sumo.demo.request import PolicyKnowledge, ask, fitting_pairs, request_of
from cfx_sumo.demo.shown import Shown, evaluation_in_sumo, shown_pair
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
        policy_folder = folder.with_name("policy")
        count = self.settings.pairs
        with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as scratch:
            road = read_motorway(self.settings.osm, Path(scratch))
            shown = simulate_in_sumo(
                policy_folder, pairs, policy, evaluation, road, count, knowledge=knowledge
            )
            with atomic_write(folder / "motorway.net.xml") as partial:
                shutil.copyfile(road.net, partial)
        _write_errors(folder / "demo_rmse.csv", shown)
        in_sumo = evaluation_in_sumo(evaluation, shown)
        pictures = write_pictures(folder, road, shown, in_sumo)
        page = write_page(folder / PAGE, road, shown, in_sumo, policy, pairs.source)
        return [page, *pictures, folder / "demo_rmse.csv", folder / "motorway.net.xml"]


def simulate_in_sumo(
    policy_folder: Path,
    pairs: PairSet,
    policy: Agent,
    evaluation: Evaluation,
    road: Motorway,
    count: int,
    *,
    knowledge: PolicyKnowledge,
) -> list[Shown]:
    """Simulates some pairs in SUMO, in a process of its own.

    Args:
        policy_folder: where the policy is saved.
        pairs, policy, evaluation: a job's.
        road: where the pairs are.
        count: pairs at most; they are spread evenly from the best to the worst improvement.
        knowledge: what the policy knew of each driver in the evaluation.

    Raises:
        SumoError: SUMO is missing, or lost a vehicle.
        DataError: the road is too short.
    """
    require_sumo()
    by_id = fitting_pairs(pairs, road)
    available = []
    for trajectory in evaluation.trajectories:
        if trajectory.pair_id in by_id:
            available.append(trajectory)
    chosen = _choose(available, evaluation.table, count)
    chosen_pairs = [by_id[trajectory.pair_id] for trajectory in chosen]
    request = request_of(
        chosen_pairs, chosen, road, policy, evaluation, policy_folder, knowledge=knowledge
    )
    answer = ask(request).arrays
    shown = []
    for number, trajectory in enumerate(chosen):
        about = request.header["pairs"][number]
        shown.append(shown_pair(number, trajectory, chosen_pairs[number], about, answer))
    return shown


def _write_errors(path: Path, shown: Sequence[Shown]) -> None:
    """Writes the errors of the pairs in SUMO beside those in memory."""
    table = pd.concat([one.table for one in shown], ignore_index=True)
    with atomic_write(path) as partial:
        table.to_csv(partial, index=False)
    log.info(
        "SUMO: %d pairs as in memory; largest difference of a speed %.1g m/s, of a gap %.1g m",
        len(shown),
        table["difference_speed"].max(),
        table["difference_gap"].max(),
    )


def _choose(
    trajectories: Sequence[PairTrajectory], table: pd.DataFrame, count: int
) -> list[PairTrajectory]:
    """Returns some pairs spread evenly from the best to the worst improvement."""
    policy = table[table["method"] == "policy"].set_index("pair_id")
    improvement = policy["improvement"].astype(float).fillna(-np.inf).to_dict()
    ranked = sorted(
        trajectories, key=lambda trajectory: -improvement.get(trajectory.pair_id, -np.inf)
    )
    # A demonstration of one pair shows the best.
    places = evenly_spread(len(ranked), count) if count > 1 else [0]
    return [ranked[place] for place in places]
