from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.losses import SegmentLosses
from cfx.calibration.rmse import GapRmse
from cfx.calibration.shade import ShadeSearch
from cfx.core.threads import limit_cores
from cfx.data.pairs import PairBatch
from cfx.models.idm import IDM
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx_contracts import check_contract
from cfx_contracts.optimizers import Problems

BATCH = PairBatch.of(SyntheticDataset(pairs=40, frames=120).load())


def random(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def valleys(candidates: Tensor, optimum: Tensor) -> Tensor:
    """Returns a bowl with a hundred minima in each direction; the lowest is the optimum."""
    away = candidates - optimum
    return (away.square() + 0.02 * (1.0 - torch.cos(60.0 * away))).sum(-1)


def drivers(count: int) -> SegmentLosses:
    pair = torch.arange(count)
    stepper = MemoryStepper(IDM(), 0.1, compile="always")
    return SegmentLosses.of_segments(stepper, GapRmse(), BATCH, pair, pair * 0, pair * 0 + 100)


def test_contract() -> None:
    check_contract(ShadeSearch(samples=4000))


def test_it_finds_the_lowest_of_many_minima_where_local_searches_do_not() -> None:
    optima, guesses = 0.2 + 0.6 * random(6, 3), torch.full((6, 1, 3), 0.5, dtype=torch.float64)
    found = ShadeSearch().minimize(Problems(valleys, optima), guesses, seed=0)
    local = GradientSearch().minimize(Problems(valleys, optima), guesses, seed=0)
    assert float((found.best - optima).abs().max()) < 1e-4
    assert float(local.loss.max()) > 0.01


def test_ends_agree_where_the_optimum_was_found_and_differ_where_searches_end_anywhere() -> None:
    """One problem has one minimum; in the other every place has a loss of its own."""

    def function(candidates: Tensor, which: Tensor) -> Tensor:
        bowl = (candidates - 0.3).square().sum(-1) + 1.0
        noise = (torch.sin(1e4 * candidates).sum(-1) * 1e4).frac().abs() + 1e-3
        return bowl.where(which[..., 0] < 0.5, noise)

    which = torch.tensor([[0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    found = ShadeSearch().minimize(Problems(function, which), random(2, 1, 2), seed=0)
    assert float(found.apart[0]) < 1e-6
    assert float(found.apart[1]) > 0.01


def test_a_driver_has_the_same_bits_whatever_is_beside_it_and_on_any_number_of_cores() -> None:
    guess = IDM().space.to_unit(IDM().space.defaults()).double()
    guesses = guess.expand(40, 1, -1)
    try:
        limit_cores(1)
        all_of_them = ShadeSearch().minimize(drivers(40), guesses, seed=0)
        limit_cores(2)
        threads = ShadeSearch().minimize(drivers(40), guesses, seed=0)
        few = ShadeSearch().minimize(drivers(3), guesses[:3], seed=0)
    finally:
        limit_cores(None)
    assert torch.equal(threads.best, all_of_them.best)
    assert torch.equal(few.best, all_of_them.best[:3])
    assert torch.equal(few.loss, all_of_them.loss[:3])


def test_a_problem_with_one_minimum_ends_early() -> None:
    problems = Problems(lambda x, at: (x - at).square().sum(-1) + 1.0, random(2, 5))
    optimizer, done = ShadeSearch(), []
    optimizer.minimize(problems, random(2, 1, 5), seed=0, progress=done.append)
    asked = sum(asked.shape[0] * asked.shape[1] for asked in problems.asked)
    assert asked < 0.2 * 2 * optimizer.evaluations(5)
    assert sum(done) == 2 * optimizer.evaluations(5)


@pytest.mark.parametrize("samples", [16, 3000, 8000, 20_000])
def test_a_budget_is_kept(samples: int) -> None:
    optimizer = ShadeSearch(samples=samples)
    problems = Problems(valleys, random(1, 3))
    optimizer.minimize(problems, random(1, 1, 3), seed=0)
    asked = sum(asked.shape[1] for asked in problems.asked)
    assert asked <= optimizer.evaluations(3) <= samples
    assert asked > 0.4 * samples


def test_labels_and_pooled_parameters_are_searched_by_gradients() -> None:
    assert ShadeSearch().brief().settings.samples == 4096
    assert ShadeSearch(samples=64).brief().settings.samples == 64
    assert isinstance(ShadeSearch().of_pooled(), GradientSearch)


def test_populations_search_pooled_parameters_where_that_is_asked() -> None:
    optimizer = ShadeSearch(pooled_samples=20_000).of_pooled()
    assert isinstance(optimizer, ShadeSearch)
    assert optimizer.settings.samples == 20_000


def test_agreement_of_small_populations_does_not_end_a_thorough_search() -> None:
    # A wide basin on which small populations agree, beside a narrow one that is lower.
    def hidden(x: Tensor, at: Tensor) -> Tensor:
        wide = 1.0 + (x - 0.8).square().sum(-1)
        narrow = 0.5 + 200.0 * (x - 0.1).square().sum(-1)
        return torch.minimum(wide, narrow)

    problems, guesses = Problems(hidden, random(1, 3)), random(1, 1, 3)
    usual = ShadeSearch()
    assert float(usual.minimize(problems, guesses, seed=0).loss) == pytest.approx(1.0)
    thorough = usual.with_effort(3.0, 3)
    assert thorough.evaluations(3) <= 3 * usual.evaluations(3)
    assert float(thorough.minimize(problems, guesses, seed=0).loss) == pytest.approx(0.5, abs=1e-5)


def test_what_a_user_asks_for_overrides_the_models_effort() -> None:
    asked = ShadeSearch(samples=8000)
    assert asked.with_effort(3.0, 5) is asked
    assert ShadeSearch().with_effort(1.0, 5).evaluations(5) == ShadeSearch().evaluations(5)
