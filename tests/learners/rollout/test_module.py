"""Gradient steps and validation, beside evaluation."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cfx.core.parameters import squashed
from cfx.learners.rollout import RolloutLearner, RolloutSettings
from cfx.learners.rollout.dataset import RolloutBatch
from cfx.learners.rollout.loop import burn_in, simulate
from cfx.learners.rollout.module import DISPERSIONS, RolloutModule
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.driver_features import measure
from tests.learners.made import (
    QUICK,
    TRUE,
    batch_of,
    gru,
    loop,
    module_of,
    module_with,
    placed,
    training_data,
    untrained,
)

FEATURES = ("time_headway", "acceleration")


@pytest.mark.parametrize(
    ("model", "head", "driver_features"),
    [
        (Krauss(), "offset", ()),
        (Krauss(), "residual", FEATURES),
        (W99(), "offset", FEATURES),
        (W99(), "residual", ()),
    ],
)
def test_training_simulates_what_evaluation_simulates(
    model: Any, head: str, driver_features: tuple[str, ...]
) -> None:
    """Training's closed loop and evaluation's give the same speeds and gaps after a burn-in."""
    policy = gru(driver_features=driver_features)
    data = training_data(model=model, networks=1)
    options = QUICK | {"epochs": 1, "steps": 4, "learning_rate": 0.05, "head": head}
    result = RolloutLearner(**options).fit(policy, data)
    settings = RolloutSettings(**(QUICK | {"head": head}))
    dataset = placed(data, policy, settings.validation, head=head)
    dataset.scaler = result.scaler
    module = module_with(result.network, dataset, data, settings)
    if driver_features:  # training measures full trajectories, evaluation what was before
        frame = torch.full_like(data.pairs.network, 200)
        measured = measure(data.batch, driver_features, 0.1, 0 * frame, frame)
        dataset.recordings.driver_features = measured.float()
    batch = batch_of(dataset, torch.full((1, 6), 40))
    with torch.no_grad():
        segment = next(simulate(module.exact_step, dataset, batch, 11))
    found = loop(result, data, policy, first=200)
    near = {"rtol": 0, "atol": 2e-3}
    torch.testing.assert_close(segment.speed[0].double(), found.speed[:, 1:56], **near)
    torch.testing.assert_close(segment.gap[0].double(), found.gap[:, 1:56], **near)


@pytest.mark.parametrize("model", [Krauss(), IDM()], ids=["krauss", "idm"])
def test_training_samples_what_evaluation_samples(model: Any) -> None:
    """The same random numbers give the same speeds and gaps in both closed loops."""
    policy, data = gru(), training_data(model=model, networks=1)
    result = untrained(data, policy, head="stochastic")
    settings = RolloutSettings(**(QUICK | {"head": "stochastic"}))
    dataset = placed(data, policy, settings.validation, head="stochastic")
    dataset.scaler = result.scaler
    module = module_with(result.network, dataset, data, settings)
    batch = batch_of(dataset, torch.full((1, 6), 40))
    generator = torch.Generator().manual_seed(5)
    width = module.exact_step.core.head.noise_width
    assert width == 2 + len(model.space)
    drawn = []
    for _ in range(11):
        drawn.append(torch.randn((6, width), generator=generator, dtype=torch.float64).float())
    noise = torch.stack(drawn)[:, None]
    about = (module.exact_step, dataset, batch, 11)
    with torch.no_grad():
        centre = next(simulate(*about))
        segment = next(simulate(*about, noise=noise))
    found = loop(result, data, policy, first=200, seed=5)
    near = {"rtol": 0, "atol": 2e-3}
    torch.testing.assert_close(segment.speed[0].double(), found.speed[:, 1:56], **near)
    torch.testing.assert_close(segment.gap[0].double(), found.gap[:, 1:56], **near)
    assert float((segment.speed - centre.speed).abs().max()) > 0.1


def test_a_bounded_burn_in_forgets_what_was_before() -> None:
    """It is the burn-in that began so many windows ago; cold starts have none."""
    policy, data = gru(), training_data(networks=1)
    dataset = placed(data, policy)
    generator = torch.Generator().manual_seed(0)
    features = dataset.scaler.mean.shape[-1]
    blank = torch.full((1, 2), 0.5)
    network = policy.build(features, blank[0], blank, generator)
    step = module_with(network, dataset, data, RolloutSettings(**QUICK)).exact_step
    cold_start = torch.tensor([[False, False, False, False, False, True]])
    start = torch.tensor([[2, 4, 5, 9, 12, 12]])
    batch = batch_of(dataset, start, cold_start)
    conditioning = dataset.condition(batch)
    everyone = torch.ones_like(cold_start)
    with torch.no_grad():
        full = burn_in(step, dataset, batch, conditioning)
        assert torch.equal(burn_in(step, dataset, batch, conditioning, 100), full)
        short = burn_in(step, dataset, batch, conditioning, 5)
        for number, first in enumerate(start[0, :5].tolist()):
            state = network.initial_state(1, 6)
            for window in range(max(0, first - 5), first):
                token = dataset.recordings.tokens[:, window][dataset.pair]
                state = step.observe(token, squashed(dataset.base), state, everyone)
            torch.testing.assert_close(short[0, number], state[0, number])
    assert not bool(short[0, 5].any())
    assert not torch.allclose(short[0, 4], full[0, 4], atol=1e-6)


def test_weights_let_each_time_after_the_start_count_alike() -> None:
    """Relative to the untrained errors every frame has the same weighted error."""
    policy, data = gru(), training_data(networks=1)
    options = QUICK | {"head": "residual", "time_weighting": "relative"}
    settings = RolloutSettings(**options)
    dataset = placed(data, policy, settings.validation, head="residual")
    result = untrained(data, policy, head="residual")
    module = module_with(result.network, dataset, data, settings)
    weights = module.loss.frame_weights
    assert weights is not None
    batch = module.sampler.training(0)
    with torch.no_grad():
        segment = next(simulate(module.exact_step, dataset, batch, 12))
    counted = segment.measured.counted * batch.weight[..., None]
    square = (segment.speed - segment.measured.speed).square() * counted
    error = square.sum((0, 1)) / counted.sum((0, 1))
    weighted = error * weights.speed[0, 0]
    assert float(error[1] / error.mean()) < 0.05, "the residual makes the start nearly exact"
    late = error > 0.01 * error.mean()
    expected = error.mean().expand(int(late.sum()))
    torch.testing.assert_close(weighted[late], expected, rtol=1e-4, atol=0)
    assert float(weighted.max()) < 1.001 * float(error.mean())
    beyond = weights.at(55, 20)
    assert torch.equal(beyond.speed[0, 0, 5:], weights.speed[0, 0, -1].expand(15))


def test_the_noise_is_as_wide_as_validation_drivers_want_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nine tenths of their speeds are within the range of 19 paths, where a factor does that."""
    policy, data = gru(), training_data(networks=3)
    settings = RolloutSettings(**(QUICK | {"head": "stochastic", "horizon": 4}))
    dataset = placed(data, policy, settings.validation, head="stochastic")
    result = untrained(data, policy, head="stochastic")
    module = module_with(result.network, dataset, data, settings)
    batch = module.sampler.validation_with_history()
    with torch.no_grad():
        assert bool(module._coverage(batch).le(1.0).all())
        truth = batch._replace(weight=torch.zeros_like(batch.weight))
        assert bool(module._coverage(truth).isnan().all())
    wanted = torch.tensor([0.7, 1.9, 100.0])

    def coverage(batch: RolloutBatch) -> torch.Tensor:
        return 0.9 + 0.1 * (module.dispersion / wanted).log()

    monkeypatch.setattr(module, "_coverage", coverage)
    found = module.fit_dispersion()
    assert found is not None
    expected = torch.tensor([0.7, 1.9, DISPERSIONS[1]])
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0)
    assert module.dispersion.tolist() == [1.0, 1.0, 1.0]


def test_the_path_without_noise_counts_beside_sampled_ones() -> None:
    policy, data = gru(), training_data(networks=2)
    settings = RolloutSettings(**(QUICK | {"head": "stochastic", "horizon": 4, "paths": 3}))
    dataset = placed(data, policy, settings.validation, head="stochastic")
    network = untrained(data, policy, head="stochastic").network
    module = module_with(network, dataset, data, settings)
    batch = module.sampler.training(0)
    divisors = module.shard.errors.over_horizon(batch)
    about = (module.exact_step, dataset, batch, 4)
    with torch.no_grad():
        centre = module.loss(next(simulate(*about)), divisors)
        noise = module._noise(batch, 4, 3)
        sampled = next(simulate(*about, noise=noise))
        crps = module.loss.of_paths(sampled, divisors, 3)
        found = exact_losses(module, batch, 4, full=False)
    assert float(crps.min()) > 0
    torch.testing.assert_close(found, centre + crps)
    assert settings.epochs > 1
    path = module.through_time
    segment = next(module.simulated(module.exact_step, batch, 4, path))
    early = module.trajectory_loss(segment, divisors)
    torch.testing.assert_close(early.detach(), centre, msg="it is learned first")


@pytest.mark.parametrize(
    ("head", "epochs", "is_forgotten"),
    [("stochastic", 1, True), ("stochastic", 4, False), ("residual", 1, False)],
)
def test_the_best_weights_are_of_an_epoch_that_samples_paths(
    head: str, epochs: int, is_forgotten: bool
) -> None:
    """The first epoch samples paths if it is the only one; before, losses mean something else."""
    policy, data = gru(), training_data(networks=2)
    settings = RolloutSettings(**(QUICK | {"head": head, "epochs": epochs}))
    dataset = placed(data, policy, settings.validation, head=head)
    network = untrained(data, policy, head=head).network
    module = module_with(network, dataset, data, settings)
    module.best_loss = torch.full_like(module.best_loss, 0.5)
    module.on_train_epoch_start()
    assert bool(module.best_loss.isinf().all()) == is_forgotten


@pytest.mark.parametrize(("head", "sampled"), [("stochastic", [0, 0, 2, 2]), ("residual", None)])
def test_curves_say_in_which_epochs_paths_are_sampled(head: str, sampled: list[int] | None) -> None:
    policy, data = gru(), training_data(networks=1)
    settings = RolloutSettings(**(QUICK | {"head": head, "epochs": 4, "paths": 2}))
    dataset = placed(data, policy, settings.validation, head=head)
    network = untrained(data, policy, head=head).network
    module = module_with(network, dataset, data, settings)
    module.rows += [(torch.ones(1), torch.ones(1))] * 4
    curves = module.curves()
    found = None
    if "sampled_paths" in curves:
        found = curves["sampled_paths"].tolist()
    assert found == sampled


def exact_losses(module: RolloutModule, batch: RolloutBatch, windows: int, full: bool) -> Any:
    """Returns the loss of each trajectory with the exact model, `(N, D)`."""
    divisors = module.shard.errors.over_horizon(batch)
    if full:
        divisors = module.shard.errors.over_full_trajectory(batch)
    segment = next(module.simulated(module.exact_step, batch, windows))
    return module.trajectory_loss(segment, divisors)


@pytest.mark.parametrize(
    ("cold_start_fraction", "second"),
    [(0.0, "aabbcc"), (0.4, "aabcde"), (1.0, "aabcde"), (1.0, "aabbcc")],
    ids=["few drivers with history", "both", "cold starts", "few drivers"],
)
def test_the_validation_loss_is_the_mean_over_validation_drivers(
    cold_start_fraction: float, second: str
) -> None:
    """With history from fifths of what is kept; cold starts over full trajectories."""
    data = training_data(base=TRUE.repeat(2, 1) * 1.3, drivers=tuple("abcdef" + second))
    module = module_of(data, validation=0.3, cold_start_fraction=cold_start_fraction)
    dataset, expected = module.dataset, torch.zeros(2)
    counts = dataset.validates.sum(1).tolist()
    assert counts[0] != counts[1]
    one, no = torch.ones(2, 1), torch.zeros(2, 1).bool()
    with torch.no_grad():
        for network, count in enumerate(counts):
            for place in dataset.validates[network].nonzero()[:, 0].tolist():
                until, last = int(dataset.until[network, place]), int(dataset.last[network, place])
                begin = until if until < last else 0
                here, end = torch.full((2, 1), place), torch.full((2, 1), last)
                share = cold_start_fraction if begin == 0 else 0.0
                for fifth in (0.2, 0.4, 0.6, 0.8):
                    start = ((begin + fifth * (end - begin)) / 5).long()
                    known = RolloutBatch(here, start, no, end, one)
                    loss = exact_losses(module, known, 12, full=False)
                    expected[network] += (1 - share) * loss[network, 0] / (4 * count)
                cold = RolloutBatch(here, end * 0, ~no, end, one)
                loss = exact_losses(module, cold, 52, full=True)
                expected[network] += share * loss[network, 0] / count
        torch.testing.assert_close(module.validation_loss(), expected, rtol=1e-4, atol=1e-5)
