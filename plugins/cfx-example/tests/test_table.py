"""The contract of a table of results, and what this one says."""

from types import SimpleNamespace

import cfx
import numpy as np
from cfx_contracts import check_contract

from cfx_example.table import SpeedBins


def test_contract():
    check_contract(SpeedBins())


def test_cfx_finds_it():
    found = cfx.get("table", "speed_bins")
    assert found is SpeedBins, "install it first: pip install --editable ."


def test_each_frame_is_counted_once():
    pairs = [SimpleNamespace(follower_speed=np.array([0.5, 3.1, 3.9]))]
    (rows,) = SpeedBins().rows(SimpleNamespace(recorded=pairs))
    assert rows.to_dict("list") == {"speed": [0.0, 3.0], "frames": [1, 2]}
