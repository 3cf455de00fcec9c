"""highD's files: both driving directions, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import cfx
from cfx.app.cli import main
from cfx.errors import DataError
from cfx_contracts import check_contract
from cfx_recordings.highd import HighdDataset

SIGNALS = [
    f"{who}_{what}"
    for who in ("leader", "follower")
    for what in ("position", "speed", "acceleration")
]


def made_pairs(pairs: int = 3, frames: int = 150) -> cfx.plugin.PairSet:
    """Pairs whose speeds and positions belong together."""
    made = cfx.get("dataset", "synthetic")(pairs=pairs, frames=frames, min_duration=0)
    assert isinstance(made, cfx.plugin.Dataset)
    return made.load()


def write_highd(folder: Path, pairs: cfx.plugin.PairSet, number: str = "01") -> Path:
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


def test_contract(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs())
    check_contract(HighdDataset(path=path, min_duration=10, max_gap=None))


def test_the_metadata_name_the_site(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs(1))
    read = HighdDataset(path=path, min_duration=0, max_gap=None).read()
    assert {pair.site for pair in read} == {"highd-location-1"}
    about = tmp_path / "01_recordingMeta.csv"
    pd.read_csv(about).drop(columns="locationId").to_csv(about, index=False)
    read = HighdDataset(path=path, min_duration=0, max_gap=None).read()
    assert {pair.site for pair in read} == {""}


def test_both_directions_give_the_trajectories_back(tmp_path: Path) -> None:
    made = made_pairs()
    path = write_highd(tmp_path, made)
    pairs = HighdDataset(path=path, min_duration=0, max_gap=None).read()
    assert [len(pair) for pair in pairs] == [len(pair) for pair in made]
    for pair, original in zip(pairs, made, strict=True):
        for name in SIGNALS:
            np.testing.assert_allclose(getattr(pair, name), getattr(original, name), atol=1e-9)
        assert pair.leader_length == original.leader_length
        assert (pair.driver_type, pair.leader_driver_type) == ("car", "truck")
        assert pair.recording == "highd-01"
    assert pairs.dt == 0.1


def test_recordings_are_told_apart(tmp_path: Path) -> None:
    for number in ("01", "02"):
        write_highd(tmp_path, made_pairs(frames=150 + int(number)), number)
    pairs = HighdDataset(path=tmp_path / "*_tracks.csv", min_duration=0, max_gap=None).load()
    assert {pair.recording for pair in pairs} == {"highd-01", "highd-02"}


def test_types_are_selected_and_the_others_counted(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs())
    options = {"path": path, "min_duration": 0, "max_gap": None}
    assert len(HighdDataset(**options, driver_type="car").load()) == 3
    with pytest.raises(DataError, match=r"driver_type=truck: .* no type .truck.*Known: car"):
        HighdDataset(**options, driver_type="truck").load()


def test_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "describe", str(write_highd(tmp_path, made_pairs()))]) == 0
    text = capsys.readouterr().out
    for words in (
        "highD tracks",
        "data=highd",
        "car (3 pairs)",
        "truck (3 pairs)",
        "Why pairs end",
    ):
        assert words in text


def test_columns_that_follow_from_others_agree_with_them(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs())
    table = pd.read_csv(path)
    ahead = table[["frame", "id", "x", "width", "xVelocity"]].rename(columns={"id": "precedingId"})
    both = table.merge(ahead, on=["frame", "precedingId"], how="left", suffixes=("", "_ahead"))
    front, front_ahead = both["x"] + both["width"], both["x_ahead"] + both["width_ahead"]
    to_right = both["xVelocity"] > 0
    headway = (front_ahead - front).where(to_right, both["x"] - both["x_ahead"])
    closing = both["xVelocity"].abs() - both["xVelocity_ahead"].abs()
    table["dhw"] = headway.fillna(0.0)
    table["thw"] = (headway / both["xVelocity"].abs()).fillna(0.0)
    table["ttc"] = (headway / closing).fillna(0.0)
    table["precedingXVelocity"] = both["xVelocity_ahead"].fillna(0.0)
    table.to_csv(path, index=False)
    assert not HighdDataset(path=path, max_gap=None).read().remarks
    for column, factor, units in (
        ("dhw", 1 / 0.3048, "feet and metres"),
        ("thw", 1000.0, "thousandths"),
        ("ttc", 0.3048, "feet and metres"),
        ("precedingXVelocity", 3.6, "km/h and m/s"),
    ):
        table.assign(**{column: table[column] * factor}).to_csv(path, index=False)
        remarks = HighdDataset(path=path, max_gap=None).read().remarks
        assert all(remark.is_contradiction for remark in remarks)
        assert f"{column} is typically {factor:.3g} times" in remarks[0].text
        assert units in remarks[0].text


def broken(path: Path, column: str, value: object) -> None:
    table = pd.read_csv(path)
    table[column] = table[column].astype(object)
    table.loc[3, column] = value
    table.to_csv(path, index=False)


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("laneId", 1.5, "row 5, column laneId: 1.5 is no whole number"),
        ("xVelocity", -12.0, "against the vehicle's drivingDirection"),
        ("x", None, "row 5, column x: the cell is empty"),
        ("id", 99, "99 is no vehicle of 01_tracksMeta.csv"),
        ("width", 0, "is no vehicle length"),
    ],
)
def test_what_no_recording_holds_is_refused(
    tmp_path: Path, column: str, value: object, says: str
) -> None:
    path = write_highd(tmp_path, made_pairs(pairs=1))
    broken(path, column, value)
    with pytest.raises(DataError, match=says):
        HighdDataset(path=path).read()


def test_the_other_files_are_named_where_they_are_missing(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs())
    (tmp_path / "01_recordingMeta.csv").unlink()
    with pytest.raises(DataError, match=r"01_recordingMeta.csv: no such file"):
        HighdDataset(path=path).read()
    renamed = path.rename(tmp_path / "tracks.csv")
    with pytest.raises(DataError, match=r"are named XX_tracks\.csv"):
        HighdDataset(path=renamed).read()
