"""What would fill the memory lies in files, and nothing else changes by it."""

from __future__ import annotations

import errno
import gc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil  # type: ignore[import-untyped]  # it ships no types
import pytest
import torch

import cfx
from cfx.core import memory
from cfx.data import style, tidy
from cfx.data.base import joined
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.resampling import resampled, scaled
from cfx.data.tidy import read_tidy, write_tidy
from cfx.errors import OutputError
from cfx.evaluation import closed_loop, evaluate, result
from cfx.simulation.synthetic import SyntheticDataset

JOB = (
    "debug=quick",
    "data.platoon_size=1",
    "figures=none",
    "tracking.enabled=false",
    "cache.enabled=false",
)


@pytest.fixture(autouse=True)
def _fresh_garbage() -> None:
    """Spares the garbage collector what other tests have left, which takes it half a second."""
    gc.freeze()


def maps() -> int:
    gc.collect()
    return len(memory._maps)


def test_small_arrays_lie_in_memory_and_large_ones_in_a_file_that_goes_with_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = maps()
    monkeypatch.setattr(memory, "LARGE", 1000)
    small = memory.empty((100,))
    assert maps() == before
    several = memory.empty((100,), together=2)
    large = memory.empty((4, 100), np.float32)
    assert maps() == before + 2
    assert (small.shape, several.shape, large.shape) == ((100,), (100,), (4, 100))
    assert large.dtype == np.float32
    del several, large
    assert maps() == before


def test_what_is_released_is_read_again_and_counts_no_more() -> None:
    array = memory.in_file((1 << 22,))
    array[:] = np.arange(len(array))
    process = psutil.Process()
    full = process.memory_info().rss
    memory.release()
    assert process.memory_info().rss < full - array.nbytes // 2
    assert array[12345] == 12345
    assert array.sum() == len(array) * (len(array) - 1) / 2


def test_a_full_disk_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_file: int, _size: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(memory, "_reserve", full)
    with pytest.raises(OutputError, match=r"has no room for 80 bytes .* set TMPDIR"):
        memory.in_file((10,))


def pairs_of_drivers() -> PairSet:
    return SyntheticDataset(pairs=6, frames=80, variation=0.3).read()


def test_pairs_in_a_file_are_the_same_pairs() -> None:
    pairs = pairs_of_drivers()
    stored = pairs.in_file()
    assert stored.fingerprint == pairs.fingerprint
    for pair, original in zip(stored, pairs, strict=True):
        assert pair.truth.keys() == original.truth.keys()
        for name, values in original.truth.items():
            assert np.array_equal(pair.truth[name], values)


def test_pairs_of_several_files_that_are_too_many_lie_in_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = pairs_of_drivers(), SyntheticDataset(pairs=6, frames=80, seed=1).read()
    renamed = [replace(pair, pair_id=f"b{pair.pair_id}") for pair in second]
    parts = [first, PairSet(tuple(renamed), "second")]
    monkeypatch.setattr(memory, "LARGE", first.size + 1)
    before = maps()
    together = joined(iter(parts))
    assert maps() == before + 2
    assert [pair.fingerprint for pair in together] == [
        pair.fingerprint for part in parts for pair in part
    ]


def test_changed_pairs_lie_in_files_too(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = pairs_of_drivers()
    expected = scaled(pairs, 2.0), resampled(pairs, 0.2)
    monkeypatch.setattr(memory, "LARGE", 1)
    before = maps()
    found = scaled(pairs, 2.0), resampled(pairs, 0.2)
    assert maps() == before + 2
    for one, other in zip(found, expected, strict=True):
        assert one.fingerprint == other.fingerprint


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_batch_in_files_is_the_same_batch(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = pairs_of_drivers()
    expected = PairBatch.of(pairs, dtype=dtype)
    monkeypatch.setattr(memory, "LARGE", 1)
    found = PairBatch.of(pairs, dtype=dtype)
    for name in ("leader_position", "follower_speed", "mask", "lengths"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    some = torch.tensor([4, 1])
    before = maps()
    chosen = found[some]
    assert maps() > before
    assert torch.equal(chosen.gap, expected[some].gap)


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".csv.gz"])
def test_tidy_files_are_written_in_parts(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = pairs_of_drivers()
    monkeypatch.setattr(tidy, "_PAIRS_AT_ONCE", 4)
    write_tidy(pairs, tmp_path / f"pairs{suffix}")
    found = read_tidy(tmp_path / f"pairs{suffix}")
    assert found.fingerprint == pairs.fingerprint
    assert [pair.truth_model for pair in found] == [pair.truth_model for pair in pairs]


@pytest.mark.parametrize(
    "protocol", ["within_driver", pytest.param("across_drivers", marks=pytest.mark.slow)]
)
def test_a_job_in_files_and_in_parts_has_the_same_results(
    protocol: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    overrides = (*JOB, "data.max_pairs=6", "data.frames=200", f"protocol={protocol}")
    expected = cfx.run([*overrides, "hydra.run.dir=whole"])
    monkeypatch.setattr(memory, "LARGE", 1)
    for module in (closed_loop, evaluate):
        monkeypatch.setattr(module, "PAIRS_AT_ONCE", 4)
    for module, name in ((result, "_PAIRS_AT_ONCE"), (style, "_PAIRS_AT_ONCE")):
        monkeypatch.setattr(module, name, 4)
    monkeypatch.setattr(result, "_ROWS_AT_ONCE", 100)
    before = maps()
    found = cfx.run([*overrides, "hydra.run.dir=parts"])
    assert maps() > before
    for name, value in expected.metrics.items():
        assert found.metrics[name] == pytest.approx(value, rel=1e-9, nan_ok=True), name
    for file in ("pair_metrics.parquet", "trajectories.parquet"):
        pd.testing.assert_frame_equal(table(found, file), table(expected, file))


def table(job: cfx.plugin.Result, file: str) -> Any:
    return pd.read_parquet(job.folder / file)
