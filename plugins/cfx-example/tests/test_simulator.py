"""The contract of a simulator."""

import cfx
from cfx_contracts import check_contract

from cfx_example.simulator import MeanSpeed


def test_contract():
    check_contract(MeanSpeed())


def test_cfx_finds_it():
    found = cfx.get("simulator", "mean_speed")
    assert found is MeanSpeed, "install it first: pip install --editable ."
