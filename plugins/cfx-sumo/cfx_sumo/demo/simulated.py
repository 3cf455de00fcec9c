"""A job's pairs, simulated anew on a motorway in SUMO."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from cfx.errors import DataError, SumoError
from cfx.plugin import (
    ANY_DRIVER,
    Agent,
    Evaluation,
    Pair,
    PairBatch,
    PairSet,
    PairTrajectory,
    driver_features_of,
    pair_lines,
    worker_pool,
)
from cfx_sumo.demo.motorway import ABREAST, Motorway
from cfx_sumo.demo.replay import FOLLOWERS, ReplayRequest, replay
from cfx_sumo.installed import require_sumo
from cfx_sumo.simulation.worker import begin

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_BEGIN = 30.0
"""m from the road's begin to where followers enter."""


@dataclass(frozen=True)
class PolicyKnowledge:
    """What a protocol lets the policy know of a driver before it takes over.

    Attributes:
        base: the method whose parameters a policy of offsets starts from.
        history: s of the driver's recorded trajectory that the policy is fed with; None: all there
            is.
    """

    base: str = "driver_specific"
    history: float | None = None

    @classmethod
    def of(cls, protocol: Mapping[str, Any]) -> PolicyKnowledge:
        """Reads a protocol's node; one that says nothing of it lets the policy know all."""
        base = str(protocol.get("base", "driver_specific"))
        return cls("driver_specific" if base == "own" else base, protocol.get("history"))

    def since(self, first: int, dt: float) -> int:
        """Returns the frame from which on the driver is known; `first` is that of the takeover."""
        if self.history is None:
            return 0
        return max(0, first - round(self.history / dt))


@dataclass(frozen=True)
class FinishedJob:
    """What is shown.

    Attributes:
        pairs, policy, evaluation: the job's.
        policy_folder: where its policy is saved.
        knowledge: what the policy knew of each driver in the evaluation.
    """

    pairs: PairSet
    policy: Agent
    evaluation: Evaluation
    policy_folder: Path
    knowledge: PolicyKnowledge


@dataclass(frozen=True)
class SimulatedPair:
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


def simulate_in_sumo(job: FinishedJob, road: Motorway, count: int) -> list[SimulatedPair]:
    """Simulates some pairs of a job in SUMO, in a process of its own.

    Args:
        job: whose pairs.
        road: where the pairs are.
        count: pairs at most; they are spread evenly from the best to the worst improvement.

    Raises:
        SumoError: SUMO is missing, or lost a vehicle.
        DataError: the road is too short.
    """
    require_sumo()
    by_id = fitting_pairs(job.pairs, road)
    available = []
    for trajectory in job.evaluation.trajectories:
        if trajectory.pair_id in by_id:
            available.append(trajectory)
    chosen = _choose(available, job.evaluation.table, count)
    pairs = [by_id[trajectory.pair_id] for trajectory in chosen]
    request = _request(job, pairs, chosen, road)
    answer = ask(request)
    simulated = []
    for number, trajectory in enumerate(chosen):
        about = request.header["pairs"][number]
        simulated.append(_simulated_pair(number, trajectory, pairs[number], about, answer))
    return simulated


def _choose(
    trajectories: Sequence[PairTrajectory], table: pd.DataFrame, count: int
) -> list[PairTrajectory]:
    """Returns some pairs spread evenly from the best to the worst improvement."""
    policy = table[table["method"] == "policy"].set_index("pair_id")
    improvement = policy["improvement_over_driver_specific"].astype(float).fillna(-np.inf).to_dict()
    ranked = sorted(
        trajectories, key=lambda trajectory: -improvement.get(trajectory.pair_id, -np.inf)
    )
    # A demonstration of one pair shows the best.
    places = pair_lines.evenly_spread(len(ranked), count) if count > 1 else [0]
    return [ranked[place] for place in places]


def fitting_pairs(pairs: PairSet, road: Motorway) -> dict[str, Pair]:
    """Returns the pairs that the road is long enough for, by their ids.

    Raises:
        DataError: there are none.
    """
    fitting = {}
    for pair in pairs:
        if _places(pair, road, 0) is not None:
            fitting[pair.pair_id] = pair
    if not fitting:
        shortest = min(_travelled(pair) for pair in pairs) + _BEGIN
        raise DataError(
            f"demo.osm: the motorway has {road.length:.0f} m, the pair with the shortest way takes"
            f" {shortest:.0f} m; name an extract with a longer road, or leave demo.osm out"
        )
    left_out = len(pairs) - len(fitting)
    if left_out:
        log.info("SUMO: %d pairs are not shown, as the motorway is too short for them", left_out)
    return fitting


def ask(request: ReplayRequest) -> dict[str, Array]:
    """Has a SUMO process answer; `replay` says what.

    Raises:
        CfxError: it cannot.
    """
    with tempfile.TemporaryDirectory(prefix="cfx-sumo-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        pool = worker_pool(1, begin, folder, folder=folder)
        try:
            answer: dict[str, Array] = pool.submit(replay, request).result()
        except BrokenProcessPool as error:
            reason = str(error).partition("\n")[0]
            raise SumoError(f"the SUMO process ended by itself ({reason})") from error
        finally:
            pool.shutdown(wait=True, kill_workers=True)
    return answer


def _request(
    job: FinishedJob,
    pairs: Sequence[Pair],
    trajectories: Sequence[PairTrajectory],
    road: Motorway,
) -> ReplayRequest:
    """Returns the request for some pairs, of which `trajectories` are the job's."""
    networks = _networks(job.evaluation, job.policy)
    requests, arrays = [], {}
    for number, pair in enumerate(pairs):
        request = _placed(number, pair, trajectories[number], road)
        first = request["first"]
        request["network"] = networks[pair.pair_id]
        request["base"] = _base(job, pair.pair_id)
        request["driver_features"] = _driver_features(job, pair, first)
        request["renew"] = _renewed(job, first)
        requests.append(request)
        leader = [pair.leader_position, pair.leader_speed, pair.leader_acceleration]
        follower = [pair.follower_position, pair.follower_speed, pair.follower_acceleration]
        arrays[f"{number}/leader"] = np.stack(leader)
        arrays[f"{number}/follower"] = np.stack(follower)
    header: dict[str, Any] = {
        "dt": job.policy.dt,
        "net": str(road.net),
        "edges": road.edges,
        "tracks": road.tracks,
        "policy": str(job.policy_folder),
        "pairs": requests,
    }
    return ReplayRequest(header, arrays)


def _networks(evaluation: Evaluation, policy: Agent) -> dict[str, str]:
    """Returns which of the policy's networks each pair was evaluated with."""
    table = evaluation.table.drop_duplicates("pair_id").set_index("pair_id")
    networks = {}
    for pair_id in [trajectory.pair_id for trajectory in evaluation.trajectories]:
        candidates = [pair_id, ANY_DRIVER, policy.names[0]]
        if "fold" in table and pd.notna(table["fold"][pair_id]):
            candidates.insert(0, f"fold {int(table['fold'][pair_id])}")
        networks[pair_id] = next(name for name in candidates if name in policy.names)
    return networks


def _base(job: FinishedJob, pair_id: str) -> dict[str, float] | None:
    """Returns the parameters that the policy's offsets started from for a pair."""
    if job.policy.base is None:
        return None
    table = job.evaluation.table
    row = table[(table["pair_id"] == pair_id) & (table["method"] == job.knowledge.base)]
    if not len(row):
        return None
    base = {}
    for name in job.evaluation.names:
        base[name] = float(row[f"parameter_{name}"].iloc[0])
    return base


def _driver_features(job: FinishedJob, pair: Pair, first: int) -> dict[str, float] | None:
    """Returns the driver features that the policy was given of a pair's driver."""
    until = torch.tensor([first])
    since = torch.tensor([job.knowledge.since(first, job.policy.dt)])
    batch = PairBatch.of(PairSet((pair,), pair.recording))
    features = driver_features_of(job.policy, batch, until, since)
    if features is None or bool(features.isnan().any()):
        return None
    return dict(zip(job.policy.core.driver_features, features[0].tolist(), strict=True))


def _renewed(job: FinishedJob, first: int) -> int:
    """Returns the frame from which on the policy remembers: the first full window of burn-in."""
    stride = job.policy.windows.stride
    windows = -(-job.knowledge.since(first, job.policy.dt) // stride)
    return min(first, windows * stride)


def _placed(number: int, pair: Pair, trajectory: PairTrajectory, road: Motorway) -> dict[str, Any]:
    """Returns where and when a pair is in SUMO."""
    scene, side = divmod(number, len(road.tracks) // ABREAST)
    tracks, places = {}, {}
    for k, kind in enumerate(FOLLOWERS):
        # Tracks are numbered from the right; the recorded follower comes first from the left.
        tracks[kind] = len(road.tracks) - 1 - ABREAST * side - k
        places[kind] = _places(pair, road, tracks[kind])
    return {
        "scene": scene,
        "length": pair.leader_length,
        "first": round(float(trajectory.time[0]) / pair.dt),
        "track": tracks,
        "places": places,
    }


def _travelled(pair: Pair) -> float:
    """Returns how much road a pair takes from the follower's begin, m."""
    end = max(pair.leader_position.max(), pair.follower_position.max())
    return float(end - pair.follower_position[0])


def _places(pair: Pair, road: Motorway, track: int) -> list[tuple[int, float]] | None:
    """Returns where leader and follower enter, edge and position; None if the road is too short.

    No vehicle can enter inside a junction, so they may begin a little later.
    """
    ahead, travelled = float(pair.leader_position[0] - pair.follower_position[0]), _travelled(pair)
    for start in np.arange(_BEGIN, road.length - travelled, 1.0).tolist():
        leader, follower = road.place(track, start + ahead), road.place(track, start)
        if leader is not None and follower is not None:
            return [leader, follower]
    return None


def _simulated_pair(
    number: int,
    trajectory: PairTrajectory,
    pair: Pair,
    request: Mapping[str, Any],
    answer: Mapping[str, Array],
) -> SimulatedPair:
    """Returns one pair of a SUMO process's answer.

    Args:
        number: which pair of the request.
        trajectory: what the job evaluated of it in memory.
        pair: the recording.
        request: what was asked of the pair.
        answer: of the process.
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
    return SimulatedPair(
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


def evaluation_in_sumo(evaluation: Evaluation, simulated: Sequence[SimulatedPair]) -> Evaluation:
    """Returns a job's evaluation of the simulated pairs, with SUMO's trajectories and errors."""
    methods = FOLLOWERS[1:]
    ids = [drive.pair.pair_id for drive in simulated]
    about, values = evaluation.about, evaluation.values
    about = about[about["pair_id"].isin(ids) & about["method"].isin(methods)]
    values = values[values["pair_id"].isin(ids) & values["method"].isin(methods)].copy()
    in_sumo = pd.concat([drive.table for drive in simulated]).set_index(["pair_id", "method"])
    for metric in ("rmse_speed", "rmse_gap"):
        rows = (values["metric"] == metric) & (values["scope"] == "test")
        places = pd.MultiIndex.from_frame(values.loc[rows, ["pair_id", "method"]])
        values.loc[rows, "value"] = in_sumo[f"{metric}_sumo"].reindex(places).to_numpy()
    return replace(
        evaluation,
        about=about.reset_index(drop=True),
        values=values,
        trajectories=tuple(_test_part(drive, methods) for drive in simulated),
    )


def _errors(name: str, memory: Array, sumo: Array, measured: Array) -> dict[str, float]:
    return {
        f"rmse_{name}_memory": _rmse(memory - measured),
        f"rmse_{name}_sumo": _rmse(sumo - measured),
        f"difference_{name}": float(np.abs(sumo - memory).max()),
    }


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def _test_part(one: SimulatedPair, methods: Sequence[str]) -> PairTrajectory:
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
