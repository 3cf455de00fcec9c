"""Files that somebody else spoiled, column by column: named with the likely reason, or warned of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from cfx.data.describe import describe
from cfx.data.tidy import TidyDataset, frame_of
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8], [1.5, 0.2]], dtype=torch.float64)
PAIRS = wavy_pairs(Krauss(), TRUE, frames=400)
FULL = frame_of(PAIRS)
GAP = FULL["leader_position_m"] - FULL["leader_length_m"] - FULL["follower_position_m"]
LEADER = ["leader_position_m", "leader_speed_mps", "leader_acceleration_mps2"]
FOLLOWER = ["follower_position_m", "follower_speed_mps", "follower_acceleration_mps2"]
BY_GAP = FULL.drop(
    columns=[LEADER[0], LEADER[2], FOLLOWER[0], FOLLOWER[2], "leader_length_m"]
).assign(gap_m=GAP)
SPEEDS = [LEADER[1], FOLLOWER[1]]
THIRD = PAIRS[2].pair_id

Change = Callable[[pd.DataFrame], pd.DataFrame]


def times(factor: float, *columns: str, pair: str = "") -> Change:
    """Returns a change: columns times a factor, of one pair or of all."""

    def change(frame: pd.DataFrame) -> pd.DataFrame:
        rows = frame["pair_id"] == pair if pair else frame["pair_id"].notna()
        frame.loc[rows, list(columns)] *= factor
        return frame

    return change


def late(column: str, frames: int) -> Change:
    def change(frame: pd.DataFrame) -> pd.DataFrame:
        shifted = frame.groupby("pair_id")[column].shift(frames)
        return frame.assign(**{column: shifted.fillna(frame[column])})

    return change


def swapped(first: str, second: str) -> Change:
    return lambda frame: frame.rename(columns={first: second, second: first})


def from_row(row: int, column: str, value: float) -> Change:
    """Returns a change: from a row of the third pair on, a column is moved by a value."""

    def change(frame: pd.DataFrame) -> pd.DataFrame:
        rows = frame.index[frame["pair_id"] == THIRD][row:]
        frame.loc[rows, column] += value
        return frame

    return change


def constant(column: str) -> Change:
    return lambda frame: frame.assign(**{column: 7.0})


def every_second(frame: pd.DataFrame) -> pd.DataFrame:
    half = frame[frame["frame"] % 2 == 0].copy()
    half["frame"] = half.groupby("pair_id").cumcount()
    return half.assign(time_s=half["frame"] * 0.1)


SPOILED: dict[str, tuple[pd.DataFrame, Change, str]] = {
    "speeds in km/h": (FULL, times(3.6, *SPEEDS), "look like km/h"),
    "speed of the leader in kn": (FULL, times(1.94384, LEADER[1]), "leader_speed.*look like kn"),
    "speeds in cm/s": (FULL, times(100, *SPEEDS), "look like cm/s"),
    "accelerations in g": (FULL, times(1 / 9.80665, FOLLOWER[2]), "look like g_0"),
    "accelerations doubled": (FULL, times(2, LEADER[2]), "2 times what the speeds say"),
    "positions in feet": (FULL, times(3.28084, LEADER[0]), "leader_position.*look like ft"),
    "follower ahead, in feet": (FULL, times(3.28084, FOLLOWER[0]), "perhaps.*look like ft"),
    "one pair": (FULL, times(3.6, FOLLOWER[1], pair=THIRD), f"one of 4.*km/h.*'{THIRD}'"),
    "time in ms": (FULL, times(1000, "time_s"), "time step looks like 0.1 s"),
    "time ten per cent wrong": (FULL, times(1.1, "time_s"), "time step looks like 0.1 s"),
    "every second row": (FULL, every_second, "time step looks like 0.2 s"),
    "acceleration late": (FULL, late(FOLLOWER[2], 10), "second is taken 1.* s later"),
    "accelerations swapped": (FULL, swapped(LEADER[2], FOLLOWER[2]), "columns swapped"),
    "position starts anew": (FULL, from_row(200, LEADER[0], 900.0), "position leaps by 900"),
    "one speed": (FULL, from_row(399, FOLLOWER[1], 900.0), "speed leaps by 9"),
    "acceleration constant": (FULL, constant(FOLLOWER[2]), "is 7 in every frame"),
    "by gap, feet": (BY_GAP, times(3.28084, "gap_m"), "the gaps look like ft"),
    "by gap, one in feet": (BY_GAP, times(3.28084, "gap_m", pair=THIRD), "one of 4.*like ft"),
    "by gap, mph": (BY_GAP, times(2.23694, *SPEEDS), "the speeds look like mph"),
    "by gap, leader in km/h": (BY_GAP, times(3.6, SPEEDS[0]), "the leader's speeds look like km/h"),
    "by gap, swapped": (BY_GAP, swapped(*SPEEDS), "look swapped"),
    "by gap, wrong rate": (BY_GAP, times(25 / 30, "time_s"), "time step looks like 0.1 s"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_file_is_refused_and_its_reason_named(name: str, tmp_path: Path) -> None:
    frame, change, reason = SPOILED[name]
    path = tmp_path / "pairs.csv"
    change(frame.copy()).to_csv(path, index=False)
    with pytest.raises(DataError, match=reason):
        TidyDataset(path=path, min_duration=10).load()


@pytest.mark.parametrize("frame", [FULL, BY_GAP], ids=["full", "by gap"])
def test_files_as_they_should_be_are_read_without_a_word(
    frame: pd.DataFrame, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "pairs.csv"
    frame.to_csv(path, index=False)
    assert len(TidyDataset(path=path, min_duration=10).load()) == len(PAIRS)
    assert not caplog.records


@pytest.mark.parametrize(
    ("frame", "change", "doubt"),
    [
        (FULL, from_row(200, LEADER[0], 4.0), "moves 1 m more or less than its speed says"),
        (BY_GAP, lambda frame: frame.assign(gap_m=frame["gap_m"] + 5000), "200 m apart"),
        (FULL, times(3.28084, *LEADER, *FOLLOWER, "leader_length_m"), "m long: feet"),
    ],
)
def test_what_is_possible_but_rare_is_asked_about_by_a_job_too(
    frame: pd.DataFrame,
    change: Change,
    doubt: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "pairs.csv"
    change(frame.copy()).to_csv(path, index=False)
    TidyDataset(path=path, min_duration=10).load()
    assert doubt in caplog.text
    assert doubt in describe(path).text


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("8,73321", "'8,73321' is not a number; write decimals with a point"),
        ("0,512", "write decimals with a point"),
        ("2005-04-13 16:00:00.1-07:00", "write the seconds since a frame of your choice"),
    ],
)
def test_a_number_that_is_written_otherwise_is_no_other_number(
    cell: str, said: str, tmp_path: Path
) -> None:
    frame = FULL.astype({"time_s": object})
    frame.loc[1, "time_s"] = cell
    path = tmp_path / "pairs.csv"
    frame.to_csv(path, index=False)
    with pytest.raises(DataError) as error:
        TidyDataset(path=path).load()
    assert said in str(error.value)


def test_a_file_in_another_encoding_is_told_from_a_binary_one(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    FULL.assign(recording="Autobähn").to_csv(path, index=False, encoding="latin-1")
    with pytest.raises(DataError, match="no text in UTF-8"):
        TidyDataset(path=path).load()
    path.write_bytes(np.arange(256, dtype=np.uint8).tobytes())
    with pytest.raises(DataError, match="binary"):
        TidyDataset(path=path).load()
