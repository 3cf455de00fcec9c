"""Every built-in dataset holds the contract."""

from __future__ import annotations

from pathlib import Path

import pytest

from cfx.contracts import DatasetContract
from cfx.data.base import Dataset
from cfx.data.ngsim import NgsimDataset
from cfx.data.tidy import TidyDataset, write_tidy
from cfx.simulation.synthetic import SyntheticDataset


class TestSynthetic(DatasetContract):
    @pytest.fixture(params=["krauss", "w99"])
    def dataset(self, request: pytest.FixtureRequest) -> Dataset:
        return SyntheticDataset(model=request.param, pairs=3, frames=150, noise_speed_mps=0.1)


class TestTidy(DatasetContract):
    @pytest.fixture(params=["pairs.parquet", "pairs.csv", "pairs.csv.gz"])
    def dataset(self, request: pytest.FixtureRequest, tmp_path: Path) -> Dataset:
        path = tmp_path / request.param
        write_tidy(SyntheticDataset(pairs=3, frames=150).load(), path)
        return TidyDataset(path=path, min_frames=100)


class TestRealTidy(DatasetContract):
    @pytest.fixture
    def dataset(self, shared_data: Path) -> Dataset:
        return TidyDataset(path=shared_data / "i80_reconstructed_pairs.parquet", min_frames=1000)


class TestRealNgsim(DatasetContract):
    @pytest.fixture
    def dataset(self, shared_data: Path) -> Dataset:
        return NgsimDataset(path=shared_data / "i80_0400_raw_sample.csv.gz", min_frames=650)
