"""The demonstration: recorded leaders drive on a motorway in SUMO, and behind each the real follower, the policy and the default.

It follows a job and writes into the folder `sumo` of the job's: `demo.html` (an animation, complete in itself), `demo.png`,
`demo_drives.png` (speeds and gaps), `demo_rmse.csv` (SUMO beside memory) and `motorway.net.xml`.
"""

from __future__ import annotations

import io
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

import cfx
from cfx.agents.agent import Agent
from cfx.agents.placement import ALL
from cfx.config import DemoSettings, JobConfig
from cfx.errors import DataError, SumoError
from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx.files import atomic_write
from cfx.pairs import Pair, PairBatch, PairSet
from cfx.simulators.sumo.channel import Message, receive, send
from cfx.simulators.sumo.installed import require_sumo
from cfx.sumo.motorway import ABREAST, Motorway, read_motorway
from cfx.sumo.replay import FOLLOWERS
from cfx.sumo.shown import Array, Shown, evaluation_in_sumo

log = logging.getLogger(__name__)

_BEGIN = 30.0
"""m from the road's begin to where followers enter."""


def check_demo(settings: DemoSettings, pairs: PairSet) -> None:
    """Refuses what the demonstration cannot do, before a job begins its work.

    Raises:
        SumoError: SUMO or its netconvert is missing.
        DataError: the road is not there, has too few lanes, or is too short for every pair.
    """
    require_sumo()
    with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as folder:
        _fitting(pairs, read_motorway(settings.osm, Path(folder)))


def write_demo(
    folder: Path,
    policy_folder: Path,
    pairs: PairSet,
    policy: Agent,
    evaluation: Evaluation,
    config: JobConfig,
) -> list[Path]:
    """Drives in SUMO what a job has evaluated, and shows it.

    Args:
        folder: where the files go; made if it is not there.
        policy_folder: where the job has saved its policy.
        pairs, policy, evaluation: the job's.
        config: the job's: which road, how many pairs, and what the policy knew of each driver.

    Returns:
        The files.

    Raises:
        SumoError: SUMO is missing, or lost a vehicle.
        DataError: the road is too short, or no road.
        OSError: the folder cannot be written.
    """
    from cfx.sumo.demo_page import write_page
    from cfx.sumo.demo_picture import write_pictures

    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="cfx-sumo-") as scratch:
        road = read_motorway(config.demo.osm, Path(scratch))
        shown = drive_in_sumo(
            policy_folder,
            pairs,
            policy,
            evaluation,
            road,
            config.demo.pairs,
            known=Known.of(config.protocol),
        )
        with atomic_write(folder / "motorway.net.xml") as partial:
            shutil.copyfile(road.net, partial)
    table = pd.concat([one.table for one in shown], ignore_index=True)
    with atomic_write(folder / "demo_rmse.csv") as partial:
        table.to_csv(partial, index=False)
    log.info(
        "SUMO: %d pairs drove as in memory; largest difference of a speed %.1g m/s, of a gap %.1g m",
        len(shown),
        table["difference_speed"].max(),
        table["difference_gap"].max(),
    )
    in_sumo = evaluation_in_sumo(evaluation, shown)
    pictures = write_pictures(folder, road, shown, in_sumo)
    page = write_page(folder / "demo.html", road, shown, in_sumo, policy, pairs.source)
    return [page, *pictures, folder / "demo_rmse.csv", folder / "motorway.net.xml"]


@dataclass(frozen=True)
class Known:
    """What a protocol lets the policy know of a driver before it drives as him.

    Attributes:
        base: the method whose parameters a policy of offsets starts from.
        history: s of his recorded drive that the policy reads; None: all there is.
    """

    base: str = "fixed"
    history: float | None = None

    @classmethod
    def of(cls, protocol: Mapping[str, Any]) -> Known:
        """Reads a protocol's node; one that says nothing of it lets the policy know all."""
        base = str(protocol.get("base", "own"))
        return cls("fixed" if base == "own" else base, protocol.get("history"))


def drive_in_sumo(
    policy_folder: Path,
    pairs: PairSet,
    policy: Agent,
    evaluation: Evaluation,
    road: Motorway,
    count: int,
    *,
    known: Known = Known(),
) -> list[Shown]:
    """Drives some pairs in SUMO, in a process of its own.

    Args:
        policy_folder: where the policy is saved.
        pairs, policy, evaluation: a job's.
        road: where they drive.
        count: pairs at most; they are spread evenly from the best to the worst improvement.
        known: what the policy knew of each driver in the evaluation.

    Raises:
        SumoError: SUMO is missing, or lost a vehicle.
        DataError: the road is too short.
    """
    require_sumo()
    by_id = _fitting(pairs, road)
    chosen = _choose(
        [drive for drive in evaluation.trajectories if drive.pair_id in by_id],
        evaluation.table,
        count,
    )
    networks = _networks(evaluation, policy)
    header: dict[str, Any] = {
        "dt": policy.dt,
        "net": str(road.net),
        "edges": road.edges,
        "tracks": road.tracks,
        "policy": str(policy_folder),
        "pairs": [],
    }
    arrays = {}
    for number, drive in enumerate(chosen):
        pair = by_id[drive.pair_id]
        base = _base(evaluation, pair.pair_id, known) if policy.base is not None else None
        request = _request(number, pair, drive, road) | {
            "network": networks[pair.pair_id],
            "base": base,
        }
        driver_features = _driver_features(pair, request["first"], policy, known)
        header["pairs"].append(
            request
            | {
                "driver_features": driver_features,
                "renew": _renewed(request["first"], policy, known),
            }
        )
        arrays[f"{number}/leader"] = np.stack(
            [pair.leader_position, pair.leader_speed, pair.leader_acceleration]
        )
        arrays[f"{number}/follower"] = np.stack(
            [pair.follower_position, pair.follower_speed, pair.follower_acceleration]
        )
    found = _ask(Message(header, arrays)).arrays
    return [
        _shown(number, drive, by_id[drive.pair_id], header["pairs"][number], found)
        for number, drive in enumerate(chosen)
    ]


def _fitting(pairs: PairSet, road: Motorway) -> dict[str, Pair]:
    """Returns the pairs that the road is long enough for, by their ids.

    Raises:
        DataError: there are none.
    """
    found = {pair.pair_id: pair for pair in pairs if _places(pair, road, 0) is not None}
    if not found:
        shortest = min(_travelled(pair) for pair in pairs) + _BEGIN
        raise DataError(
            f"demo.osm: the motorway has {road.length:.0f} m, the pair with the shortest way takes {shortest:.0f} m; name an"
            " extract with a longer road, or leave demo.osm out"
        )
    if len(found) < len(pairs):
        log.info(
            "SUMO: %d pairs are not shown, as the motorway is too short for them",
            len(pairs) - len(found),
        )
    return found


def _choose(
    drives: Sequence[PairTrajectory], table: pd.DataFrame, count: int
) -> list[PairTrajectory]:
    """Returns drives spread evenly from the best to the worst improvement; those without one come last."""
    policy = table[table["method"] == "policy"]
    improvement = dict(
        zip(policy["pair_id"], policy["improvement"].astype(float).fillna(-np.inf), strict=True)
    )
    ranked = sorted(drives, key=lambda drive: -improvement[drive.pair_id])
    places = sorted(
        {round(place) for place in np.linspace(0, len(ranked) - 1, min(count, len(ranked)))}
    )
    return [ranked[place] for place in places]


def _networks(evaluation: Evaluation, policy: Agent) -> dict[str, str]:
    """Returns which of the policy's networks drove each pair in the evaluation."""
    table = evaluation.table.drop_duplicates("pair_id").set_index("pair_id")
    found = {}
    for drive in evaluation.trajectories:
        own = [drive.pair_id, ALL, policy.names[0]]
        if "fold" in table and pd.notna(table["fold"][drive.pair_id]):
            own.insert(0, f"fold {int(table['fold'][drive.pair_id])}")
        found[drive.pair_id] = next(name for name in own if name in policy.names)
    return found


def _base(evaluation: Evaluation, pair_id: str, known: Known) -> dict[str, float] | None:
    """Returns the parameters that the policy's offsets started from for a pair."""
    table = evaluation.table
    row = table[(table["pair_id"] == pair_id) & (table["method"] == known.base)]
    return (
        {name: float(row[f"parameter_{name}"].iloc[0]) for name in evaluation.names}
        if len(row)
        else None
    )


def _since(first: int, policy: Agent, known: Known) -> int:
    """Returns the frame from which on the driver is known."""
    return 0 if known.history is None else max(0, first - round(known.history / policy.dt))


def _driver_features(
    pair: Pair, first: int, policy: Agent, known: Known
) -> dict[str, float] | None:
    """Returns the driver features that the policy was told of a pair's driver."""
    until, since = (torch.tensor([frame]) for frame in (first, _since(first, policy, known)))
    driver_features = policy.driver_features_of(
        PairBatch.of(PairSet((pair,), pair.recording)), until, since
    )
    if driver_features is None or bool(driver_features.isnan().any()):
        return None
    return dict(zip(policy.policy.driver_features, driver_features[0].tolist(), strict=True))


def _renewed(first: int, policy: Agent, known: Known) -> int:
    """Returns the frame from which on the policy remembers: the first whole window of what it may read."""
    stride = policy.windows.stride
    return min(first, -(-_since(first, policy, known) // stride) * stride)


def _request(number: int, pair: Pair, drive: PairTrajectory, road: Motorway) -> dict[str, Any]:
    abreast = len(road.tracks) // ABREAST
    scene, side = divmod(number, abreast)
    # Tracks are numbered from the right; seen in driving direction the real follower comes first from the left.
    track = {kind: len(road.tracks) - 1 - ABREAST * side - k for k, kind in enumerate(FOLLOWERS)}
    return {
        "scene": scene,
        "length": pair.leader_length,
        "first": round(float(drive.time[0]) / pair.dt),
        "track": track,
        "places": {kind: _places(pair, road, track[kind]) for kind in FOLLOWERS},
    }


def _travelled(pair: Pair) -> float:
    """Returns how much road a pair takes from the follower's begin, m."""
    return float(
        max(pair.leader_position.max(), pair.follower_position.max()) - pair.follower_position[0]
    )


def _places(pair: Pair, road: Motorway, track: int) -> list[tuple[int, float]] | None:
    """Returns where leader and follower enter, edge and position on it; None if the road is too short for them.

    Nobody can enter inside a junction, so they may begin a little later.
    """
    ahead, travelled = float(pair.leader_position[0] - pair.follower_position[0]), _travelled(pair)
    for begin in np.arange(_BEGIN, road.length - travelled, 1.0).tolist():
        leader, follower = road.place(track, begin + ahead), road.place(track, begin)
        if leader is not None and follower is not None:
            return [leader, follower]
    return None


def _ask(request: Message) -> Message:
    """Has a SUMO process answer.

    Raises:
        SumoError: it cannot.
    """
    buffer = io.BytesIO()
    send(buffer, request.header, request.arrays)
    here = str(Path(cfx.__file__).resolve().parent.parent)
    path = os.pathsep.join(part for part in (here, os.environ.get("PYTHONPATH", "")) if part)
    done = subprocess.run(
        [sys.executable, "-m", "cfx.sumo.replay"],
        input=buffer.getvalue(),
        capture_output=True,
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "LIBSUMO_AS_TRACI": "quiet"},
        check=False,
    )
    answer = receive(io.BytesIO(done.stdout))
    said = done.stderr.decode(errors="replace").strip().splitlines()
    if answer is None:
        raise SumoError(
            f"the SUMO process ended by itself with exit code {done.returncode}: {said[-1] if said else 'no reason given'}"
        )
    if "error" in answer.header:
        if answer.header["bug"]:
            raise RuntimeError(
                f"{answer.header['bug']} in the SUMO process: {answer.header['error']}"
            )
        printed = [
            line.removeprefix("Error:").strip() for line in said if line.startswith("Error:")
        ]
        raise SumoError(
            " ".join(": ".join(dict.fromkeys([answer.header["error"], *printed])).split())
        )
    return answer


def _shown(
    number: int, drive: PairTrajectory, pair: Pair, request: dict[str, Any], found: dict[str, Array]
) -> Shown:
    first = int(request["first"])
    speed = {kind: found[f"{number}/{kind}/motion"][:, 0] for kind in FOLLOWERS}
    gap = {kind: found[f"{number}/{kind}/motion"][:, 1] for kind in FOLLOWERS}
    tested = slice(first + 1, first + len(drive.time))
    rows = []
    for method in FOLLOWERS[1:]:
        in_memory = drive.speed[method][1:], drive.gap[method][1:]
        in_sumo = speed[method][tested], gap[method][tested]
        real = pair.follower_speed[tested], pair.gap[tested]
        row: dict[str, Any] = {
            "pair_id": pair.pair_id,
            "method": method,
            "frames": len(in_memory[0]),
        }
        for name, memory, sumo, measured in zip(
            ("speed", "gap"), in_memory, in_sumo, real, strict=True
        ):
            row |= {
                f"rmse_{name}_memory": _rmse(memory - measured),
                f"rmse_{name}_sumo": _rmse(sumo - measured),
            }
            row[f"difference_{name}"] = float(np.abs(sumo - memory).max())
        row["collisions_sumo"] = int((in_sumo[1] < 0).any())
        rows.append(row)
    return Shown(
        drive=drive,
        pair=pair,
        first=first,
        scene=request["scene"],
        speed=speed,
        gap=gap,
        place={kind: found[f"{number}/{kind}/place"] for kind in FOLLOWERS},
        parameters=found[f"{number}/parameters"],
        table=pd.DataFrame(rows),
    )


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
