"""NGSIM's reader keeps the contract of datasets."""

from __future__ import annotations

from pathlib import Path

from cfx_contracts import check_contract
from cfx_recordings.ngsim import NgsimDataset


def test_real_ngsim(shared_data: Path) -> None:
    path = shared_data / "i80_0400_raw_sample.csv.gz"
    check_contract(NgsimDataset(path=path, min_duration=65))
