"""What `data.check` does with pairs that contradict themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cfx
from cfx.data.base import Dataset
from cfx.data.check import judge
from cfx.data.describe import describe
from cfx.data.pairs import Pair, PairSet, Remark
from cfx.data.tidy import TidyDataset, frame_of, write_tidy
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8], [1.5, 0.2]], dtype=torch.float64)
PAIRS = wavy_pairs(Krauss(), TRUE, frames=120)


def in_kmh(pair: Pair) -> Pair:
    return replace(pair, follower_speed=pair.follower_speed * 3.6)


def with_wrong(count: int, of: int) -> PairSet:
    """Returns so many pairs, of which the last ones have speeds in km/h."""
    pairs = []
    for number in range(of):
        pair = replace(PAIRS[number % len(PAIRS)], pair_id=f"p{number}", follower_id=f"f{number}")
        pairs.append(in_kmh(pair) if number >= of - count else pair)
    return PairSet(tuple(pairs), "made up")


def test_a_job_is_refused_warned_or_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frame = frame_of(PAIRS)
    chosen = frame["pair_id"] == PAIRS[2].pair_id
    frame.loc[chosen, "follower_speed_mps"] *= 3.6
    path = tmp_path / "pairs.csv"
    frame.to_csv(path, index=False)

    def dataset(**more: object) -> Dataset:
        return TidyDataset(path=path, min_duration=10, **more)

    for check in ("drop_few", "refuse"):
        with pytest.raises(DataError) as error:
            dataset(check=check).load()
        for words in (str(path), "one of 4 pairs", f"'{PAIRS[2].pair_id}'", "km/h", "check=drop)"):
            assert words in str(error.value)
    assert "km/h" in describe(path).text
    assert len(dataset(check="off").load()) == 4
    assert not caplog.records
    assert len(dataset(check="report").load()) == 4
    assert "km/h" in caplog.text
    assert len(dataset(check="drop").load()) == 3
    # Pairs that a job does not use do not stop it.
    assert len(dataset(pair_ids=[PAIRS[0].pair_id]).load()) == 1


@pytest.mark.parametrize(
    ("wrong", "pairs", "check", "left_out"),
    [
        (1, 20, "drop_few", None),
        (1, 21, "drop_few", 1),
        (1, 21, "refuse", None),
        (1, 21, "report", 0),
        (20, 21, "drop", 20),
        (4, 4, "drop", None),
    ],
)
def test_a_few_pairs_are_left_out_and_many_refused(
    wrong: int, pairs: int, check: object, left_out: int | None
) -> None:
    verdict = judge(with_wrong(wrong, pairs), check)  # type: ignore[arg-type] # of a setting
    assert verdict.is_refused == (left_out is None)
    assert len(verdict.left_out) == (left_out or 0)
    assert f"{wrong} of {pairs}" in verdict.words or "one of" in verdict.words


def test_what_is_left_out_is_named_and_counted_everywhere(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "pairs.parquet"
    write_tidy(with_wrong(1, 21), path)
    reason = "contradicting themselves (data.check): 'p20'"
    pairs = cfx.read(path, min_duration=10)
    assert len(pairs) == 20
    assert reason in pairs.dropped["reason"].tolist()
    assert reason in repr(pairs)
    assert "'p20'" in caplog.text
    assert "km/h" in caplog.text
    text = describe(path).text
    assert "one of 21 pairs contradicts itself" in text
    assert "a job leaves them out (data.check)" in text


def test_every_dataset_is_checked() -> None:
    class Theirs(Dataset):
        def read(self) -> PairSet:
            return PairSet((in_kmh(PAIRS[0]),), "a plugin's")

    with pytest.raises(DataError, match=r"a plugin's: one of 1 pairs.*km/h"):
        Theirs(min_duration=0).load()


def test_only_some_pairs_are_named_and_all_counted() -> None:
    words = judge(with_wrong(4, 4), "refuse").words
    assert "4 of 4 pairs contradict themselves" in words
    assert "(4 in all)" in words


def test_a_source_that_contradicts_itself_as_a_whole_is_refused_whatever_is_left_out() -> None:
    about = Remark("its columns are in two units", is_contradiction=True)
    pairs = replace(with_wrong(1, 21), remarks=(about,))
    assert judge(pairs, "drop").is_refused
    assert "its columns are in two units" in judge(pairs, "report").words
    assert not judge(replace(pairs, remarks=()), "drop").is_refused
