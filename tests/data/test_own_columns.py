"""A file's own names of columns and units give the pairs that the tidy layout gives."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from cfx.app import cli
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, TidySettings, frame_of, pairs_from_frame
from cfx.errors import ConfigError, DataError
from cfx.models.krauss import Krauss
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8], [1.5, 0.2]], dtype=torch.float64)
PAIRS = wavy_pairs(Krauss(), TRUE, 300)

COLUMNS = {
    "speed": "v_kmh",
    "leader_speed": "v of leader",
    "gap": "net",
    "time": "ms",
    "pair_id": "trip",
}
UNITS = {"speed": "km/h", "gap": "ft", "time": "ms"}


def table() -> pd.DataFrame:
    """Pairs as their owner has them: gaps in feet, speeds in km/h, times in ms."""
    frame = frame_of(PAIRS)
    rear = frame["leader_position_m"] - frame["leader_length_m"]
    own = frame[["recording", "leader_id", "follower_id", "frame"]].copy()
    own["trip"] = frame["pair_id"]
    own["ms"] = frame["time_s"] * 1000
    own["v_kmh"] = frame["follower_speed_mps"] * 3.6
    own["v of leader"] = frame["leader_speed_mps"] * 3.6
    own["net"] = (rear - frame["follower_position_m"]) / 0.3048
    return own


def written(tmp_path: Path, frame: pd.DataFrame | None = None) -> Path:
    path = tmp_path / "own.csv"
    (table() if frame is None else frame).to_csv(path, index=False)
    return path


def load(path: Path, **more: object) -> PairSet:
    settings = {"columns": COLUMNS, "units": UNITS, "min_duration": 10, **more}
    return TidyDataset(path=path, **settings).load()


def test_the_pairs_are_those_of_the_layout(tmp_path: Path) -> None:
    for name in ("own.csv", "own.parquet"):
        path = tmp_path / name
        if name.endswith("csv"):
            table().to_csv(path, index=False)
        else:
            table().to_parquet(path, index=False)
        found = load(path)
        assert [pair.pair_id for pair in found] == [pair.pair_id for pair in PAIRS]
        for one, other in zip(found, PAIRS, strict=True):
            assert one.dt == other.dt
            for signal in ("follower_speed", "leader_speed", "gap"):
                np.testing.assert_allclose(getattr(one, signal), getattr(other, signal), rtol=1e-9)


def test_names_and_frames_may_be_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    short = table().drop(columns=["recording", "leader_id", "follower_id", "frame"])
    found = load(written(tmp_path, short.sample(frac=1.0, random_state=0)))
    by_name = {pair.pair_id: pair for pair in found}
    for other in PAIRS:
        one = by_name[other.pair_id]
        np.testing.assert_allclose(one.gap, other.gap, rtol=1e-9)
        assert (one.recording, one.first_frame) == ("own", other.first_frame)
    assert len({pair.driver for pair in found}) == len(PAIRS)
    assert not {pair.leader_id for pair in found} & {pair.follower_id for pair in found}
    assert "each pair counts as a driver of its own" in caplog.text


def test_a_time_that_stands_twice_is_refused_without_frames(tmp_path: Path) -> None:
    short = table().drop(columns="frame")
    with pytest.raises(DataError, match="time does not advance"):
        load(written(tmp_path, pd.concat([short, short.iloc[[5]]])))


def test_a_table_is_read_as_a_file(tmp_path: Path) -> None:
    layout = TidySettings(path="own.csv", columns=COLUMNS, units=UNITS).own_layout()
    found = pairs_from_frame(table(), layout=layout)
    from_file = TidyDataset(path=written(tmp_path), columns=COLUMNS, units=UNITS).read()
    for one, other in zip(found, from_file, strict=True):
        np.testing.assert_array_equal(one.gap, other.gap)


def test_the_command_line_takes_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path)
    words = [f"data.columns.{name}='{called}'" for name, called in COLUMNS.items()]
    words += [f"data.units.{name}={unit}" for name, unit in UNITS.items()]
    assert cli.main(["data", "describe", str(path), *words]) == 0
    text = capsys.readouterr().out
    assert "length 0" not in text, "the leaders' length does no harm where gaps are given"
    assert "contradict" not in text
    assert re.search(r"pairs +4 of 4 drivers, 1,200 frames", text)
    use = next(line for line in text.splitlines() if line.startswith("Use it: "))
    assert "data.units.speed=km/h" in use
    assert "'data.columns.leader_speed='" in use


@pytest.mark.parametrize("unit", ["mph", "m/s"])
def test_a_wrong_unit_is_caught_by_the_gaps(tmp_path: Path, unit: str) -> None:
    with pytest.raises(DataError, match=f"speeds look like km/h, not {unit}.*data.units"):
        load(written(tmp_path), units={**UNITS, "speed": unit})


@pytest.mark.parametrize("unit", ["mph", "m/s", "ft/s", "kn"])
def test_a_wrong_unit_is_caught_by_the_positions(tmp_path: Path, unit: str) -> None:
    frame = frame_of(PAIRS)
    frame["v"] = frame.pop("follower_speed_mps") * 3.6
    path = written(tmp_path, frame)
    assert len(load(path, columns={"speed": "v"}, units={"speed": "km/h"})) == len(PAIRS)
    with pytest.raises(DataError, match=f"speeds look like km/h, not {unit}.*data.units"):
        load(path, columns={"speed": "v"}, units={"speed": unit})


@pytest.mark.parametrize(
    ("columns", "units", "said"),
    [
        ({}, {"speed": "kmh"}, "data.units.speed='kmh': there is no unit 'kmh'; write for"),
        ({}, {"speed": "kg"}, "'kg' cannot be turned into m/s; write for instance m/s, km/h"),
        ({"speed": None}, {"speed": "km/h"}, "follower_speed_mps is in m/s, as its name says"),
        ({"gap": "v_kmh"}, {}, "the column v_kmh would be both speed and gap"),
        ({"velocity": "v_kmh"}, {}, "data.columns.velocity: unknown key"),
        ({"gap": ""}, {}, "data.columns.gap=''"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(
    tmp_path: Path, columns: dict[str, str], units: dict[str, str], said: str
) -> None:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, columns={**COLUMNS, **columns}, units={**UNITS, **units})
    assert said in str(error.value)


def test_messages_name_the_files_own_columns(tmp_path: Path) -> None:
    path = written(tmp_path)
    with pytest.raises(DataError, match=r"column v_kmph is missing. Did you mean 'v_kmh'"):
        load(path, columns={**COLUMNS, "speed": "v_kmph"})
    frame = table()
    frame.loc[7, "v_kmh"] = np.nan
    with pytest.raises(DataError, match=r"row 9, column v_kmh \(pair .*: the cell is empty"):
        load(written(tmp_path, frame))
    frame = table()
    frame.loc[7, "ms"] = 0.0
    with pytest.raises(DataError, match=r"column ms .*: time does not advance"):
        load(written(tmp_path, frame))
    with pytest.raises(DataError, match="column lane_number is missing"):
        load(path, columns={**COLUMNS, "lane": "lane_number"})
