"""Datasets of several files: which files are meant, and that no driver counts twice."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cfx.data.base import joined
from cfx.data.pairs import Dropped, PairSet
from cfx.data.tidy import TidyDataset, write_tidy
from cfx.errors import ConfigError, DataError
from tests.drives import straight_pairs


def drives(recording: str, *frames: int) -> PairSet:
    pairs = straight_pairs(list(frames))
    length = 4.0 + 0.01 * ord(recording)  # so that no drive is another's copy
    named = (
        replace(p, pair_id=f"{recording}-{k}", recording=recording, leader_length=length)
        for k, p in enumerate(pairs)
    )
    return PairSet(tuple(named), recording)


def written(folder: Path, *sets: PairSet) -> list[Path]:
    folder.mkdir(exist_ok=True)
    files = [folder / f"{pairs.source}.csv" for pairs in sets]
    for pairs, file in zip(sets, files, strict=True):
        write_tidy(pairs, file)
    return files


def test_a_list_and_a_pattern_name_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = written(tmp_path / "day", drives("a", 20, 30), drives("b", 41))
    monkeypatch.chdir(tmp_path)
    listed = TidyDataset(path=["day/b.csv", "day/a.csv"], min_duration=0).load()
    assert [pair.pair_id for pair in listed] == ["b-0", "a-0", "a-1"]
    found = TidyDataset(path="day/*.csv", min_duration=0).load()
    assert [pair.pair_id for pair in found] == ["a-0", "a-1", "b-0"]
    assert found.source == f"2 files ({files[0]}, {files[1]})"
    assert (
        found.fingerprint
        == joined([TidyDataset(path=file, min_duration=0).load() for file in files]).fingerprint
    )
    assert [pair.pair_id for pair in TidyDataset(path="day/[b].csv", min_duration=0).load()] == [
        "b-0"
    ]


def test_what_is_left_out_is_selected_and_counted_over_all_files(tmp_path: Path) -> None:
    files = written(tmp_path, drives("a", 20, 30), drives("b", 20, 41))
    pairs = TidyDataset(path=files, min_duration=3).load()
    assert [pair.pair_id for pair in pairs] == ["a-1", "b-1"]
    assert pairs.dropped == (Dropped("shorter than 3 s", 2),)
    one = PairSet(drives("c", 9).pairs, "one", (Dropped("no leader", 2, "rows"), Dropped("odd", 1)))
    other = PairSet(drives("d", 8).pairs, "other", (Dropped("no leader", 3, "rows"),))
    assert joined([one, other]).dropped == (Dropped("no leader", 5, "rows"), Dropped("odd", 1))


def test_a_name_that_looks_like_a_pattern_is_a_file_where_there_is_one(tmp_path: Path) -> None:
    (file,) = written(tmp_path, replace(drives("a", 20), source="day[1]"))
    assert len(TidyDataset(path=file, min_duration=0).load()) == 1


def test_a_recording_may_go_on_in_another_file(tmp_path: Path) -> None:
    both = drives("a", 20, 30)
    files = written(tmp_path, *(PairSet((pair,), f"part{k}") for k, pair in enumerate(both)))
    assert {pair.recording for pair in TidyDataset(path=files, min_duration=0).load()} == {"a"}


@pytest.mark.parametrize("renamed", [False, True])
def test_a_pair_that_stands_in_two_files_is_refused(tmp_path: Path, renamed: bool) -> None:
    both = drives("a", 20, 30)
    again = (
        replace(both[1], pair_id="other", recording="elsewhere")
        if renamed
        else replace(both[1], leader_length=9.0)
    )
    files = written(tmp_path, both, PairSet((again,), "b"))
    name = "pair 'a-1', there 'other'," if renamed else "pair 'a-1'"
    with pytest.raises(DataError) as error:
        TidyDataset(path=files, min_duration=0).load()
    assert (
        str(error.value)
        == f"{files[0]} and {files[1]}: {name} stands in both files; leave it out of one of them"
    )


def test_which_files_are_meant_is_said_where_it_fails(tmp_path: Path) -> None:
    (file,) = written(tmp_path, drives("a", 20))
    with pytest.raises(DataError, match=r"data\.path=.*\*\.parquet: no file matches this pattern"):
        TidyDataset(path=tmp_path / "*.parquet").load()
    with pytest.raises(DataError, match=r"data\.path: .*a\.csv is named more than once"):
        TidyDataset(path=[file, tmp_path / "*.csv"]).load()
    with pytest.raises(DataError, match=r"nowhere\.csv: no such file"):
        TidyDataset(path=[file, tmp_path / "nowhere.csv"]).load()


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ([], "data.path=[]: the list is empty; write at least one file"),
        ([""], "path: a value is required"),
        (7, "path=7: write a file, a list of files, or a pattern"),
        ([["a"]], "write a file, a list of files"),
    ],
)
def test_what_is_no_path_is_refused(path: Any, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        TidyDataset(path=path)
    assert said in str(error.value)


def test_settings_with_several_files_are_written_without_complaint(tmp_path: Path) -> None:
    settings = TidyDataset(path=[tmp_path / "a", tmp_path / "b"]).settings
    assert json.loads(settings.model_dump_json())["path"] == [
        str(tmp_path / "a"),
        str(tmp_path / "b"),
    ]
    assert json.loads(TidyDataset(path=tmp_path / "a").settings.model_dump_json())["path"] == str(
        tmp_path / "a"
    )
