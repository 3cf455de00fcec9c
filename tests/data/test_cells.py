"""Numbers as programs and people write them: read as they are meant, or refused."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.data.pairs import PairSet
from cfx.data.tidy import frame_of, read_tidy
from cfx.errors import DataError
from tests.data.layouts import made_pairs

FRAME = frame_of(made_pairs(2, 100))
NUMBERS = [name for name in FRAME if FRAME[name].dtype.kind == "f"]
FAR = ["leader_position_m", "follower_position_m"]
THOUSANDS = ("", ",", ".", " ", "\u00a0", "\u202f", "'", "\u2019")


def written(number: float, mark: str, thousands: str, decimals: int) -> str:
    text = f"{number:,.{decimals}f}"
    return text.replace(",", "T").replace(".", mark).replace("T", thousands)


def content(pairs: PairSet) -> list[str]:
    return [pair.content for pair in pairs]


@pytest.mark.parametrize(("mark", "thousands"), list(itertools.product(".,", THOUSANDS)))
def test_numbers_of_every_writing_are_the_same(tmp_path: Path, mark: str, thousands: str) -> None:
    if mark == thousands:
        pytest.skip("one mark for both is no writing")
    frame = FRAME.copy()
    frame[FAR] += 5000.0
    frame[NUMBERS] = frame[NUMBERS].round(3)
    frame.to_csv(tmp_path / "plain.csv", index=False)
    wanted = content(read_tidy(tmp_path / "plain.csv"))
    for name in NUMBERS:
        frame[name] = [written(number, mark, thousands, 3) for number in frame[name]]
    for separator in (",", ";", "\t", "|"):
        path = tmp_path / "written.csv"
        frame.to_csv(path, index=False, sep=separator)
        assert content(read_tidy(path)) == wanted
    frame.to_parquet(path)
    assert content(read_tidy(path)) == wanted


OPEN = "may be 11.345 or 11345, and nothing beside it says which"


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (["11,345"] * 4, OPEN),
        (["11,345", "1.5", "2.25", "3.125"], OPEN),
        (["11,345", "1234", "22,111", "9999"], OPEN),
        (["1,5", "2.5", "3,5", "4,5"], "'2.5' is not a number; write decimals with a comma"),
        (["1.5", "2.5", "3,5", "4.5"], "'3,5' is not a number; write decimals with a point"),
        (["1,234", "1.234", "5", "6"], "'1.234' is not a number as the cells above are"),
        (["1,23,456.7", "1", "2", "3"], "'1,23,456.7' is not a number"),
        (["12.5 km/h", "1", "2", "3"], "write the number alone, and say its unit in data.units"),
        (["12:30", "1", "2", "3"], "write the seconds since"),
        (["1 234 56", "1", "2", "3"], "'1 234 56' is not a number"),
    ],
)
def test_what_may_be_two_numbers_is_refused(tmp_path: Path, cells: list[str], said: str) -> None:
    frame = FRAME.iloc[:4].copy()
    for name in NUMBERS:
        frame[name] = frame[name].round().astype(int)
    frame["leader_speed_mps"] = cells
    frame.to_csv(tmp_path / "t.csv", index=False)
    with pytest.raises(DataError) as error:
        read_tidy(tmp_path / "t.csv")
    assert said in str(error.value)
    assert "column leader_speed_mps" in str(error.value)


@pytest.mark.parametrize(("mark", "speed"), [(",", 11.345), (".", 11345.0)])
def test_other_columns_of_a_file_say_how_it_is_written(
    tmp_path: Path, mark: str, speed: float
) -> None:
    frame = FRAME.iloc[:4].copy()
    for name in NUMBERS:
        frame[name] = [written(number, mark, "", 4) for number in frame[name]]
    frame["leader_speed_mps"] = "11,345"
    frame.to_csv(tmp_path / "t.csv", index=False, sep=";")
    assert read_tidy(tmp_path / "t.csv")[0].leader_speed[0] == speed


def test_a_point_is_refused_where_commas_mark_decimals_elsewhere(tmp_path: Path) -> None:
    frame = FRAME.iloc[:4].copy()
    for name in NUMBERS:
        frame[name] = [written(number, ",", "", 4) for number in frame[name]]
    frame["leader_speed_mps"] = "11.345"
    frame.to_csv(tmp_path / "t.csv", index=False, sep=";")
    with pytest.raises(DataError, match=r"'11\.345' may be 11\.345 or 11345"):
        read_tidy(tmp_path / "t.csv")


@pytest.mark.parametrize(
    "of",
    [
        lambda frames: np.datetime_as_string(
            np.datetime64("2026-03-29T00:59:58", "ms") + 100 * frames, timezone="UTC"
        ),
        lambda frames: [f"2026-03-29 0{k // 600}:59:{k % 600 / 10:04.1f}" for k in frames],
        lambda frames: [f"23:59:{k / 10:04.1f}" for k in frames],
    ],
    ids=["ISO 8601, UTC", "without a zone", "times of day"],
)
def test_dates_and_times_are_seconds(tmp_path: Path, of: object) -> None:
    frame = FRAME.drop(columns="frame")
    frame["time_s"] = of(FRAME["frame"].to_numpy())  # type: ignore[operator] # a function
    frame.to_csv(tmp_path / "t.csv", index=False)
    pairs = read_tidy(tmp_path / "t.csv")
    assert pairs.dt == 0.1
    assert [len(pair) for pair in pairs] == [100, 100]


def test_ids_that_a_spreadsheet_writes_with_decimals_are_the_same(tmp_path: Path) -> None:
    frame = FRAME.assign(leader_id="11,0", follower_id="7.0")
    frame.to_csv(tmp_path / "t.csv", index=False, sep=";")
    pair = read_tidy(tmp_path / "t.csv")[0]
    assert (pair.leader_id, pair.follower_id) == ("11", "7")
    ids = {name: f"{number},000" for number, name in enumerate(FRAME["pair_id"].unique(), start=1)}
    frame["pair_id"] = FRAME["pair_id"].map(ids)
    frame.to_csv(tmp_path / "t.csv", index=False, sep=";")
    assert read_tidy(tmp_path / "t.csv").ids == ["1", "2"]


def test_a_unit_is_refused_where_dates_have_their_own(tmp_path: Path) -> None:
    from cfx.data.tidy import TidyDataset

    frame = FRAME.rename(columns={"time_s": "t"})
    frame["t"] = pd.Timestamp("2026-01-01") + pd.to_timedelta(FRAME["time_s"], unit="s")
    frame.to_parquet(tmp_path / "t.parquet")
    settings = {"columns": {"time": "t"}, "units": {"time": "ms"}, "min_duration": 0}
    with pytest.raises(DataError, match=r"column t: holds timestamp.* leave its unit out"):
        TidyDataset(path=tmp_path / "t.parquet", **settings).load()
