"""Operations that draw take their numbers from a generator of the caller's."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cfx_posteriors.random_numbers import DrawsFrom

DRAWS: dict[str, Callable[[], Tensor]] = {
    "rand": lambda: torch.rand(3),
    "randn": lambda: torch.randn(3, dtype=torch.float64),
    "randint": lambda: torch.randint(2, 99, (3,)),
    "randperm": lambda: torch.randperm(9),
    "like": lambda: torch.randn_like(torch.ones(3)),
    "normal": lambda: torch.normal(torch.zeros(3), torch.ones(3)),
    "bernoulli": lambda: torch.full((9,), 0.5).bernoulli(),
    "multinomial": lambda: torch.multinomial(torch.ones(5), 3),
    "gamma": lambda: torch.distributions.Gamma(torch.ones(3), 1.0).sample(),
    "dropout": lambda: torch.nn.functional.dropout(torch.ones(9)),
    "weights": lambda: torch.nn.init.xavier_normal_(torch.empty(3, 2)),
}


@pytest.mark.parametrize("name", DRAWS)
def test_numbers_are_those_of_the_global_generator(name: str) -> None:
    draw = DRAWS[name]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        expected = draw()
        torch.manual_seed(4)
        state = torch.get_rng_state()
        with DrawsFrom(torch.Generator().manual_seed(3)):
            drawn = draw()
        assert torch.equal(torch.get_rng_state(), state), "the global one is as it was"
    assert torch.equal(drawn, expected)
