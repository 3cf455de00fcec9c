"""A job reads the further signals that its policy's inputs need, or says what is missing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import cfx
from cfx.app.job.surroundings import require_signals, with_signals_of_inputs
from cfx.app.overrides import config_of
from cfx.data.pairs import PairSet
from cfx.data.tidy import write_tidy
from cfx.errors import DataError
from cfx.policies.gru import GruPolicy
from cfx.simulation.synthetic import SyntheticDataset
from tests.further import RAIN, known_inputs, with_surroundings

PAIRS = with_surroundings(SyntheticDataset(pairs=4, frames=300).load())


@pytest.fixture(autouse=True)
def _inputs() -> Iterator[None]:
    with known_inputs():
        yield


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_tidy(PAIRS, tmp_path / "rainy.parquet")
    return tmp_path / "rainy.parquet"


def inputs_read(**settings: Any) -> list[str]:
    """Returns the inputs whose signals a job with these settings reads."""
    given = {key.replace("__", "."): value for key, value in settings.items()}
    return list(with_signals_of_inputs(config_of(given)).data.get("inputs", []))


def test_the_dataset_reads_what_the_inputs_need(recording: Path) -> None:
    tidy = {"data": "tidy", "data.path": str(recording)}
    assert inputs_read(**tidy) == []
    assert inputs_read(**tidy, policy__inputs=["speeds", "gap"]) == []
    assert inputs_read(**tidy, policy__inputs=["speeds", "rain"]) == ["rain"]
    both = {"policy__inputs": ["rain", "second_leader"], "data__inputs": ["second_leader"]}
    assert inputs_read(**tidy, **both) == ["second_leader", "rain"]
    assert inputs_read(data="synthetic", policy__inputs=["rain"]) == []


def test_pairs_without_the_signal_are_refused() -> None:
    policy = GruPolicy(inputs=("speeds", "rain"))
    require_signals(policy, PAIRS)
    dry = PairSet(tuple(SyntheticDataset(pairs=2, frames=300).load()), "dry.parquet")
    with pytest.raises(
        DataError,
        match=r"dry.parquet: the policy's input 'rain' reads the signal 'rain', which .*"
        r"column rain_mmph by data=tidy data.inputs=\[rain\]",
    ):
        require_signals(policy, dry)


def test_pairs_from_python_keep_further_signals(recording: Path, tmp_path: Path) -> None:
    pairs = cfx.read(recording, dataset="tidy", inputs=["rain"], min_duration=0)
    assert pairs.selected.surroundings == (RAIN,)
    again = pairs.save(tmp_path / "again.csv")
    assert [pair.fingerprint for pair in again.selected] == [
        pair.fingerprint for pair in pairs.selected
    ]
    assert cfx.read(pairs.frame, inputs=["rain"], min_duration=0).selected.surroundings == (RAIN,)
