"""Public recordings are known by their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.data.tidy import TidyDataset
from cfx.errors import DataError
from tests.data.test_sites import a_pair, written


def test_several_files_say_their_sites_and_cars(tmp_path: Path) -> None:
    """Two files of I-80 are one road; a car of OpenACC is one car in all of its files."""
    files = (
        written(tmp_path, "one", a_pair("i80-0400", "3")),
        written(tmp_path, "lane", a_pair("i80-0400-hov", "7", speed=11.0)),
        written(tmp_path, "vc", a_pair("openacc-vicolungo-part1", "2-Kia", "acc", speed=12.0)),
        written(tmp_path, "mine", a_pair("mine-1", "4", speed=13.0)),
    )
    pairs = TidyDataset(path=files, min_duration=0).load()
    assert [pair.site for pair in pairs] == ["I-80", "I-80", "Vicolungo", "mine"]
    assert [pair.vehicle for pair in pairs] == ["", "", "Kia", ""]
    named = TidyDataset(path=files, min_duration=0, site={"i80*": "A", "*": "B"}).load()
    assert [pair.site for pair in named] == ["A", "A", "B", "B"]


def test_people_of_ngsim_are_people(tmp_path: Path) -> None:
    """Labels of the file hold where there are some; unknown recordings stay unlabelled."""
    file = written(
        tmp_path,
        "all",
        a_pair("i80-0400", "3"),
        a_pair("openacc-ispra-1", "2-Kia", "acc", speed=12.0),
        a_pair("mine-1", "4", speed=13.0),
    )
    pairs = TidyDataset(path=file, min_duration=0, driver_type="human").load()
    assert [pair.recording for pair in pairs] == ["i80-0400"]
    assert TidyDataset(path=file, min_duration=0).load()[0].driver_type == ""
    with pytest.raises(DataError, match="does not say what drives"):
        TidyDataset(
            path=written(tmp_path, "own", a_pair("mine-1", "4")),
            min_duration=0,
            driver_type="human",
        ).load()
