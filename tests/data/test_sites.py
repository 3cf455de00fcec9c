"""Sites of recordings, and vehicles that are in several of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cfx.data.pairs import Pair, PairSet
from cfx.data.tidy import TidyDataset, read_tidy, write_tidy
from cfx.errors import ConfigError, DataError


def a_pair(recording: str, follower: str, kind: str = "", speed: float = 10.0) -> Pair:
    same = np.full(20, speed)
    drive = np.arange(1, 21) * 0.1 * speed
    nothing = np.zeros(20)
    return Pair(
        f"{recording}-{follower}",
        recording,
        "1-Leader",
        follower,
        0,
        0.1,
        5.0,
        drive + 30,
        same,
        nothing,
        drive,
        same,
        nothing,
        driver_type=kind,
    )


def written(folder: Path, name: str, *pairs: Pair) -> Path:
    path = folder / f"{name}.parquet"
    write_tidy(PairSet(pairs, name), path)
    return path


def loaded(*paths: Path, **options: Any) -> PairSet:
    return TidyDataset(path=[str(path) for path in paths], min_duration=0, **options).load()


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    road = written(tmp_path, "road", a_pair("road-am", "7"), a_pair("road-pm", "8", speed=11))
    track = written(
        tmp_path,
        "track",
        a_pair("lap1", "2-Kia", "acc", speed=12),
        a_pair("lap2", "3-Kia", speed=13),
    )
    return road, track


def test_sites_are_those_of_the_column_when_there_is_one(tmp_path: Path) -> None:
    pair = replace(a_pair("lap1", "2-Kia"), site="a track", vehicle="the Kia")
    path = written(tmp_path, "file", pair)
    again = read_tidy(path)[0]
    assert (again.site, again.vehicle) == ("a track", "the Kia")


def test_of_several_files_each_is_a_site(files: tuple[Path, Path]) -> None:
    assert [pair.site for pair in loaded(*files)] == ["road", "road", "track", "track"]
    assert {pair.site for pair in loaded(files[0])} == {""}


def test_sites_are_named_by_patterns_of_recordings_and_files(files: tuple[Path, Path]) -> None:
    names = {"road-pm": "evening", "road*": "road", "track": "the track"}
    found = [pair.site for pair in loaded(*files, site=names)]
    assert found == ["road", "evening", "the track", "the track"]
    assert {pair.site for pair in loaded(*files, site="here")} == {"here"}


@pytest.mark.parametrize(
    ("site", "said"),
    [
        ({"road*": "road"}, "no pattern fits lap1, lap2"),
        ({"*": "all", "lap3": "track"}, "'lap3' fits no recording"),
    ],
)
def test_patterns_that_do_not_fit_are_refused(
    files: tuple[Path, Path], site: dict[str, str], said: str
) -> None:
    with pytest.raises(DataError, match=said):
        loaded(*files, site=site)


def test_a_vehicle_is_one_driver_with_cruise_control_and_another_without(
    files: tuple[Path, Path],
) -> None:
    pairs = loaded(files[1], vehicle="^[0-9]+-(.+)$")
    assert [pair.vehicle for pair in pairs] == ["Kia", "Kia"]
    assert [pair.driver for pair in pairs] == ["Kia (acc)", "Kia"]
    assert [pair.driver for pair in loaded(files[1])] == ["lap1/2-Kia", "lap2/3-Kia"]


@pytest.mark.parametrize("pattern", ["(", "Kia", "(a)(b)"])
def test_a_pattern_of_vehicles_has_one_group(files: tuple[Path, Path], pattern: str) -> None:
    with pytest.raises(ConfigError, match="vehicle"):
        loaded(files[1], vehicle=pattern)


def test_a_pattern_that_fits_no_vehicle_is_refused(files: tuple[Path, Path]) -> None:
    with pytest.raises(DataError, match=r"fits no follower's id.*2-Kia"):
        loaded(files[1], vehicle="^(Volvo)")
