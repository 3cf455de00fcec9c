"""Samples of posteriors: intervals hold what they promise, or are said not to."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import Tensor

from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx_posteriors.importance import DRAWS, Sampled, sample
from cfx_posteriors.laplace import laplace, likely_starts
from cfx_posteriors.tempered import tempered

from .recordings import Drawn, draw_recordings

SHARES = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)


def sampled(drawn: Drawn, *, memory: int = 1 << 30) -> Sampled:
    normal = laplace(drawn.posterior, likely_starts(drawn.posterior, seed=0))
    return sample(drawn.posterior, normal, SHARES, seed=0, memory=memory)


def ranks_of(drawn: Drawn, samples: Sampled) -> Tensor:
    """Returns the ranks of true parameters among 20 classes that are equally likely."""
    truth = drawn.truth[:, None, : len(drawn.posterior.space)]
    return (truth > samples.quantiles).sum(1)


def held(ranks: Tensor) -> float:
    """Returns how often 90 % intervals hold the truth."""
    return float(((ranks > 0) & (ranks < 19)).double().mean())


@pytest.mark.parametrize(
    ("model", "signal", "drivers"), [(Krauss(), "gap", 300), (IDM(), "speed", 120)]
)
def test_intervals_hold_the_truth_about_as_often_as_they_say(
    model: DrivingModel, signal: Literal["speed", "gap"], drivers: int
) -> None:
    drawn = draw_recordings(model, drivers, signal=signal)
    samples = sampled(drawn)
    assert float(samples.reliable.double().mean()) > 0.95
    assert 0.84 < held(ranks_of(drawn, samples)) < 0.95


def test_ranks_of_true_parameters_are_uniform() -> None:
    """The rank of the truth, in four classes: chi-squared is below its 99.9 % point."""
    drawn = draw_recordings(Krauss(), 150, seed=1)
    ranks = ranks_of(drawn, sampled(drawn))
    for column in range(ranks.shape[1]):
        counts = torch.histc(ranks[:, column].double(), 4, 0, 20)
        wanted = len(ranks) / 4
        assert float(((counts - wanted).square() / wanted).sum()) < 16.3


def test_where_samples_do_not_settle_it_is_said_and_tempered_ones_hold_the_truth() -> None:
    """W99's density jumps."""
    drawn = draw_recordings(W99(), 24, frames=300)
    samples = sampled(drawn)
    assert 0.0 < float(samples.reliable.double().mean()) < 0.95
    ranks = ranks_of(drawn, samples)
    assert held(ranks[samples.reliable]) > 0.8
    assert held(ranks[~samples.reliable]) > 0.75
    assert float(samples.effective[~samples.reliable].median()) < 100


def test_tempered_samples_are_the_posterior() -> None:
    """Beside weighted ones, where both can be had; of a driver whoever else there is."""
    drawn = draw_recordings(Krauss(), 12, frames=300)
    weighted, n = sampled(drawn), len(drawn.posterior.space)
    places = tempered(drawn.posterior, seed=0)
    quantiles = places[..., :n].quantile(SHARES, dim=1).transpose(0, 1)
    middle = quantiles[:, 9] - weighted.quantiles[:, 9]
    width = weighted.quantiles[:, -1] - weighted.quantiles[:, 0]
    assert float((middle / width).abs().max()) < 0.15
    torch.testing.assert_close(quantiles[:, -1] - quantiles[:, 0], width, rtol=0.25, atol=0)
    alone = tempered(drawn.posterior.take(torch.tensor([3])), seed=0)
    torch.testing.assert_close(alone[0], places[3], rtol=1e-6, atol=1e-6)


def test_draws_are_as_likely_as_the_quantiles_say() -> None:
    drawn = draw_recordings(IDM(), 20, frames=300)
    samples = sampled(drawn)
    assert samples.draws.shape == (20, DRAWS, 7)
    below = (samples.draws[:, :, None, :5] < samples.quantiles[:, None]).double().mean(1)
    wanted = SHARES[:, None].expand(19, 5)
    torch.testing.assert_close(below.mean(0), wanted, atol=0.02, rtol=0)
    torch.testing.assert_close(below, wanted.expand(20, 19, 5), atol=0.12, rtol=0)


def test_samples_of_a_driver_depend_on_neither_memory_nor_other_drivers() -> None:
    drawn = draw_recordings(Krauss(), 6, frames=200)
    whole, cut = sampled(drawn), sampled(drawn, memory=1)
    for one, other in zip(whole, cut, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_drivers_with_random_numbers_of_their_own_agree_within_errors() -> None:
    posterior = draw_recordings(Krauss(), 3, frames=200).posterior
    same = posterior.take(torch.tensor([0, 0, 0]))
    normal = laplace(same, likely_starts(same, seed=0))
    ends = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    shared = sample(same, normal, ends, seed=0, memory=1 << 30)
    torch.testing.assert_close(shared.draws[0], shared.draws[1])
    samples = sample(same, normal, ends, seed=0, memory=1 << 30, draws=50, apart=True)
    assert samples.draws.shape[1] == 50
    assert float((samples.draws[0] - samples.draws[1]).abs().mean()) > 0.01
    width = shared.quantiles[:1, 2] - shared.quantiles[:1, 0]
    assert float(((samples.quantiles - shared.quantiles) / width[:, None]).abs().max()) < 0.15
    cut = sample(same, normal, ends, seed=0, memory=1, draws=50, apart=True)
    torch.testing.assert_close(cut.draws, samples.draws, rtol=1e-6, atol=1e-6)


def test_a_longer_recording_leaves_less_doubt() -> None:
    widths = []
    for frames in (150, 1200):
        samples = sampled(draw_recordings(Krauss(), 20, frames=frames))
        widths.append(float((samples.quantiles[:, -1] - samples.quantiles[:, 0]).median()))
    assert widths[1] < 0.6 * widths[0]
