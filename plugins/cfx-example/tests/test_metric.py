"""The contract of a metric, and what this one adds to it."""

from dataclasses import replace

import cfx
import torch
from cfx_contracts import check_contract
from cfx_contracts.metrics import trajectories

from cfx_example.metric import TimeGap


def test_contract():
    check_contract(TimeGap())


def test_cfx_finds_it():
    found = cfx.get("metric", "time_gap")
    assert found is TimeGap, "install it first: pip install --editable ."


def test_twice_the_gap_is_twice_the_time():
    given = trajectories()
    twice = replace(given, gap=2 * given.gap)
    metric = TimeGap()
    torch.testing.assert_close(metric.compute(twice), 2 * metric.compute(given))
