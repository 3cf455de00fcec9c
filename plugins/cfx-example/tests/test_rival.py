"""The rival holds the contract of rivals, and learns the time gap."""

import cfx
import pytest

pytest.importorskip("cfx_report", reason="rivals are those of cfx-report's benchmark")

from cfx_report.benchmark.contract import CHECKS, tried

from cfx_example.rival import MeanTimeGap


def test_cfx_finds_it():
    assert cfx.get("rival", "mean_time_gap") is MeanTimeGap, (
        "install it first: pip install --editable ."
    )


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract(check):
    check(tried(MeanTimeGap()))


def test_it_learns_the_time_gap():
    done = tried(MeanTimeGap())
    assert 0.5 < done.driver.time_gap < 3.0
