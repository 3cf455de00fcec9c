"""highD's files: both driving directions, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.contracts import DatasetContract
from cfx.datasets.describe import describe
from cfx.datasets.highd import HighdDataset
from cfx.errors import DataError
from cfx.pairs import SIGNALS
from tests.datasets.layouts import made_pairs, write_highd


class TestHighd(DatasetContract):
    @pytest.fixture
    def dataset(self, tmp_path: Path) -> HighdDataset:
        return HighdDataset(path=write_highd(tmp_path, made_pairs()), min_frames=100, max_gap=None)


def test_both_directions_give_the_trajectories_back(tmp_path: Path) -> None:
    made = made_pairs()
    pairs = HighdDataset(path=write_highd(tmp_path, made), min_frames=2, max_gap=None).load()
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
    pairs = HighdDataset(path=tmp_path / "*_tracks.csv", min_frames=2, max_gap=None).load()
    assert {pair.recording for pair in pairs} == {"highd-01", "highd-02"}


def test_types_are_selected_and_the_others_counted(tmp_path: Path) -> None:
    path = write_highd(tmp_path, made_pairs())
    options = {"path": path, "min_frames": 2, "max_gap": None}
    assert len(HighdDataset(**options, driver_type="car").load()) == 3
    with pytest.raises(DataError, match=r"driver_type=truck: .* no such type.*Known: car"):
        HighdDataset(**options, driver_type="truck").load()


def test_is_recognised(tmp_path: Path) -> None:
    text = describe(write_highd(tmp_path, made_pairs()))
    for words in (
        "highD tracks",
        "data=highd",
        "car (3 pairs)",
        "truck (3 pairs)",
        "Why pairs end",
    ):
        assert words in text


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
        ("id", 99, "vehicle 99 is not in 01_tracksMeta.csv"),
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
