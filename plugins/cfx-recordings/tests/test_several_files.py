"""NGSIM's recordings in several files are named apart."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from cfx.errors import DataError
from cfx_recordings.ngsim import NgsimDataset

from .test_ngsim import CLOCK, save, traffic


def moved(clock: int, feet: float) -> pd.DataFrame:
    rows = traffic(clock)
    return rows.assign(Local_Y=rows.Local_Y + feet)


def test_recordings_of_ngsim_files_are_named_apart(tmp_path: Path) -> None:
    """Vehicle 2 of one file is another driver than vehicle 2 of the next."""
    day = 86_400_000
    plain = [
        save(moved(CLOCK + k * day, 1.0 * k), tmp_path / f"0{4 + k}00.txt", "text")
        for k in range(2)
    ]
    pairs = NgsimDataset(path=plain, min_duration=0).load()
    assert [pair.driver for pair in pairs] == ["0400/2", "0400/3", "0500/2", "0500/3"]
    located = [
        save(
            moved(CLOCK + k * day, 1.0 * k).assign(Location="i-80"),
            tmp_path / f"part{k}.csv",
            "csv",
        )
        for k in range(2)
    ]
    pairs = NgsimDataset(path=located, min_duration=0, location="i-80").load()
    assert sorted({pair.recording for pair in pairs}) == ["part0-i-80", "part1-i-80"]
    assert NgsimDataset(path=located[0], min_duration=0).load()[0].recording == "i-80"
    mixed = NgsimDataset(path=[plain[0], located[1]], min_duration=0).load()
    assert sorted({pair.recording for pair in mixed}) == ["0400", "i-80"]


def test_ngsim_files_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    files = []
    for k, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        files.append(save(moved(CLOCK, 1.0 * k), tmp_path / folder / "trajectories.txt", "text"))
    with pytest.raises(
        DataError, match="both recordings would be called 'trajectories'; rename one of the files"
    ):
        NgsimDataset(path=files, min_duration=0).load()
    again = save(moved(CLOCK, 0.0), tmp_path / "copy.txt", "text")
    with pytest.raises(
        DataError, match="pair 'trajectories-2-1', there 'copy-2-1', stands in both files"
    ):
        NgsimDataset(path=[files[0], again], min_duration=0).load()
