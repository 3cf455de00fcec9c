"""The contract of a policy, and what this one adds to it."""

import cfx
import torch
from cfx_contracts import check_contract

from cfx_example.policy import LinearMap


def test_contract():
    check_contract(LinearMap())


def test_cfx_finds_it():
    found = cfx.get("policy", "linear_map")
    assert found is LinearMap, "install it first: pip install --editable ."


def test_untrained_it_answers_the_fixed_parameters():
    fixed = torch.tensor([[0.2, 0.7], [0.4, 0.5]])
    network = LinearMap().build(10, torch.full((2,), 0.5), fixed, torch.Generator())
    answer, _ = network(torch.randn(2, 1, 3, 10), network.initial_state(2, 1))
    torch.testing.assert_close(answer, fixed[:, None, None].expand(2, 1, 3, 2))
