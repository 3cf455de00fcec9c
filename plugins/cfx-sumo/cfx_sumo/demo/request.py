"""What the demonstration asks of a SUMO process: `cfx_sumo.demo.replay` documents the request."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from cfx import Pair, PairBatch, PairSet
from cfx.core.errors import DataError, SumoError
from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx.policies.agent import Agent
from cfx.policies.placement import ALL
from cfx_sumo.demo.channel import Message, receive, send
from cfx_sumo.demo.motorway import ABREAST, Motorway
from cfx_sumo.demo.replay import FOLLOWERS

log = logging.getLogger(__name__)

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

    base: str = "fixed"
    history: float | None = None

    @classmethod
    def of(cls, protocol: Mapping[str, Any]) -> PolicyKnowledge:
        """Reads a protocol's node; one that says nothing of it lets the policy know all."""
        base = str(protocol.get("base", "own"))
        return cls("fixed" if base == "own" else base, protocol.get("history"))

    def since(self, first: int, dt: float) -> int:
        """Returns the frame from which on the driver is known; `first` is that of the takeover."""
        if self.history is None:
            return 0
        return max(0, first - round(self.history / dt))


def fitting_pairs(pairs: PairSet, road: Motorway) -> dict[str, Pair]:
    """Returns the pairs that the road is long enough for, by their ids.

    Raises:
        DataError: there are none.
    """
    found = {}
    for pair in pairs:
        if _places(pair, road, 0) is not None:
            found[pair.pair_id] = pair
    if not found:
        shortest = min(_travelled(pair) for pair in pairs) + _BEGIN
        raise DataError(
            f"demo.osm: the motorway has {road.length:.0f} m, the pair with the shortest way takes"
            f" {shortest:.0f} m; name an extract with a longer road, or leave demo.osm out"
        )
    left_out = len(pairs) - len(found)
    if left_out:
        log.info("SUMO: %d pairs are not shown, as the motorway is too short for them", left_out)
    return found


def request_of(
    pairs: Sequence[Pair],
    trajectories: Sequence[PairTrajectory],
    road: Motorway,
    policy: Agent,
    evaluation: Evaluation,
    policy_folder: Path,
    *,
    knowledge: PolicyKnowledge,
) -> Message:
    """Returns the request for some pairs.

    Args:
        pairs: the recordings.
        trajectories: what a job evaluated of them.
        road: where the pairs are.
        policy, evaluation: the job's.
        policy_folder: where the policy is saved.
        knowledge: what the policy knew of each driver in the evaluation.
    """
    networks = _networks(evaluation, policy)
    requests, arrays = [], {}
    for number, pair in enumerate(pairs):
        request = _placed(number, pair, trajectories[number], road)
        first = request["first"]
        base = None
        if policy.base is not None:
            base = _base(evaluation, pair.pair_id, knowledge)
        request["network"] = networks[pair.pair_id]
        request["base"] = base
        request["driver_features"] = _driver_features(pair, first, policy, knowledge)
        request["renew"] = _renewed(first, policy, knowledge)
        requests.append(request)
        leader = [pair.leader_position, pair.leader_speed, pair.leader_acceleration]
        follower = [pair.follower_position, pair.follower_speed, pair.follower_acceleration]
        arrays[f"{number}/leader"] = np.stack(leader)
        arrays[f"{number}/follower"] = np.stack(follower)
    header: dict[str, Any] = {
        "dt": policy.dt,
        "net": str(road.net),
        "edges": road.edges,
        "tracks": road.tracks,
        "policy": str(policy_folder),
        "pairs": requests,
    }
    return Message(header, arrays)


def ask(request: Message) -> Message:
    """Has a SUMO process answer.

    Raises:
        SumoError: it cannot.
    """
    buffer = io.BytesIO()
    send(buffer, request.header, request.arrays)
    settings = {"OMP_NUM_THREADS": "1", "LIBSUMO_AS_TRACI": "quiet"}
    done = subprocess.run(
        [sys.executable, "-m", "cfx_sumo.demo.replay"],
        input=buffer.getvalue(),
        capture_output=True,
        env=os.environ | settings,
        check=False,
    )
    answer = receive(io.BytesIO(done.stdout))
    said = done.stderr.decode(errors="replace").strip().splitlines()
    if answer is None:
        reason = said[-1] if said else "no reason given"
        raise SumoError(
            f"the SUMO process ended by itself with exit code {done.returncode}: {reason}"
        )
    if "error" in answer.header:
        raise _failure(answer.header["error"], answer.header["bug"], said)
    return answer


def _failure(error: str, bug: str, said: Sequence[str]) -> Exception:
    """Returns what failed in a SUMO process: the user's mistake in one sentence, or a bug."""
    if bug:
        return RuntimeError(f"{bug} in the SUMO process: {error}")
    # SUMO prints a reason more than once.
    reasons = {error: None}
    for line in said:
        if line.startswith("Error:"):
            reasons[line.removeprefix("Error:").strip()] = None
    return SumoError(" ".join(": ".join(reasons).split()))


def _networks(evaluation: Evaluation, policy: Agent) -> dict[str, str]:
    """Returns which of the policy's networks each pair was evaluated with."""
    table = evaluation.table.drop_duplicates("pair_id").set_index("pair_id")
    found = {}
    for pair_id in [trajectory.pair_id for trajectory in evaluation.trajectories]:
        candidates = [pair_id, ALL, policy.names[0]]
        if "fold" in table and pd.notna(table["fold"][pair_id]):
            candidates.insert(0, f"fold {int(table['fold'][pair_id])}")
        found[pair_id] = next(name for name in candidates if name in policy.names)
    return found


def _base(
    evaluation: Evaluation, pair_id: str, knowledge: PolicyKnowledge
) -> dict[str, float] | None:
    """Returns the parameters that the policy's offsets started from for a pair."""
    table = evaluation.table
    row = table[(table["pair_id"] == pair_id) & (table["method"] == knowledge.base)]
    if not len(row):
        return None
    base = {}
    for name in evaluation.names:
        base[name] = float(row[f"parameter_{name}"].iloc[0])
    return base


def _driver_features(
    pair: Pair, first: int, policy: Agent, knowledge: PolicyKnowledge
) -> dict[str, float] | None:
    """Returns the driver features that the policy was given of a pair's driver."""
    until = torch.tensor([first])
    since = torch.tensor([knowledge.since(first, policy.dt)])
    batch = PairBatch.of(PairSet((pair,), pair.recording))
    features = policy.driver_features_of(batch, until, since)
    if features is None or bool(features.isnan().any()):
        return None
    return dict(zip(policy.policy.driver_features, features[0].tolist(), strict=True))


def _renewed(first: int, policy: Agent, knowledge: PolicyKnowledge) -> int:
    """Returns the frame from which on the policy remembers: the first full window of burn-in."""
    stride = policy.windows.stride
    windows = -(-knowledge.since(first, policy.dt) // stride)
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
    for begin in np.arange(_BEGIN, road.length - travelled, 1.0).tolist():
        leader, follower = road.place(track, begin + ahead), road.place(track, begin)
        if leader is not None and follower is not None:
            return [leader, follower]
    return None
