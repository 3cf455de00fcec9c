"""The closed loop as compiled code is the loop of PyTorch, in values and in gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.core.threads import cores_limit, limit_cores
from cfx.data.pairs import PairBatch
from cfx.learners.base import TrainingData
from cfx.learners.compiled import loop
from cfx.learners.rollout import RolloutSettings, shard
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.learners.rollout.module import RolloutModule
from cfx.learners.rollout.window import GradientPath
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.base import Policy
from cfx.policies.gru import GruPolicy
from cfx.policies.heads import head_class
from cfx.policies.lstm import LstmPolicy
from cfx.simulation.kernel import compiler
from tests.drives import wavy_pairs
from tests.further import INPUTS as FURTHER
from tests.further import known_inputs, with_surroundings
from tests.learners.made import INPUTS, QUICK, TRUE, module_with, training_data

pytestmark = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")


@pytest.fixture(autouse=True)
def all_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets gradients go back through all windows that are observed."""
    monkeypatch.setattr(loop, "_BACK_THROUGH", 1_000)


SETTINGS: dict[str, Any] = {"compile": "always", "horizon": 6, "draws": 3}


def module(data: TrainingData, policy: Policy, **options: Any) -> RolloutModule:
    """Returns a module whose networks answer something."""
    settings = RolloutSettings(**(QUICK | options))
    generator = torch.Generator().manual_seed(0)
    head = head_class(settings.head).for_model(data.stepper.model)
    dataset = RolloutDataset.of(data, policy, head, settings, generator)
    network = shard.untrained(policy, dataset, head, generator)
    return module_with(network, dataset, data, settings, policy)


def both(built: Any, path: Any) -> list[list[Tensor]]:
    """Returns losses and gradients, without and with the compiled loop."""
    step = built.training_window
    batch = built.sampler.training(3)
    divisors = built.shard.errors.over_horizon(batch)
    loops, found = built.compiled, []
    for used in ({}, loops):
        built.compiled = used
        built.network.zero_grad()
        losses = []
        for segment in built.simulated(step, batch, 6, path):
            loss = built.trajectory_loss(segment, divisors)
            if loss.requires_grad:
                (loss * batch.weight).sum().backward()
            losses.append(loss.detach())
        gradients = []
        for weight in built.network.parameters():
            if weight.grad is not None:
                gradients.append(weight.grad.clone())
        found.append([*losses, *gradients])
    built.compiled = loops
    return found


CASES = [
    (IDM(), GruPolicy, {}, {"head": "residual"}),
    (Krauss(), GruPolicy, {"acting_bias": True, "layers": 2}, {}),
    (W99(), LstmPolicy, {"layers": 2, "summary": "last"}, {}),
]


@pytest.mark.parametrize(("model", "kind", "options", "settings"), CASES)
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(GradientPath(0.8, 0.5), marks=pytest.mark.slow),
        GradientPath(0.9, 1.0, cut_after=4),
    ],
)
def test_losses_and_gradients_are_those_of_pytorch(
    model: DrivingModel, kind: Any, options: Any, settings: Any, path: GradientPath
) -> None:
    policy = kind(inputs=INPUTS, hidden_size=8, start="middle", **options)
    data = training_data(model=model, networks=2)
    built = module(data, policy, **(SETTINGS | settings))
    assert built.training_window in built.compiled
    eager, compiled = both(built, path)
    assert len(eager) == len(compiled) > len(list(built.network.parameters()))
    for one, two in zip(eager, compiled, strict=True):
        scale = float(one.abs().max())
        torch.testing.assert_close(two, one, rtol=2e-3, atol=2e-3 * scale)


def test_further_signals_are_compiled_too() -> None:
    with known_inputs():
        policy = GruPolicy(inputs=(*INPUTS, *FURTHER), hidden_size=8, start="middle")
        data = training_data(networks=2)
        pairs = with_surroundings(wavy_pairs(Krauss(), TRUE, frames=260))
        built = module(replace(data, recorded=PairBatch.of(pairs)), policy, **SETTINGS)
        assert built.training_window in built.compiled
        eager, compiled = both(built, GradientPath(0.9, 1.0))
    for one, two in zip(eager, compiled, strict=True):
        torch.testing.assert_close(two, one, rtol=2e-3, atol=2e-3 * float(one.abs().max()))


@pytest.mark.parametrize("path", [GradientPath(0.8, 0.5, through_motion=False), None])
def test_other_ways_back(path: Any) -> None:
    policy = GruPolicy(inputs=INPUTS, hidden_size=8, start="middle")
    built = module(training_data(networks=1), policy, **SETTINGS)
    with torch.set_grad_enabled(path is not None):
        eager, compiled = both(built, path)
    assert len(eager) == len(compiled)
    for one, two in zip(eager, compiled, strict=True):
        torch.testing.assert_close(two, one, rtol=2e-3, atol=2e-3 * float(one.abs().max()))


def test_threads_change_no_bit() -> None:
    policy = GruPolicy(inputs=INPUTS, hidden_size=8, start="middle")
    built = module(training_data(networks=3), policy, **SETTINGS)
    found = []
    before = cores_limit()
    for cores in (1, 2):
        limit_cores(cores)
        found.append(both(built, GradientPath(0.8, 0.5))[1])
    limit_cores(before)
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_validation_is_that_of_pytorch() -> None:
    policy = GruPolicy(inputs=INPUTS, hidden_size=8, start="middle")
    built = module(training_data(networks=2), policy, **(SETTINGS | {"validation": 0.3}))
    with torch.no_grad():
        compiled = built.validation_loss()
        built.compiled = {}
        torch.testing.assert_close(compiled, built.validation_loss(), rtol=1e-4, atol=1e-5)


def test_gradients_go_back_through_the_last_windows_observed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Losses are the same; gradients differ by as little as the network forgets."""
    policy = GruPolicy(inputs=INPUTS, hidden_size=8, start="middle")
    built = module(training_data(networks=1), policy, **SETTINGS)
    path = GradientPath(0.8, 0.5)
    _, whole = both(built, path)
    monkeypatch.setattr(loop, "_BACK_THROUGH", 10)
    _, last = both(built, path)
    assert torch.equal(whole[0], last[0])
    for one, two in zip(whole[1:], last[1:], strict=True):
        assert float((one - two).norm() / one.norm()) < 0.05
