"""Selecting pairs: the same for every dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from cfx.core.component import Settings
from cfx.data.base import Dataset, DatasetSettings, FileDatasetSettings
from cfx.data.pairs import Dropped, Pair, PairSet
from cfx.data.tidy import TidyDataset
from cfx.errors import ConfigError, DataError


def a_pair(name: str, frames: int, recording: str = "r", lane: int | None = None) -> Pair:
    drive = np.arange(frames) * 1.0
    same = np.full(frames, 10.0)
    return Pair(
        name,
        recording,
        "1",
        name,
        0,
        0.1,
        5.0,
        drive + 30,
        same,
        0 * same,
        drive,
        same,
        0 * same,
        lane=lane,
    )


PAIRS = PairSet(
    (
        a_pair("a", 10),
        a_pair("b", 30, lane=2),
        a_pair("c", 40, lane=3),
        a_pair("d", 50, "other", lane=3),
    ),
    "made up",
    (Dropped("of no use", 7, "rows"),),
)


class Ready(Dataset):
    schema: ClassVar[type[Settings]] = DatasetSettings
    pairs = PAIRS

    def read(self) -> PairSet:
        return self.pairs


def names(dataset: Dataset) -> list[str]:
    return [pair.pair_id for pair in dataset.load()]


def test_keeps_what_is_long_enough_counts_the_rest_and_warns_of_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    kept = Ready(min_duration=3).load()
    assert [pair.pair_id for pair in kept] == ["b", "c", "d"]
    assert caplog.messages == [
        "made up: 1 of 4 pairs are left out, which last less than data.min_duration=3 s;"
        " data.min_duration=1 keeps all"
    ]
    assert kept.dropped == (Dropped("of no use", 7, "rows"), Dropped("shorter than 3 s", 1))


def test_keeps_the_first_max_pairs_and_counts_the_rest() -> None:
    kept = Ready(min_duration=0, max_pairs=3).load()
    assert [pair.pair_id for pair in kept] == ["a", "b", "c"]
    assert kept.dropped[-1] == Dropped("beyond max_pairs (3)", 1)


def test_selects_a_recording_and_lanes() -> None:
    assert names(Ready(min_duration=0, recording="other")) == ["d"]
    assert names(Ready(min_duration=0, lanes=[3])) == ["c", "d"]
    assert names(Ready(min_duration=0, lanes=[2, 3], recording="r")) == ["b", "c"]


def test_selects_pairs_by_their_ids() -> None:
    kept = Ready(min_duration=0, pair_ids=["d", "b"]).load()
    assert [pair.pair_id for pair in kept] == ["b", "d"]
    assert kept.dropped[-1] == Dropped("other pairs than data.pair_ids", 2)


def test_every_pair_is_kept_or_counted() -> None:
    kept = Ready(min_duration=3, lanes=[3], max_pairs=1).load()
    assert len(kept) + sum(d.count for d in kept.dropped if d.unit == "pairs") == len(PAIRS)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"min_duration": 6},
            "none of its 4 pairs lasts 6 s, the longest lasts 5 s; lower data.min_duration",
        ),
        (
            {"min_duration": 3, "max_pairs": 5},
            "asked for 5 pairs but only 3 last 3 s; lower data.max_pairs",
        ),
        (
            {"min_duration": 0, "recording": "othr"},
            "there is no recording 'othr'. Did you mean 'other'? Known: r, other.",
        ),
        ({"min_duration": 0, "lanes": [9]}, "there is no lane '9'. Known: 2, 3."),
        ({"min_duration": 0, "lanes": []}, "the list is empty. Known: 2, 3."),
        (
            {"min_duration": 0, "pair_ids": ["bb"]},
            "there is no pair 'bb'. Did you mean 'b'? Known: a, b, c, d.",
        ),
        ({"min_duration": 0, "pair_ids": []}, "the list is empty. Known: a, b, c, d."),
    ],
)
def test_says_what_was_found_and_what_to_change(options: dict[str, object], said: str) -> None:
    with pytest.raises(DataError) as error:
        Ready(**options).load()
    assert said in str(error.value)


def test_lanes_need_data_that_knows_them() -> None:
    class Laneless(Ready):
        pairs = PairSet((a_pair("a", 10),), "made up")

    with pytest.raises(DataError, match="does not say in which lane"):
        Laneless(min_duration=0, lanes=[1]).load()


def test_no_pair_at_all_is_an_error_that_says_why() -> None:
    class Empty(Ready):
        pairs = PairSet((), "made up", (Dropped("no vehicle ahead", 7, "rows"),))

    with pytest.raises(
        DataError,
        match=r"made up: no leader-follower pair found \(left out: 7 rows: no vehicle ahead\)",
    ):
        Empty().load()


@pytest.mark.parametrize(
    "options",
    [{"min_duration": -1}, {"max_pairs": 0}, {"min_duration": float("nan")}, {"frames": 3}],
)
def test_refuses_settings_that_make_no_sense(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        Ready(**options)


@pytest.mark.parametrize("options", [{}, {"path": None}, {"path": ""}, {"path": "???"}])
def test_a_missing_path_is_said_in_plain_words(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="path: a value is required"):
        TidyDataset(**options)


def test_paths_know_home_and_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert FileDatasetSettings(path=Path("~/a.csv")).path == tmp_path / "a.csv"
    assert FileDatasetSettings(path=Path("b.csv")).path == tmp_path / "b.csv"


def test_pairs_without_a_label_are_counted_apart(caplog: pytest.LogCaptureFixture) -> None:
    class Labelled(Ready):
        pairs = PairSet(
            tuple(
                replace(pair, driver_type=kind)
                for pair, kind in zip(PAIRS, ("human", "acc", "", ""), strict=True)
            ),
            "made up",
        )

    kept = Labelled(min_duration=0, driver_type="human").load()
    assert kept.dropped == (
        Dropped("of which it is not said what drives the follower", 2),
        Dropped("another driver_type than 'human'", 1),
    )
    assert "of 2 of 4 pairs it is not said what drives the follower" in caplog.text
