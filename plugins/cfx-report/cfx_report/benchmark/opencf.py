"""OpenCF-Benchmark's submissions: trajectories of followers who are known for 2.9 s.

Its table of pairs has no lengths of vehicles: `leader_dist - follower_dist` counts as the gap.

Shapes: P pairs, S samples, T frames. SI units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from cfx.errors import DataError
from cfx.plugin import Pair, PairSet, files
from cfx_report.benchmark.methods import Entry
from cfx_report.benchmark.predictions import trajectory_table
from cfx_report.benchmark.segments import whole

_KNOWN_S = 2.9
"""What is known of a follower, s from a pair's first frame."""

_NEEDED = (
    "CF_pair_id",
    "Time",
    "leader_dist",
    "leader_speed",
    "leader_acceleration",
    "follower_dist",
    "follower_speed",
)

COLUMNS = (
    "CF_pair_id",
    "sample_id",
    "Time",
    "follower_dist",
    "follower_speed",
    "follower_acceleration",
)
"""Of a submission."""


def write_opencf(
    entry: Entry, learned: PairSet | None, source: Path, output: Path, samples: int, seed: int
) -> int:
    """Writes a submission for OpenCF-Benchmark: trajectories from 3.0 s on.

    Args:
        entry: who drives.
        learned: pairs to learn from; None: nothing is learned.
        source: their `test_input.csv`.
        output: the CSV file.
        samples: of a stochastic driver, at most 6.
        seed: of training and of draws.

    Returns:
        How many pairs were driven.

    Raises:
        DataError: the input is not as OpenCF describes it.
    """
    pairs, about = read_opencf(source)
    driver = entry.learned(learned if learned is not None else pairs, seed)
    first = [round(_KNOWN_S / pair.dt) for pair in pairs]
    segments = whole(list(pairs), first)
    speed = driver.forecast(segments.blanked(), segments.first, seed, samples)
    parts = []
    for number, path in enumerate(speed):
        table = trajectory_table("", segments, path)
        parts.append(_columns(table, pairs, about).assign(sample_id=number))
    with files.atomic_write(output) as temporary:
        pd.concat(parts)[list(COLUMNS)].to_csv(temporary, index=False)
    return len(pairs)


def _columns(table: pd.DataFrame, pairs: PairSet, about: pd.DataFrame) -> pd.DataFrame:
    """Returns simulated trajectories in OpenCF's columns."""
    original, first_time = about["id"].to_dict(), about["time"].to_dict()
    parts = []
    for pair, (pair_id, rows) in zip(pairs, table.groupby("pair_id", sort=False), strict=True):
        frame = np.rint(rows["time_s"].to_numpy() / pair.dt).astype(np.int64)
        speed = rows["speed_mps"].to_numpy()
        before = np.append(pair.follower_speed[frame[0] - 1], speed[:-1])
        began = first_time[str(pair_id)]
        columns = {
            "CF_pair_id": original[str(pair_id)],
            "Time": (began + rows["time_s"]).round(3),
            "follower_dist": pair.leader_position[frame] - rows["gap_m"],
            "follower_speed": speed,
            "follower_acceleration": (speed - before) / pair.dt,
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def read_opencf(source: Path) -> tuple[PairSet, pd.DataFrame]:
    """Reads OpenCF's table of pairs, whose followers may be known for 2.9 s alone.

    Returns:
        The pairs, and a row for each by its name: its id as in the file, and its first time, s.

    Raises:
        DataError: a column is missing, or a pair is too short.
    """
    try:
        table = pd.read_csv(source)
    except (OSError, ValueError) as error:
        raise DataError(f"{source}: cannot be read as CSV ({error})") from None
    for column in _NEEDED:
        if column not in table.columns:
            raise DataError(f"{source}: column {column} is missing; OpenCF's test_input.csv has it")
    pairs = []
    about = []
    for name, rows in table.sort_values("Time").groupby("CF_pair_id", sort=False):
        if len(rows) < round(_KNOWN_S / 0.1) + 2:
            raise DataError(f"{source}: pair {name} ends before 3.0 s, where prediction begins")
        is_known = rows["follower_dist"].notna().to_numpy()
        speed = rows["follower_speed"].ffill().to_numpy(float)
        start = float(rows["follower_dist"].iloc[0])
        pairs.append(
            Pair(
                pair_id=str(name),
                recording="opencf",
                leader_id=f"leader {name}",
                follower_id=f"follower {name}",
                first_frame=0,
                dt=0.1,
                leader_length=0.0,
                leader_position=rows["leader_dist"].to_numpy(float),
                leader_speed=rows["leader_speed"].to_numpy(float),
                leader_acceleration=rows["leader_acceleration"].to_numpy(float),
                follower_position=np.where(is_known, rows["follower_dist"], start),
                follower_speed=speed,
                follower_acceleration=np.gradient(speed, 0.1),
            )
        )
        about.append({"name": str(name), "id": name, "time": float(rows["Time"].iloc[0])})
    if not pairs:
        raise DataError(f"{source}: has no rows")
    return PairSet(tuple(pairs), str(source)), pd.DataFrame(about).set_index("name")
