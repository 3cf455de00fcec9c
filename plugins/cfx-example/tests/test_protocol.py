"""The contract of a protocol."""

import cfx
from cfx_contracts import check_contract

from cfx_example.protocol import FirstPart


def test_contract():
    check_contract(FirstPart())


def test_cfx_finds_it():
    found = cfx.get("protocol", "first_part")
    assert found is FirstPart, "install it first: pip install --editable ."
