"""What a name is, however it is written."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import cfx
from cfx.data.names import name_of, names_of
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, frame_of, pairs_from_frame
from cfx.errors import ConfigError, DataError
from tests.drives import straight_pairs

WRITTEN = [10, 10.0, "10", " 10", "10 ", "10.0", "10.", np.int64(10), np.float32(10), Decimal("10")]


@pytest.mark.parametrize("value", WRITTEN, ids=repr)
def test_numbers_and_texts_are_one_name(value: object) -> None:
    assert name_of(value) == "10"


@pytest.mark.parametrize("name", ["010", "10.5", "i80-10", "a 10", "1e3", "-", "true"])
def test_other_texts_are_names_of_their_own(name: str) -> None:
    assert name_of(name) == name


@pytest.mark.parametrize("value", [None, float("nan"), pd.NA, pd.NaT, "  "], ids=repr)
def test_a_missing_name_is_none(value: object) -> None:
    assert name_of(value) == ""


def test_one_name_is_a_list_of_one() -> None:
    assert names_of(10) == names_of("10") == names_of([10.0]) == ["10"]


def ten() -> tuple[PairSet, pd.DataFrame]:
    """Returns two pairs called 10 and 11, and their table, whose ids are numbers."""
    frame = frame_of(straight_pairs([120, 120]))
    frame["pair_id"] = frame["pair_id"].map({"p0": 10, "p1": 11})
    return pairs_from_frame(frame), frame


def mixed(ids: pd.Series) -> pd.Series:
    """Returns ids of which some are numbers and some texts."""
    written = ids.astype(object)
    written[::2] = written[::2].astype(str)
    return written


@pytest.mark.parametrize(
    "rewritten",
    [
        lambda ids: ids.astype(float),
        lambda ids: ids.astype(str) + " ",
        lambda ids: ids.astype(float).astype(str),
        lambda ids: ids.astype("category"),
        mixed,
    ],
    ids=["numbers", "blanks", "texts of numbers", "categories", "mixed"],
)
def test_tables_give_the_same_pairs(rewritten: object) -> None:
    pairs, frame = ten()
    frame["pair_id"] = rewritten(frame["pair_id"])  # type: ignore[operator]
    again = pairs_from_frame(frame)
    assert [pair.pair_id for pair in again] == ["10", "11"]
    assert again.fingerprint == pairs.fingerprint


def test_settings_take_numbers(tmp_path: Path) -> None:
    _, frame = ten()
    path = tmp_path / "pairs.csv"
    frame.assign(pair_id=frame["pair_id"].astype(float), recording=7.0).to_csv(path, index=False)
    (only,) = TidyDataset(path=path, pair_ids=[10.0], recording=7).load()
    assert (only.pair_id, only.recording) == ("10", "7")
    with pytest.raises(ConfigError, match="'10' stands there twice"):
        TidyDataset(path=path, pair_ids=[10, "10"])


def test_selected_pairs_may_be_named_by_numbers() -> None:
    _, frame = ten()
    pairs = cfx.read(frame)
    for chosen in (10, 10.0, " 10", [10], np.array([10.0])):
        assert pairs.select(chosen).summary.index.tolist() == ["10"]
    with pytest.raises(DataError, match="pair '10' is named twice"):
        pairs.select([10, "10"])
    with pytest.raises(DataError, match=r"there is no pair '12'"):
        pairs.select(12)


def test_a_table_of_parameters_is_matched_by_names() -> None:
    _, frame = ten()
    pairs = cfx.read(frame)
    parameters = pd.DataFrame({"T": [1.0, 1.5]}, index=["10", "11"])
    expected = cfx.simulate("idm", parameters, pairs)
    as_numbers = parameters.set_axis([10.0, 11.0])
    pd.testing.assert_frame_equal(cfx.simulate("idm", as_numbers, pairs), expected)
    with pytest.raises(ConfigError, match="two rows are of pair '11'"):
        cfx.simulate("idm", pd.concat([as_numbers, parameters.iloc[1:]]), pairs)
