"""What the demonstration shows: pairs as they drove in SUMO."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx.pairs import Pair
from cfx.sumo.replay import CAR_LENGTH, FOLLOWERS

__all__ = ["CAR_LENGTH", "Shown", "evaluation_in_sumo"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shown:
    """One pair as it drove in SUMO; T frames of the recording, SI units.

    Attributes:
        drive: what the job evaluated in memory.
        pair: the recording.
        first: frame at which policy and default took over.
        scene: which pairs were on the road together.
        speed, gap: for each of `FOLLOWERS`, `(T,)`.
        place: for each of `FOLLOWERS`, `(T, 2, 3)`: x, y, heading (degrees, clockwise from north) of leader and follower.
        parameters: `(T, n)`, what the policy chose; NaN before it drives.
        table: of this pair, as in `demo_rmse.csv`.
    """

    drive: PairTrajectory
    pair: Pair
    first: int
    scene: int
    speed: dict[str, Array]
    gap: dict[str, Array]
    place: dict[str, Array]
    parameters: Array
    table: pd.DataFrame


def evaluation_in_sumo(evaluation: Evaluation, shown: Sequence[Shown]) -> Evaluation:
    """Returns a job's evaluation of the pairs that were shown, as they drove in SUMO instead of in memory."""
    methods = FOLLOWERS[1:]
    ids = [one.pair.pair_id for one in shown]
    about, values = evaluation.about, evaluation.values
    about = about[about["pair_id"].isin(ids) & about["method"].isin(methods)]
    values = values[values["pair_id"].isin(ids) & values["method"].isin(methods)].copy()
    found = pd.concat([one.table for one in shown]).set_index(["pair_id", "method"])
    for metric in ("rmse_speed", "rmse_gap"):
        rows = (values["metric"] == metric) & (values["scope"] == "test")
        places = pd.MultiIndex.from_frame(values.loc[rows, ["pair_id", "method"]])
        values.loc[rows, "value"] = found[f"{metric}_sumo"].reindex(places).to_numpy()
    return replace(
        evaluation,
        about=about.reset_index(drop=True),
        values=values,
        trajectories=tuple(_drive(one, methods) for one in shown),
    )


def _drive(one: Shown, methods: Sequence[str]) -> PairTrajectory:
    tested = slice(one.first, one.first + len(one.drive.time))
    parameters = {name: one.drive.parameters[name] for name in methods}
    chosen = one.parameters[tested]
    # What held on the way to each frame was chosen one frame before; at the first frame it is what holds next.
    parameters["policy"] = np.concatenate([chosen[:1], chosen[:-1]])
    return replace(
        one.drive,
        speed={name: one.speed[name][tested] for name in methods},
        gap={name: one.gap[name][tested] for name in methods},
        parameters=parameters,
    )
