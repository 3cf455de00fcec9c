"""The contract of a dataset, statement by statement."""

from __future__ import annotations

import math

import numpy as np

from cfx.core.contract import once
from cfx.data.base import Dataset, DatasetSettings
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.signals import RECORDED
from cfx.errors import CfxError, DataError
from cfx_contracts import contract_of


def every_number_is_finite(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    for pair in pairs:
        for name in RECORDED:
            assert bool(np.isfinite(getattr(pair, name)).all()), (
                f"{name} of pair {pair.pair_id}: missing data must split the pair,"
                " for a simulation cannot step over them"
            )


def leaders_are_ahead_and_nobody_reverses(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    for pair in pairs:
        assert float(pair.gap.min()) > 0, (
            f"pair {pair.pair_id}: the gap is bumper to bumper, in m, and positive:"
            " nobody drives through another"
        )
        lowest = min(float(pair.leader_speed.min()), float(pair.follower_speed.min()))
        assert lowest >= 0, (
            f"pair {pair.pair_id}: speeds are in m/s and not negative: no model reverses"
        )


def units_are_si(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    for pair in pairs:
        distance = float(pair.leader_position[-1] - pair.leader_position[0])
        integral = float(pair.leader_speed[1:].sum() * pair.dt)
        assert math.isclose(distance, integral, rel_tol=0.2, abs_tol=10.0), (
            f"pair {pair.pair_id}: the leader moves {distance:.1f} m, its speeds sum to"
            f" {integral:.1f} m; give metres and m/s"
        )


def loading_again_gives_the_same(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    assert dataset.load().fingerprint == pairs.fingerprint, (
        "the same settings must give the same pairs: results are cached by them"
    )


def pairs_stack(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    try:
        batch = PairBatch.of(pairs)
    except CfxError as error:
        raise AssertionError(
            f"all pairs of a dataset are simulated in one batch: {error}"
        ) from error
    frames = sum(len(pair) for pair in pairs)
    assert int(batch.mask.sum()) == frames, (
        f"the batch holds {int(batch.mask.sum())} frames of {frames}: every frame counts once"
    )


def max_pairs_keeps_the_first_and_counts_the_rest(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    fewer = _with(dataset, max_pairs=1).load()
    assert [pair.pair_id for pair in fewer] == [pairs[0].pair_id], (
        "max_pairs keeps the first pairs, in the same order, for users to try a job on"
    )
    assert sum(drop.count for drop in fewer.dropped if drop.unit == "pairs") >= len(pairs) - 1, (
        "what is left out must be counted (PairSet.dropped):"
        " users must see on how many pairs a result stands"
    )


def asking_for_too_much_is_an_error(dataset: Dataset) -> None:
    pairs = _loaded(dataset)
    longest = max(pair.duration for pair in pairs)
    said = None
    try:
        _with(dataset, min_duration=2 * longest).load()
    except DataError as error:
        said = str(error)
    assert said is not None, (
        "where no pair is left `load` must raise DataError: no job can go on without pairs"
    )
    assert "min_duration" in said, (
        "where no pair is long enough the DataError must name min_duration, for users to change:"
        f" {said}"
    )


def _loaded(dataset: Dataset) -> PairSet:
    return once(dataset, "pairs", dataset.load)


def _with(dataset: Dataset, **changes: object) -> Dataset:
    settings = dataset.settings
    assert isinstance(settings, DatasetSettings), "a dataset's settings must extend DatasetSettings"
    return type(dataset)(settings.model_copy(update=changes))


CONTRACT = contract_of(__name__, "dataset")
