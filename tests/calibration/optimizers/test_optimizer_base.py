from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cfx.calibration.optimizers import TIE_ABSOLUTE, CandidateLosses, Optimizer
from cfx.errors import PluginError
from cfx_contracts.optimizers import Problems, distance


class Listed(Optimizer):
    """Evaluates the guess and three given points."""

    points = torch.tensor([[0.2], [0.9], [0.4]], dtype=torch.float64)

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        candidates = torch.cat([guesses, self.points.expand(len(guesses), -1, -1)], dim=1)
        return candidates, objective(candidates)

    def evaluations(self, n: int) -> int:
        return 4

    def bytes_per_problem(self, n: int) -> int:
        return 32


class Straying(Listed):
    points = torch.tensor([[0.2], [1.1], [0.4]], dtype=torch.float64)


class Undefined(Listed):
    points = torch.tensor([[0.2], [torch.nan], [0.4]], dtype=torch.float64)


class Miscounting(Listed):
    def evaluations(self, n: int) -> int:
        return 5


def minimize(function: object, guess: float = 0.5, optimizer: Optimizer | None = None) -> object:
    return (optimizer or Listed()).minimize(
        Problems(function, torch.zeros(1, 1)), torch.full((1, 1, 1), guess), seed=0
    )


def test_the_tie_nearest_to_the_first_guess_wins() -> None:
    found = minimize(lambda x, _: (x[..., 0] == 0.5).double())
    assert found.best.item() == 0.4
    assert found.loss.item() == 0.0


def test_a_difference_within_the_tolerance_is_a_tie_and_one_above_is_not() -> None:
    # 0.9 is the best by a hair; 0.4 is nearer to the guess.
    hair = lambda gap: lambda x, _: torch.where(x[..., 0] == 0.9, 0.0, gap) + (x[..., 0] == 0.5)  # noqa: E731  # a one-off
    assert minimize(hair(0.5 * TIE_ABSOLUTE)).best.item() == 0.4
    assert minimize(hair(2.0 * TIE_ABSOLUTE)).best.item() == 0.9


def test_the_spread_is_measured_on_space_filling_candidates_without_the_guess() -> None:
    found = minimize(lambda x, _: x[..., 0], guess=0.05)
    assert found.filling.tolist() == [[0.2, 0.4, 0.9]]
    assert found.sensitivity.item() == pytest.approx(0.4 - 0.05)


def test_diverged_candidates_are_counted_and_left_out_of_the_spread() -> None:
    found = minimize(lambda x, _: x[..., 0].where(x[..., 0] < 0.9, torch.nan))
    assert found.diverged.tolist() == [1]
    assert found.filling.tolist() == [[0.2, 0.2, 0.4]]


@pytest.mark.parametrize("optimizer", [Straying(), Undefined()])
def test_a_candidate_outside_the_bounds_is_the_plugins_mistake(optimizer: Optimizer) -> None:
    with pytest.raises(PluginError, match="candidate outside the bounds"):
        minimize(distance, optimizer=optimizer)


def test_a_wrong_number_of_evaluations_is_the_plugins_mistake() -> None:
    with pytest.raises(
        PluginError, match=r"optimizer Miscounting: solve must return candidates \(1, 5, 1\)"
    ):
        minimize(distance, optimizer=Miscounting())


def test_shards_respect_the_memory_bound() -> None:
    problems = Problems(distance, torch.zeros(10, 1))
    Listed().minimize(problems, torch.full((10, 1, 1), 0.5), seed=0, memory=700)
    sizes = [len(asked) for asked in problems.asked]
    assert sum(sizes) == 10
    assert 1 < max(sizes) < 10
