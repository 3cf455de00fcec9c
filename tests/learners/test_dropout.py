"""Dropout draws from a generator that training brings."""

from __future__ import annotations

import torch
from torch import nn

from cfx.learners.batched import dropout_from


def test_bits_are_pytorchs_and_its_global_generator_is_left_alone() -> None:
    network = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.3), nn.Dropout(0.0))
    values = torch.linspace(-1, 1, 20).reshape(5, 4)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        expected = network(values)
        state = torch.get_rng_state()
        with dropout_from(network, torch.Generator().manual_seed(7)):
            drawn = network(values)
            assert torch.equal(network.eval()(values), network[0](values))
        assert torch.equal(torch.get_rng_state(), state)
        network.train()(values)
        assert not torch.equal(torch.get_rng_state(), state), "afterwards it is PyTorch's again"
    assert torch.equal(drawn, expected)
