"""The contract of a dataset, as tests: subclass `DatasetContract`, fill in the fixture `dataset`, and pytest does the rest."""

from __future__ import annotations

import numpy as np
import pytest

from cfx.datasets.base import Dataset, DatasetSettings
from cfx.errors import DataError
from cfx.pairs import SIGNALS, PairBatch, PairSet


class DatasetContract:
    """What every dataset must hold."""

    @pytest.fixture
    def dataset(self) -> Dataset:
        """Returns the dataset under test, with settings that find at least two pairs."""
        raise NotImplementedError("the subclass of DatasetContract must define the fixture `dataset`")

    @pytest.fixture
    def pairs(self, dataset: Dataset) -> PairSet:
        """Returns what it loads."""
        return dataset.load()

    def test_every_number_is_finite(self, pairs: PairSet) -> None:
        for pair in pairs:
            for name in SIGNALS:
                assert bool(np.isfinite(getattr(pair, name)).all()), (
                    f"{name} of pair {pair.pair_id}: a gap in the data must split the pair"
                )

    def test_leaders_are_ahead_and_nobody_reverses(self, pairs: PairSet) -> None:
        for pair in pairs:
            assert float(pair.gap.min()) > 0, f"pair {pair.pair_id}: the gap is bumper to bumper, in m, and positive"
            lowest = min(float(pair.leader_speed.min()), float(pair.follower_speed.min()))
            assert lowest >= 0, f"pair {pair.pair_id}: speeds are in m/s and not negative"

    def test_units_are_si(self, pairs: PairSet) -> None:
        for pair in pairs:
            driven = float(pair.leader_position[-1] - pair.leader_position[0])
            integral = float(pair.leader_speed[1:].sum() * pair.dt)
            assert driven == pytest.approx(integral, rel=0.2, abs=10.0), (
                f"pair {pair.pair_id}: the leader moves {driven:.1f} m, its speeds sum to {integral:.1f} m; give metres and m/s"
            )

    def test_loading_again_gives_the_same(self, dataset: Dataset, pairs: PairSet) -> None:
        assert dataset.load().fingerprint == pairs.fingerprint, (
            "the same settings must give the same pairs: results are cached by them"
        )

    def test_pairs_stack(self, pairs: PairSet) -> None:
        batch = PairBatch.of(pairs)
        assert len(batch) == len(pairs)
        assert int(batch.mask.sum()) == sum(len(pair) for pair in pairs)

    def test_max_pairs_keeps_the_first_and_counts_the_rest(self, dataset: Dataset, pairs: PairSet) -> None:
        fewer = self._with(dataset, max_pairs=1).load()
        assert [pair.pair_id for pair in fewer] == [pairs[0].pair_id], "max_pairs keeps the first pairs, in the same order"
        assert sum(drop.count for drop in fewer.dropped if drop.unit == "pairs") >= len(pairs) - 1, (
            "what is left out must be counted"
        )

    def test_asking_for_too_much_is_an_error(self, dataset: Dataset, pairs: PairSet) -> None:
        longest = max(len(pair) for pair in pairs)
        with pytest.raises(DataError, match="min_frames"):
            self._with(dataset, min_frames=longest + 1).load()

    @staticmethod
    def _with(dataset: Dataset, **changes: object) -> Dataset:
        settings = dataset.settings
        assert isinstance(settings, DatasetSettings), "a dataset's settings must extend DatasetSettings"
        return type(dataset)(settings.model_copy(update=changes))
