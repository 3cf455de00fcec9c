"""The contract of a learner."""

import cfx
from cfx_contracts import check_contract

from cfx_example.learner import BestOf


def test_contract():
    check_contract(BestOf(restarts=2, epochs=60))


def test_cfx_finds_it():
    found = cfx.get("learner", "best_of")
    assert found is BestOf, "install it first: pip install --editable ."
