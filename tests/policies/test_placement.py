"""Places of drivers on a grid of networks."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.policies.core import driver_places


@given(st.lists(st.integers(0, 5), max_size=30))
def test_drivers_of_a_network_are_numbered_in_their_order(networks: list[int]) -> None:
    counts: dict[int, int] = {}
    expected = []
    for network in networks:
        expected.append(counts.get(network, 0))
        counts[network] = counts.get(network, 0) + 1
    found = driver_places(torch.tensor(networks, dtype=torch.int64))
    assert found.tolist() == expected
