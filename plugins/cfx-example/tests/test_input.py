"""The contract of an input of policies, and what this one adds to it."""

import cfx
import torch
from cfx_contracts import check_contract

from cfx_example.input import NeededDeceleration


def test_contract():
    check_contract(NeededDeceleration())


def test_cfx_finds_it():
    found = cfx.get("input", "needed_deceleration")
    assert found is NeededDeceleration, "install it first: pip install --editable ."


def test_nothing_is_needed_where_the_gap_grows():
    history = {
        "follower_speed": torch.tensor([10.0, 10.0]),
        "leader_speed": torch.tensor([12.0, 6.0]),
        "gap": torch.tensor([20.0, 20.0]),
    }
    values = NeededDeceleration().values(history)
    torch.testing.assert_close(values, torch.tensor([0.0, 0.4]))
