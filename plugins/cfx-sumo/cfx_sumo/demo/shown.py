"""What the demonstration shows: pairs as they were simulated in SUMO."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx import Pair
from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx_sumo.demo.replay import FOLLOWERS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shown:
    """One pair as it was simulated in SUMO; T frames of the recording, SI units.

    Attributes:
        trajectory: what the job evaluated in memory.
        pair: the recording.
        first: frame at which policy and default took over.
        scene: which pairs were on the road together.
        speed, gap: for each of `FOLLOWERS`, `(T,)`.
        place: for each of `FOLLOWERS`, `(T, 2, 3)`: x, y, heading (degrees, clockwise from north)
            of leader and follower.
        parameters: `(T, n)`, what the policy chose; NaN before it takes over.
        table: of this pair, as in `demo_rmse.csv`.
    """

    trajectory: PairTrajectory
    pair: Pair
    first: int
    scene: int
    speed: dict[str, Array]
    gap: dict[str, Array]
    place: dict[str, Array]
    parameters: Array
    table: pd.DataFrame


def shown_pair(
    number: int,
    trajectory: PairTrajectory,
    pair: Pair,
    request: Mapping[str, Any],
    answer: Mapping[str, Array],
) -> Shown:
    """Returns one pair of a SUMO process's answer.

    Args:
        number: which pair of the request.
        trajectory: what the job evaluated of it in memory.
        pair: the recording.
        request: what was asked of the pair.
        answer: of the process, as `cfx_sumo.demo.replay` documents.
    """
    first = int(request["first"])
    speed, gap, place = {}, {}, {}
    for kind in FOLLOWERS:
        motion = answer[f"{number}/{kind}/motion"]
        speed[kind], gap[kind] = motion[:, 0], motion[:, 1]
        place[kind] = answer[f"{number}/{kind}/place"]
    tested = slice(first + 1, first + len(trajectory.time))
    rows = []
    for method in FOLLOWERS[1:]:
        row: dict[str, Any] = {
            "pair_id": pair.pair_id,
            "method": method,
            "frames": len(trajectory.time) - 1,
        }
        in_sumo = speed[method][tested]
        row |= _errors("speed", trajectory.speed[method][1:], in_sumo, pair.follower_speed[tested])
        in_sumo = gap[method][tested]
        row |= _errors("gap", trajectory.gap[method][1:], in_sumo, pair.gap[tested])
        row["collisions_sumo"] = int((in_sumo < 0).any())
        rows.append(row)
    return Shown(
        trajectory=trajectory,
        pair=pair,
        first=first,
        scene=request["scene"],
        speed=speed,
        gap=gap,
        place=place,
        parameters=answer[f"{number}/parameters"],
        table=pd.DataFrame(rows),
    )


def evaluation_in_sumo(evaluation: Evaluation, shown: Sequence[Shown]) -> Evaluation:
    """Returns a job's evaluation of the shown pairs, with SUMO's trajectories and errors."""
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
        trajectories=tuple(_test_part(one, methods) for one in shown),
    )


def _errors(name: str, memory: Array, sumo: Array, measured: Array) -> dict[str, float]:
    return {
        f"rmse_{name}_memory": _rmse(memory - measured),
        f"rmse_{name}_sumo": _rmse(sumo - measured),
        f"difference_{name}": float(np.abs(sumo - memory).max()),
    }


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def _test_part(one: Shown, methods: Sequence[str]) -> PairTrajectory:
    """Returns the test part of a pair as it was simulated in SUMO."""
    tested = slice(one.first, one.first + len(one.trajectory.time))
    speed, gap, parameters = {}, {}, {}
    for method in methods:
        speed[method], gap[method] = one.speed[method][tested], one.gap[method][tested]
        parameters[method] = one.trajectory.parameters[method]
    # What held on the way to a frame was chosen one frame before; at the first frame it is what
    # holds next.
    chosen = one.parameters[tested]
    parameters["policy"] = np.concatenate([chosen[:1], chosen[:-1]])
    return replace(one.trajectory, speed=speed, gap=gap, parameters=parameters)
