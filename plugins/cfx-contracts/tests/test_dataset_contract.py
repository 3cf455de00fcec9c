"""Each statement of the contract fails for a dataset that breaks it, and says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cfx.data.base import Dataset, DatasetSettings
from cfx.data.pairs import Pair, PairSet
from cfx.errors import PluginError
from cfx_contracts import datasets as checks
from tests.drives import straight_pairs


class Straight(Dataset):
    """Two pairs at constant speed, which a subclass spoils."""

    def read(self) -> PairSet:
        pairs = straight_pairs([900, 800])
        return PairSet(tuple(self.spoil(pair) for pair in pairs), "test")

    def spoil(self, pair: Pair) -> Pair:
        return pair


def spoiled(change: Callable[[Pair], Pair]) -> Dataset:
    return type("Spoiled", (Straight,), {"spoil": lambda self, pair: change(pair)})(check="off")


def with_gap(pair: Pair) -> Pair:
    speed = pair.follower_speed.copy()
    speed[5] = np.nan
    return replace(pair, follower_speed=speed)


class Growing(Straight):
    reads = 0

    def spoil(self, pair: Pair) -> Pair:
        type(self).reads += 1
        return replace(pair, follower_speed=pair.follower_speed + self.reads)


class Everything(Straight):
    """Selects nothing."""

    def load(self) -> PairSet:
        return self.read()


class Selecting(Straight):
    """Selects on its own, and counts nothing."""

    def load(self) -> PairSet:
        settings = self.settings
        assert isinstance(settings, DatasetSettings)
        return PairSet(tuple(self.read())[: settings.max_pairs], "test")


class Silent(Straight):
    def load(self) -> PairSet:
        from cfx.errors import DataError

        if self.settings.min_duration > 90:
            raise DataError("no pairs")
        return super().load()


def two_time_steps(pair: Pair) -> Pair:
    return replace(
        pair,
        dt=0.1 if pair.pair_id == "p0" else 0.2,
        leader_speed=pair.leader_speed / (1 + (pair.pair_id == "p1")),
    )


AHEAD = checks.leaders_are_ahead_and_nobody_reverses
BROKEN: dict[str, tuple[Dataset, Any, str]] = {
    "NaN": (spoiled(with_gap), checks.every_number_is_finite, "splits or leaves out what has gaps"),
    "behind": (
        spoiled(lambda p: replace(p, leader_position=p.leader_position - 30)),
        AHEAD,
        "bumper to bumper",
    ),
    "reversing": (
        spoiled(lambda p: replace(p, leader_speed=-p.leader_speed)),
        AHEAD,
        "not negative",
    ),
    "km/h": (
        spoiled(lambda p: replace(p, leader_speed=3.6 * p.leader_speed)),
        checks.units_are_si,
        "give metres and m/s",
    ),
    "growing": (Growing(check="off"), checks.loading_again_gives_the_same, "results are cached by them"),
    "two time steps": (spoiled(two_time_steps), checks.pairs_stack, "simulated in one batch"),
    "everything": (
        Everything(),
        checks.max_pairs_keeps_the_first_and_counts_the_rest,
        "keeps the first pairs",
    ),
    "selecting": (
        Selecting(),
        checks.max_pairs_keeps_the_first_and_counts_the_rest,
        "must be counted",
    ),
    "too much": (Everything(), checks.asking_for_too_much_is_an_error, "must raise DataError"),
    "silent": (Silent(), checks.asking_for_too_much_is_an_error, "must name min_duration"),
}  # fmt: skip


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    # A PluginError is the sentence with which `load` itself refuses what no simulation could use.
    with pytest.raises((AssertionError, PluginError), match=sentence):
        check(component)


def test_every_statement_has_a_dataset_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


@pytest.mark.parametrize("check", checks.CONTRACT.checks)
def test_a_sound_dataset_holds_it(check: Any) -> None:
    check(Straight())
