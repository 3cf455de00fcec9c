from __future__ import annotations

import pytest
import torch

from cfx.calibration.random_search import RandomSearch
from cfx.errors import ConfigError
from cfx_contracts.optimizers import Problems, bowl, distance


def test_every_problem_sees_the_same_points() -> None:
    problems = Problems(distance, torch.rand(3, 2, dtype=torch.float64))
    RandomSearch(samples=64).minimize(problems, torch.full((3, 1, 2), 0.5), seed=0)
    asked = torch.cat(problems.asked, dim=1)
    assert torch.equal(asked[0], asked[1])
    assert torch.equal(asked[0], asked[2])


def test_more_samples_never_find_less() -> None:
    problems = Problems(bowl, torch.rand(5, 3, dtype=torch.float64))
    guesses = torch.full((5, 1, 3), 0.5)
    few, many = (
        RandomSearch(samples=samples).minimize(problems, guesses, seed=0).loss
        for samples in (100, 2000)
    )
    assert bool((many <= few).all())


def test_more_guesses_than_samples_is_told() -> None:
    problems = Problems(distance, torch.rand(1, 2, dtype=torch.float64))
    with pytest.raises(
        ConfigError,
        match=r"optimizer\.samples=2: there are 3 first guesses; set optimizer\.samples >= 3",
    ):
        RandomSearch(samples=2).minimize(problems, torch.full((1, 3, 2), 0.5), seed=0)


def test_guesses_alone_are_a_search() -> None:
    problems = Problems(distance, torch.zeros(2, 2, dtype=torch.float64))
    found = RandomSearch(samples=1).minimize(problems, torch.full((2, 1, 2), 0.5), seed=0)
    assert torch.equal(found.best, torch.full((2, 2), 0.5, dtype=torch.float64))
    assert found.sensitivity.tolist() == [0.0, 0.0]
