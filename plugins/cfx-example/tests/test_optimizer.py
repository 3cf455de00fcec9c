"""The contract of an optimizer."""

import cfx
from cfx_contracts import check_contract

from cfx_example.optimizer import HaltonSearch


def test_contract():
    check_contract(HaltonSearch(samples=2048))


def test_cfx_finds_it():
    found = cfx.get("optimizer", "halton_search")
    assert found is HaltonSearch, "install it first: pip install --editable ."
