"""Recordings that are made up, in the layouts in which others publish theirs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from cfx.datasets.synthetic import SyntheticDataset
from cfx.datasets.tracks import NOBODY, Tracks
from cfx.pairs import PairSet


def made_pairs(pairs: int = 3, frames: int = 150) -> PairSet:
    """Pairs whose speeds and positions belong together."""
    return SyntheticDataset(pairs=pairs, frames=frames, min_frames=2).load()


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


def write_highd(folder: Path, pairs: PairSet, number: str = "01") -> Path:
    """highD's three files; every second pair drives to the left, as its upper lanes do."""
    rows, meta = [], []
    for index, pair in enumerate(pairs):
        leader, follower = 2 * index + 1, 2 * index + 2
        to_right = index % 2 == 0
        for vehicle, who, length in (
            (leader, "leader", pair.leader_length),
            (follower, "follower", 4.0),
        ):
            front = getattr(pair, f"{who}_position")
            sign = 1.0 if to_right else -1.0
            frame = pd.DataFrame({"frame": 1 + np.arange(len(pair)), "id": vehicle})
            frame["x"] = front - length if to_right else -front
            frame["y"] = 8.0
            frame["width"], frame["height"] = length, 1.8
            frame["xVelocity"] = sign * getattr(pair, f"{who}_speed")
            frame["yVelocity"] = 0.0
            frame["xAcceleration"] = sign * getattr(pair, f"{who}_acceleration")
            frame["yAcceleration"] = 0.0
            frame["dhw"], frame["thw"], frame["ttc"], frame["precedingXVelocity"] = 0, 0, 0, 0
            frame["precedingId"] = leader if who == "follower" else 0
            frame["followingId"] = follower if who == "leader" else 0
            frame["laneId"] = 2 + index
            rows.append(frame)
            meta.append(
                {
                    "id": vehicle,
                    "width": length,
                    "height": 1.8,
                    "initialFrame": 1,
                    "finalFrame": len(pair),
                    "numFrames": len(pair),
                    "class": "Truck" if who == "leader" else "Car",
                    "drivingDirection": 2 if to_right else 1,
                }
            )
    folder.mkdir(exist_ok=True)
    tracks = folder / f"{number}_tracks.csv"
    pd.concat(rows).sort_values(["frame", "id"]).to_csv(tracks, index=False)
    pd.DataFrame(meta).to_csv(folder / f"{number}_tracksMeta.csv", index=False)
    rate = round(1 / pairs[0].dt)
    about = {"id": int(number), "frameRate": rate, "locationId": 1, "upperLaneMarkings": "8.5;12.6"}
    pd.DataFrame([about]).to_csv(folder / f"{number}_recordingMeta.csv", index=False)
    return tracks


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


OPENACC_ABOUT = (
    "Date,30,09,2020,,",
    "Vehicle_order,Golf,XC40,Leaf,,",
    "Number_of_vehicles,{count},,,",
    "ACC,{acc},,,",
    "Distance_setting,shortest,,,",
)


def write_openacc(
    path: Path, pairs: PairSet, *, acc: str = "2", drivers: dict[int, list[str]] | None = None
) -> Path:
    """One of OpenACC's files: pair k is vehicles k and k + 1 of a platoon."""
    frames = min(len(pair) for pair in pairs)
    table = pd.DataFrame({"Time": 36000.0 + 0.1 * np.arange(frames)})
    first = pairs[0]
    table["Speed1"], table["E1"] = first.leader_speed[:frames], 0.0
    for place, pair in enumerate(pairs, start=1):
        table[f"Speed{place + 1}"] = pair.follower_speed[:frames]
        table[f"IVS{place}"] = pair.gap[:frames]
    for place, names in (drivers or {}).items():
        table[f"Driver{place}"] = names
    above = [line.format(count=len(pairs) + 1, acc=acc) for line in OPENACC_ABOUT]
    path.write_text("\n".join(above) + "\n" + table.to_csv(index=False))
    return path


def write_waymo(path: Path, pairs: PairSet, *, first_version: bool = False) -> Path:
    """The Waymo pairs' CSV: rows of both vehicles; vehicle 0 is the automated one."""
    rows = []
    for segment, pair in enumerate(pairs):
        follower, leader = (0, 7) if segment % 2 == 0 else (3, 0)
        for vehicle, who, length in (
            (leader, "leader", pair.leader_length),
            (follower, "follower", 5.18),
        ):
            table = pd.DataFrame({"local_time": 0.1 * np.arange(len(pair))})
            table["segment_id"], table["local_veh_id"], table["length"] = segment, vehicle, length
            table["follower_id"], table["leader_id"] = follower, leader
            table["filter_pos"] = getattr(pair, f"{who}_position") - length / 2
            table["filter_speed"] = getattr(pair, f"{who}_speed")
            table["filter_accer"] = getattr(pair, f"{who}_acceleration")
            rows.append(table)
    whole = pd.concat(rows)
    if first_version:
        old = {"filter_pos": "processed_position", "filter_speed": "processed_speed"}
        whole = whole.rename(columns={**old, "filter_accer": "processed_accer"})
    whole.to_csv(path, index=False)
    return path


def events_of(pairs: PairSet) -> np.ndarray:
    """FollowNet's array `(events, 4, samples)`, padded by NaN."""
    longest = max(len(pair) for pair in pairs)
    events = np.full((len(pairs), 4, longest), np.nan)
    for event, pair in zip(events, pairs, strict=True):
        speeds = (pair.follower_speed, pair.leader_speed - pair.follower_speed, pair.leader_speed)
        event[:, : len(pair)] = np.stack([pair.gap, *speeds])
    return events


def write_lyft(folder: Path, pairs: PairSet, *, with_size: bool = True) -> Path:
    """A Zarr store of Lyft's pairs, in version 2 of the format, as they are published."""
    import zarr

    group = zarr.open_group(str(folder), mode="w", zarr_format=2)
    ends = np.cumsum([len(pair) for pair in pairs])
    starts = ends - [len(pair) for pair in pairs]
    arrays = {"index_range": np.stack([starts, ends], axis=1)}
    arrays["timestamp"] = np.concatenate([0.1 * np.arange(len(pair)) for pair in pairs])
    sizes = {"lead": [4.85] * len(pairs), "follow": [4.0 + k for k in range(len(pairs))]}
    if with_size:
        sizes["lead"] = [pair.leader_length for pair in pairs]
        arrays["lead_size"] = np.array(sizes["lead"])
    arrays["follow_size"] = np.array(sizes["follow"])
    for short, who in (("lead", "leader"), ("follow", "follower")):
        middles = []
        for pair, size in zip(pairs, sizes[short], strict=True):
            front = getattr(pair, f"{who}_position")
            if who == "leader":
                front = front - pair.leader_length + size
            middles.append(front - size / 2)
        arrays[f"{short}_centroid"] = np.concatenate(middles)
        for name, signal in (("velocity", "speed"), ("acceleration", "acceleration")):
            values = [getattr(pair, f"{who}_{signal}") for pair in pairs]
            arrays[f"{short}_{name}"] = np.concatenate(values)
    for name, values in arrays.items():
        group.create_array(name, data=values)
    return folder
