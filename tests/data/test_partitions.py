"""Folders of parquet files, one recording each."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from cfx.app.sweep.folder import fingerprint
from cfx.data import tidy
from cfx.data.describe import describe
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, read_tidy, write_tidy
from cfx.errors import DataError
from tests.drives import straight_pairs


def recordings() -> PairSet:
    """Returns pairs of three recordings, one of which has a name that no folder can have."""
    found = []
    for number, name in enumerate(("i80", "us 101", "a/b")):
        for pair in straight_pairs([60 + 30 * number, 75 + 30 * number]):
            found.append(replace(pair, recording=name, pair_id=f"{name}-{pair.pair_id}"))
    return PairSet(tuple(found), "test")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Returns a folder as Arrow writes it: the column is in the folders' names alone."""
    write_tidy(recordings(), tmp_path / "all.parquet")
    table = pq.read_table(tmp_path / "all.parquet")
    index = table.schema.get_field_index("recording")
    table = table.set_column(index, "recording", table.column("recording").cast(pa.string()))
    pa.dataset.write_dataset(
        table,
        tmp_path / "pairs",
        format="parquet",
        partitioning=pa.dataset.partitioning(
            pa.schema([("recording", pa.string())]), flavor="hive"
        ),
    )
    return tmp_path / "pairs"


def test_a_folder_holds_what_one_file_does(folder: Path) -> None:
    whole = {pair.pair_id: pair.fingerprint for pair in recordings()}
    found = TidyDataset(path=folder).read()
    assert {pair.pair_id: pair.fingerprint for pair in found} == whole
    assert {pair.recording for pair in found} == {"i80", "us 101", "a/b"}


def test_folders_that_are_links_count_each_once(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "links"
    elsewhere.mkdir()
    for recording in folder.iterdir():
        (elsewhere / recording.name).symlink_to(recording)
    (elsewhere / "again").symlink_to(elsewhere)
    found = TidyDataset(path=elsewhere).read()
    assert {pair.pair_id for pair in found} == {pair.pair_id for pair in recordings()}


def test_a_job_of_a_sweep_is_done_again_when_a_file_of_the_folder_has_changed(folder: Path) -> None:
    values = {"data": {"name": "tidy", "path": str(folder)}, "model": {"name": "krauss"}}
    before = fingerprint(values)
    assert fingerprint(values) == before
    file = next(folder.rglob("*.parquet"))
    os.utime(file, ns=(1, 1))
    assert fingerprint(values) != before


def test_other_recordings_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def counted(path: Path, *further: Any) -> PairSet:
        read.append(path)
        return read_tidy(path, *further)

    monkeypatch.setattr(tidy, "read_tidy", counted)
    found = TidyDataset(path=folder, recording="us 101", min_duration=0).load()
    assert [pair.recording for pair in found] == ["us 101"] * 2
    assert len(read) == 1


def test_an_unknown_recording_and_an_empty_folder_are_said(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"no such recording\. Did you mean 'i80'\? Known: a/b, i80"
    ):
        TidyDataset(path=folder, recording="i-80").load()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="a folder without parquet files"):
        TidyDataset(path=tmp_path / "empty").load()


def test_describe_says_what_each_file_holds(folder: Path) -> None:
    text = describe(folder).text
    assert "3 files, read one after the other" in text
    assert "us 101" in text
    (last,) = [line.split() for line in text.splitlines() if line.startswith("  all ")]
    assert last[1:5] == ["3", "585", "6", "6"]
    assert "data=tidy" in text
