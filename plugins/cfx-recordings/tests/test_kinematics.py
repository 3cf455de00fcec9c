"""Signals of NGSIM's recordings do not contradict one another, in coarse steps either."""

from __future__ import annotations

from pathlib import Path

from cfx.data.kinematics import contradictions
from cfx_recordings.ngsim import NgsimDataset
from tests.data.test_kinematics import check_thinned


def test_a_real_recording_is_let_through(shared_data: Path) -> None:
    path = shared_data / "i80_0400_raw_sample.csv.gz"
    pairs = NgsimDataset(path=path, min_duration=2, check="off", accelerations="recorded").load()
    assert not list(contradictions(pairs))
    check_thinned(pairs)
