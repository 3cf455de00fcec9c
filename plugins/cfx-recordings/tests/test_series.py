"""OpenACC, FollowNet, Waymo and Lyft pairs: files made in their layouts give the pairs back."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import cfx
from cfx.app.cli import main
from cfx.errors import DataError
from cfx_contracts import check_contract
from cfx_recordings.followernet import FollowernetDataset
from cfx_recordings.lyft_pairs import LyftPairsDataset
from cfx_recordings.openacc import OpenaccDataset
from cfx_recordings.waymo_pairs import WaymoPairsDataset


def made_pairs(pairs: int = 3, frames: int = 150) -> cfx.plugin.PairSet:
    """Pairs whose speeds and positions belong together."""
    made = cfx.get("dataset", "synthetic")(pairs=pairs, frames=frames, min_duration=0)
    assert isinstance(made, cfx.plugin.Dataset)
    return made.load()


OPENACC_ABOUT = (
    "Date,30,09,2020,,",
    "Vehicle_order,Golf,XC40,Leaf,,",
    "Number_of_vehicles,{count},,,",
    "ACC,{acc},,,",
    "Distance_setting,shortest,,,",
)


def write_openacc(
    path: Path,
    pairs: cfx.plugin.PairSet,
    *,
    acc: str = "2",
    drivers: dict[int, list[str]] | None = None,
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


def write_waymo(path: Path, pairs: cfx.plugin.PairSet, *, first_version: bool = False) -> Path:
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


def events_of(pairs: cfx.plugin.PairSet) -> np.ndarray:
    """FollowNet's array `(events, 4, samples)`, padded by NaN."""
    longest = max(len(pair) for pair in pairs)
    events = np.full((len(pairs), 4, longest), np.nan)
    for event, pair in zip(events, pairs, strict=True):
        speeds = (pair.follower_speed, pair.leader_speed - pair.follower_speed, pair.leader_speed)
        event[:, : len(pair)] = np.stack([pair.gap, *speeds])
    return events


def write_lyft(folder: Path, pairs: cfx.plugin.PairSet, *, with_size: bool = True) -> Path:
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


def npy(folder: Path, pairs: cfx.plugin.PairSet) -> Path:
    path = folder / "HighD_train_data.npy"
    np.save(path, events_of(pairs))
    return path


def openacc(folder: Path, pairs: cfx.plugin.PairSet) -> Path:
    return write_openacc(folder / "ASta_040719_platoon3.csv", pairs)


def waymo(folder: Path, pairs: cfx.plugin.PairSet) -> Path:
    return write_waymo(folder / "all_seg_paired_cf_trj_final.csv", pairs)


def lyft(folder: Path, pairs: cfx.plugin.PairSet) -> Path:
    return write_lyft(folder / "trainHH.zarr", pairs)


READERS: dict[str, tuple[type[cfx.plugin.Dataset], Callable[[Path, cfx.plugin.PairSet], Path]]] = {
    "openacc": (OpenaccDataset, openacc),
    "followernet": (FollowernetDataset, npy),
    "waymo_pairs": (WaymoPairsDataset, waymo),
    "lyft_pairs": (LyftPairsDataset, lyft),
}


@pytest.mark.parametrize("name", READERS)
def test_contract(name: str, tmp_path: Path) -> None:
    cls, write = READERS[name]
    check_contract(cls(path=write(tmp_path, made_pairs()), min_duration=10))


@pytest.mark.parametrize("name", READERS)
def test_gives_gaps_and_speeds_back(name: str, tmp_path: Path) -> None:
    cls, write = READERS[name]
    made = made_pairs()
    pairs = cls(path=write(tmp_path, made), min_duration=0).load()
    assert len(pairs) == len(made)
    for pair, original in zip(pairs, made, strict=True):
        np.testing.assert_allclose(pair.gap, original.gap, atol=1e-6)
        np.testing.assert_allclose(pair.follower_speed, original.follower_speed, atol=1e-9)
        assert pair.dt == 0.1


def test_speeds_of_waymos_two_estimates_are_compared(tmp_path: Path) -> None:
    path = waymo(tmp_path, made_pairs())
    table = pd.read_csv(path)
    for factor, says in ((1.02, []), (3.6, ["km/h and m/s"])):
        table.assign(speed_based_speed=factor * table["filter_speed"]).to_csv(path, index=False)
        remarks = WaymoPairsDataset(path=path).read().remarks
        assert [words in remark.text for words, remark in zip(says, remarks, strict=True)] == [
            True for _ in says
        ]


def test_each_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [write(tmp_path, made_pairs()) for _, write in READERS.values()]
    assert main(["data", "describe", *map(str, files)]) == 0
    text = capsys.readouterr().out
    for name in READERS:
        assert f"data={name}" in text
    assert text.count("3 of 3 drivers") == len(READERS)


# --- OpenACC --------------------------------------------------------------------------------------


def test_a_platoon_is_cut_where_the_driver_hands_over(tmp_path: Path) -> None:
    made = made_pairs(pairs=1, frames=100)
    drivers = {2: ["Human"] * 40 + ["ACC"] * 60}
    path = write_openacc(tmp_path / "a.csv", made, drivers=drivers)
    pairs = OpenaccDataset(path=path, min_duration=0).load()
    assert [(pair.driver_type, len(pair)) for pair in pairs] == [("human", 40), ("acc", 60)]
    assert {one.reason: one.count for one in pairs.ends} == {
        "the driver type changes": 1,
        "the source's pair ends": 1,
    }
    (only,) = OpenaccDataset(path=path, min_duration=0, driver_type="acc").load()
    assert only.pair_id == "a-2-XC40-1-Golf-run2"


@pytest.mark.parametrize(("acc", "kind"), [("0", "human"), ("1", "acc"), ("2", ""), ("", "")])
def test_the_line_above_the_table_says_who_drives_where_no_column_does(
    tmp_path: Path, acc: str, kind: str
) -> None:
    path = write_openacc(tmp_path / "a.csv", made_pairs(pairs=2), acc=acc)
    pairs = OpenaccDataset(path=path, min_duration=0).load()
    assert [pair.driver_type for pair in pairs] == [kind, kind]
    assert pairs[0].leader_driver_type == "", "nobody says how the first car is driven"


def test_empty_cells_and_missing_times_cut_a_pair_and_are_counted(tmp_path: Path) -> None:
    path = write_openacc(tmp_path / "a.csv", made_pairs(pairs=1, frames=100))
    lines = path.read_text().splitlines()
    time, speed, east, follower, _ = lines[36].split(",")  # the 31st row of the table
    lines[36] = ",".join([time, speed, east, follower, ""])
    del lines[66:76]
    path.write_text("\n".join(lines))
    pairs = OpenaccDataset(path=path, min_duration=0).load()
    assert [(pair.first_frame, len(pair)) for pair in pairs] == [(0, 30), (31, 29), (70, 30)]
    assert {one.reason: one.count for one in pairs.dropped} == {"a value is missing": 1}
    assert {one.reason for one in pairs.ends} == {
        "a value is missing",
        "frames are missing",
        "the source's pair ends",
    }


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: text.replace("Time,", "Clock,"), "row 6: column Time is missing"),
        (lambda text: text.replace("IVS1", "Gap1"), "no two vehicles have Speed and IVS"),
        (
            lambda text: text.replace("36000.5", "36000.1"),
            "row 12, column Time: 36000.1 does not advance",
        ),
        (lambda text: text.replace("36000.5", "36000.45"), "is between two frames of 0.1 s"),
        (lambda text: "\n".join(text.splitlines()[5:]), "five lines must stand above its table"),
    ],
)
def test_openacc_says_what_is_wrong(
    tmp_path: Path, change: Callable[[str], str], says: str
) -> None:
    path = write_openacc(tmp_path / "a.csv", made_pairs(pairs=1))
    path.write_text(change(path.read_text()))
    with pytest.raises(DataError, match=says):
        OpenaccDataset(path=path).read()


# --- FollowNet ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["npz", "padded", "mat", "cells", "one"])
def test_events_come_in_any_kind_of_array(tmp_path: Path, kind: str) -> None:
    made = made_pairs()
    whole = events_of(made)
    path = tmp_path / "events.mat"
    if kind == "npz":
        path = tmp_path / "events.npz"
        np.savez(path, **{f"e{number}": event for number, event in enumerate(whole)})
    elif kind == "padded":
        path = tmp_path / "events.npy"
        np.save(path, np.concatenate([whole, np.full((3, 4, 5), np.nan)], axis=2))
    elif kind == "mat":
        savemat(path, {"events": whole})
    elif kind == "cells":
        cells = np.empty(3, dtype=object)
        for number, event in enumerate(whole):
            cells[number] = event
        savemat(path, {"events": cells})
    else:
        path = tmp_path / "events.npy"
        np.save(path, whole[0])
    pairs = FollowernetDataset(path=path, min_duration=0).load()
    assert [len(pair) for pair in pairs] == [150] * (1 if kind == "one" else 3)
    np.testing.assert_allclose(pairs[0].gap, made[0].gap, atol=1e-9)


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.pkl"])
def test_nothing_is_unpickled(tmp_path: Path, name: str) -> None:
    mark = tmp_path / "ran"
    path = tmp_path / name
    objects = np.array([Bomb(mark), None], dtype=object)
    if name == "a.npy":
        np.save(path, objects, allow_pickle=True)
    elif name == "a.npz":
        np.savez(path, a=objects)
    else:
        path.write_bytes(pickle.dumps(Bomb(mark)))
    with pytest.raises(DataError, match=r"unpickling a file runs the code|is none of \.npy"):
        FollowernetDataset(path=path).read()
    assert not mark.exists()


@pytest.mark.parametrize(
    ("events", "says"),
    [
        (np.zeros((2, 3, 50)), r"has the shape \(2, 3, 50\)"),
        (np.zeros((2, 4, 50)) + np.array([[9], [1], [5], [3]]), "row 3 is not the difference"),
        (np.full((2, 4, 50), np.nan), "holds no events"),
        (np.array(["a", "b"]), "not numbers"),
    ],
)
def test_events_say_what_is_wrong(tmp_path: Path, events: np.ndarray, says: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, events)
    with pytest.raises(DataError, match=says):
        FollowernetDataset(path=path).read()


def test_a_wrong_step_is_seen_in_the_spacings(tmp_path: Path) -> None:
    path = npy(tmp_path, made_pairs(frames=300))
    with pytest.raises(DataError, match=r"time step looks like 0\.\d+ s, not 0\.04 s"):
        FollowernetDataset(path=path, recorded_step=0.04).load()


@pytest.mark.parametrize("name", ["waymo_pairs", "lyft_pairs", "openacc"])
def test_times_in_other_steps_are_named(name: str, tmp_path: Path) -> None:
    cls, write = READERS[name]
    slow = cfx.get("dataset", "synthetic")(pairs=3, frames=150, min_duration=0)
    path = write(tmp_path, slow.load())  # type: ignore[attr-defined]  # a dataset
    if path.is_dir():
        import zarr

        times = zarr.open_group(str(path))["timestamp"]
        times[:] = 2.0 * times[:]
    else:
        lines = path.read_text().splitlines()
        table = pd.read_csv(path, skiprows=5 if name == "openacc" else 0)
        column = "Time" if name == "openacc" else "local_time"
        above = lines[:5] if name == "openacc" else []
        table[column] *= 2.0
        path.write_text("\n".join([*above, table.to_csv(index=False)]))
    with pytest.raises(DataError, match=r"the time step is 0\.2 s, not the 0\.1 s"):
        cls(path=path, min_duration=0).load()


def test_a_spacing_that_holds_a_vehicle_is_corrected(tmp_path: Path) -> None:
    made = made_pairs()
    path = npy(tmp_path, made)
    pairs = FollowernetDataset(path=path, min_duration=0, vehicle_length=1.0).load()
    np.testing.assert_allclose(pairs[0].gap, made[0].gap - 1.0, atol=1e-9)


def test_a_damaged_array_says_so(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, events_of(made_pairs()))
    path = tmp_path / "a.npy"
    path.write_bytes(buffer.getvalue()[:500])
    with pytest.raises(DataError, match="is cut off or damaged"):
        FollowernetDataset(path=path).read()


# --- Waymo and Lyft -------------------------------------------------------------------------------


@pytest.mark.parametrize("first_version", [True, False])
def test_waymo_knows_who_is_automated(tmp_path: Path, first_version: bool) -> None:
    path = write_waymo(tmp_path / "w.csv", made_pairs(pairs=2), first_version=first_version)
    pairs = WaymoPairsDataset(path=path).load()
    assert [(pair.driver_type, pair.leader_driver_type) for pair in pairs] == [
        ("automated", "human"),
        ("human", "automated"),
    ]


def test_waymo_uses_the_times_at_which_both_have_rows(tmp_path: Path) -> None:
    path = write_waymo(tmp_path / "w.csv", made_pairs(pairs=1))
    table = pd.read_csv(path)
    of_leader = table["local_veh_id"] == 7
    late = of_leader & (table["local_time"] < 1.95)
    table[~late].sample(frac=1.0, random_state=1).to_csv(path, index=False)
    (pair,) = WaymoPairsDataset(path=path, min_duration=0).load()
    assert len(pair) == 130
    np.testing.assert_allclose(pair.gap, made_pairs(pairs=1)[0].gap[20:], atol=1e-6)


def test_waymo_names_what_is_missing(tmp_path: Path) -> None:
    path = write_waymo(tmp_path / "w.csv", made_pairs(pairs=1))
    path.write_text(path.read_text().replace("filter_pos", "where"))
    with pytest.raises(DataError, match="column filter_pos or processed_position is missing"):
        WaymoPairsDataset(path=path).read()


def test_lyft_takes_its_own_length_where_a_store_has_none(tmp_path: Path) -> None:
    made = made_pairs()
    path = write_lyft(tmp_path / "trainHA.zarr", made, with_size=False)
    pairs = LyftPairsDataset(path=path).load()
    np.testing.assert_allclose(pairs[0].gap, made[0].gap, atol=1e-9)
    assert pairs[0].leader_length == 4.85
    assert (pairs[0].driver_type, pairs[0].leader_driver_type) == ("human", "automated")


@pytest.mark.parametrize(
    "change",
    [
        {"dtype": "|O", "filters": [{"id": "pickle"}]},
        {"filters": [{"id": "pickle"}]},
        {"compressor": {"id": "pickle"}},
    ],
)
def test_lyft_refuses_stores_that_could_run_code(tmp_path: Path, change: dict[str, Any]) -> None:
    path = write_lyft(tmp_path / "trainHH.zarr", made_pairs(pairs=1))
    about = path / "lead_centroid" / ".zarray"
    about.write_text(json.dumps(json.loads(about.read_text()) | change))
    with pytest.raises(DataError, match="could run code"):
        LyftPairsDataset(path=path).read()
