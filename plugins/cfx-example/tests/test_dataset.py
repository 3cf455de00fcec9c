"""The contract of a dataset, on a file made here."""

import cfx
import numpy as np
import pandas as pd
import pytest
from cfx.errors import DataError
from cfx_contracts import check_contract

from cfx_example.dataset import PairCsv


@pytest.fixture
def path(tmp_path):
    """Two followers who do as their leader did 1.5 s before, 5 m further back."""
    time = 0.1 * np.arange(200)

    def position(at):
        return 10.0 * at - 4.0 * np.cos(0.5 * at)

    def speed(at):
        return 10.0 + 2.0 * np.sin(0.5 * at)

    rows = [
        pd.DataFrame(
            {
                "pair": name,
                "time_s": time,
                "leader_x_m": position(time + start),
                "leader_v_mps": speed(time + start),
                "follower_x_m": position(time + start - 1.5) - 5.0,
                "follower_v_mps": speed(time + start - 1.5),
            }
        )
        for name, start in (("a", 0.0), ("b", 3.0))
    ]
    file = tmp_path / "recording.csv"
    pd.concat(rows).to_csv(file, index=False)
    return file


def test_contract(path):
    check_contract(PairCsv(path=path, min_duration=10))


def test_cfx_finds_it():
    found = cfx.get("dataset", "pair_csv")
    assert found is PairCsv, "install it first: pip install --editable ."


def test_a_file_without_its_columns_is_refused(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="the columns pair, time_s"):
        PairCsv(path=tmp_path / "other.csv").load()
