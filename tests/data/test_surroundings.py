"""Further signals go wherever pairs go."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.data.resampling import resampled, scaled
from cfx.data.signals import SIGNALS, Signal, further_signals
from cfx.data.tidy import TidyDataset, frame_of, write_tidy
from cfx.errors import DataError, PluginError
from tests.drives import straight_pairs
from tests.further import RAIN, SECOND_GAP, SECOND_SPEED, known_inputs, with_surroundings

PAIRS = with_surroundings(straight_pairs((60, 40, 50)))
FURTHER = (RAIN, SECOND_GAP, SECOND_SPEED)


@pytest.mark.parametrize("signal", FURTHER, ids=lambda signal: signal.name)
def test_each_further_signal_is_part_of_what_identifies_a_pair(signal: Signal) -> None:
    pair: Pair = PAIRS[0]
    changed = {**pair.surroundings, signal: pair.surroundings[signal] + 1e-9}
    assert replace(pair, surroundings=changed).fingerprint != pair.fingerprint
    renamed = {replace(signal, meaning="other"): pair.surroundings[signal]}
    assert replace(pair, surroundings=renamed).fingerprint != pair.fingerprint


def test_signals_of_other_lengths_are_refused() -> None:
    with pytest.raises(DataError, match="'rain': \\(3,\\)"):
        replace(PAIRS[0], surroundings={RAIN: np.zeros(3)})


def test_pairs_must_have_the_same_further_signals() -> None:
    pairs = replace(PAIRS, pairs=(PAIRS[0], replace(PAIRS[1], surroundings={})))
    with pytest.raises(DataError, match="pair p1 has other further signals"):
        PairBatch.of(pairs)


def test_batches_take_further_signals_along() -> None:
    batch = PairBatch.of(PAIRS)
    some = batch[torch.tensor([2, 1])].trimmed()
    for signal in FURTHER:
        stored = batch.surroundings[signal]
        assert torch.equal(some.surroundings[signal], stored[[2, 1], :50])
        assert torch.equal(
            batch.until(torch.tensor([9, 9, 9])).surroundings[signal], stored[:, :10]
        )
        both = batch.followed_by(batch[:1])
        assert torch.equal(both.surroundings[signal][3], stored[0])
    with pytest.raises(DataError, match="with and without the signal rain"):
        batch.followed_by(PairBatch.of(straight_pairs((60,))))


def test_batches_store_what_is_ahead_as_a_position() -> None:
    """So a simulated follower who is elsewhere sees another gap, in the same surroundings."""
    batch = PairBatch.of(PAIRS)
    stored = batch.surroundings[SECOND_GAP]
    seen = SECOND_GAP.seen_from(batch.follower_position, stored)
    measured = torch.as_tensor(PAIRS[0].surroundings[SECOND_GAP])
    torch.testing.assert_close(seen[0], measured)
    torch.testing.assert_close(
        SECOND_GAP.seen_from(batch.follower_position + 2.0, stored), seen - 2
    )
    assert bool(stored.isfinite().all())
    beyond = stored[1, 40:] - stored[1, 39]
    torch.testing.assert_close(beyond, torch.arange(1, 21).double())  # 10 m/s in steps of 0.1 s
    assert bool((batch.surroundings[RAIN][1, 40:] == batch.surroundings[RAIN][1, 39]).all())


def test_other_steps_and_scales_change_further_signals_too() -> None:
    (slow, *_) = resampled(PAIRS, 0.2)
    for signal in FURTHER:
        np.testing.assert_allclose(
            slow.surroundings[signal], PAIRS[0].surroundings[signal][::2], rtol=1e-9
        )
    (large, *_) = scaled(PAIRS, 1.5)
    np.testing.assert_array_equal(large.surroundings[RAIN], PAIRS[0].surroundings[RAIN])
    for signal in (SECOND_GAP, SECOND_SPEED):
        np.testing.assert_allclose(large.surroundings[signal], 1.5 * PAIRS[0].surroundings[signal])


def test_the_beginning_of_a_pair_has_as_much_of_each_signal() -> None:
    part = PAIRS[0].beginning(7)
    for signal in FURTHER:
        np.testing.assert_array_equal(part.surroundings[signal], PAIRS[0].surroundings[signal][:7])
    assert len(part) == 7
    assert PAIRS[1].beginning(50).fingerprint == PAIRS[1].fingerprint


def test_pairs_in_files_have_the_same_further_signals() -> None:
    assert PAIRS.in_file().fingerprint == PAIRS.fingerprint
    assert PAIRS.size == 9 * 8 * 150


def test_a_tidy_file_holds_the_signals_of_the_inputs_that_are_named(tmp_path: Path) -> None:
    path = tmp_path / "pairs.parquet"
    write_tidy(PAIRS, path)
    with known_inputs():
        dataset = TidyDataset(path=path, min_duration=0, inputs=("rain", "second_leader"))
        read = dataset.read()
        assert [pair.fingerprint for pair in read] == [pair.fingerprint for pair in PAIRS]
        assert TidyDataset(path=path, min_duration=0).read().surroundings == ()
        frame_of(PAIRS).drop(columns="rain_mmph").to_parquet(path)
        with pytest.raises(DataError, match=f"{path}: column rain_mmph is missing"):
            dataset.read()


def test_a_value_outside_of_the_range_of_a_signal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    frame: pd.DataFrame = frame_of(PAIRS)
    frame.loc[3, "rain_mmph"] = 250.0
    frame.to_csv(path, index=False)
    with (
        known_inputs(),
        pytest.raises(DataError, match="250 is no possible rainfall, which is 0 to"),
    ):
        TidyDataset(path=path, min_duration=0, inputs=("rain",)).read()


def test_one_name_is_one_signal() -> None:
    with pytest.raises(PluginError, match=r"'rain' .* is declared in two ways"):
        further_signals([RAIN, replace(RAIN, unit="m/s")])
    with pytest.raises(PluginError, match="is declared in two ways, also as 'leader_speed'"):
        further_signals([replace(SECOND_SPEED, column="leader_speed_mps")])
    with pytest.raises(PluginError, match="must belong to the surroundings"):
        further_signals([replace(RAIN, belongs_to="follower")])
    assert further_signals([*SIGNALS.values(), RAIN, RAIN]) == (RAIN,)
    assert isinstance(PAIRS, PairSet)
