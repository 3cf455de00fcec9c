"""Datasets that read a file keep the contract; one that needs none does so with all components."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.data.tidy import TidyDataset, write_tidy
from cfx.simulation.synthetic import SyntheticDataset
from cfx_contracts import check_contract


def test_noisy_synthetic_recordings_of_another_model() -> None:
    check_contract(
        SyntheticDataset(model="w99", pairs=3, platoon_size=1, frames=150, noise_speed_mps=0.1)
    )


@pytest.mark.parametrize("name", ["pairs.parquet", "pairs.csv", "pairs.csv.gz"])
def test_tidy_tables(name: str, tmp_path: Path) -> None:
    write_tidy(SyntheticDataset(pairs=3, frames=150).load(), tmp_path / name)
    check_contract(TidyDataset(path=tmp_path / name, min_duration=10))


def test_real_pairs(shared_data: Path) -> None:
    path = shared_data / "i80_reconstructed_pairs.parquet"
    check_contract(TidyDataset(path=path, min_duration=100))
