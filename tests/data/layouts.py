"""Recordings that are made up, in the layouts in which others publish theirs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cfx.data.pairs import PairSet
from cfx.data.tracks import NOBODY, Tracks
from cfx.simulation.synthetic import SyntheticDataset


def made_pairs(pairs: int = 3, frames: int = 150) -> PairSet:
    """Pairs whose speeds and positions belong together."""
    return SyntheticDataset(pairs=pairs, frames=frames, min_duration=0).load()


def tracks_of(rows: list[tuple[int, int, int, int, float]], **more: object) -> Tracks:
    """Tracks of rows (vehicle, frame, lane, leader, position): 5 m long, at 10 m/s."""
    rows = sorted(rows)
    columns = list(zip(*rows, strict=True)) or [[]] * 5
    vehicle, frame, lane, leader = (np.array(column, dtype=np.int64) for column in columns[:4])
    position = np.array(columns[4], dtype=np.float64)
    values = {
        "source": "made up",
        "dt": 0.1,
        "recordings": ("r",),
        "recording": np.zeros(len(rows), dtype=np.int64),
        "vehicle": vehicle,
        "frame": frame,
        "lane": lane,
        "leader": leader,
        "position": position,
        "speed": np.full(len(rows), 10.0),
        "acceleration": np.zeros(len(rows)),
        "length": np.full(len(rows), 5.0),
    }
    return Tracks(**{**values, **more})  # type: ignore[arg-type] # made of plain columns


def driving(
    vehicle: int, frames: range, lane: int, leader: int, at: float
) -> list[tuple[int, int, int, int, float]]:
    """Rows of a vehicle that drives 1 m in each frame, and is at `at` in frame 0."""
    return [(vehicle, frame, lane, leader, at + frame) for frame in frames]


NONE = NOBODY


def write_fcd(path: Path, pairs: PairSet, *, leaders: bool = True, length: float = 5.0) -> Path:
    """SUMO's FCD output of pairs that drive side by side, each in a lane of its own."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<fcd-export>"]
    for frame in range(max(len(pair) for pair in pairs)):
        lines.append(f'<timestep time="{frame * pairs[0].dt:.2f}">')
        for index, pair in enumerate(pairs):
            if frame >= len(pair):
                continue
            rear = pair.leader_position[frame] - pair.leader_length
            for who, position in (
                ("leader", rear + length),
                ("follower", pair.follower_position[frame]),
            ):
                more = ""
                if leaders and who == "follower":
                    more = f' leaderID="leader{index}" leaderGap="{pair.gap[frame]:.6f}"'
                elif leaders:
                    more = ' leaderID="" leaderGap="-1"'
                speed = getattr(pair, f"{who}_speed")[frame]
                acceleration = getattr(pair, f"{who}_acceleration")[frame]
                lines.append(
                    f'<vehicle id="{who}{index}" type="car" speed="{speed:.6f}" pos="{position:.6f}"'
                    f' lane="e{index}_0" acceleration="{acceleration:.6f}"{more}/>'
                )
        lines.append("</timestep>")
    lines.append("</fcd-export>")
    path.write_text("\n".join(lines))
    return path
