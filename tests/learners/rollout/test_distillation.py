"""Experts beside students."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from cfx.learners.base import TrainingData
from cfx.learners.rollout.loop import Expert, burn_in
from cfx.learners.rollout.module import RolloutModule
from cfx.learners.rollout.window import RolloutInputs, WindowStep
from cfx.models.direct import Direct
from cfx.policies.core import AgentCore
from cfx.policies.heads.offset import OffsetHead
from tests.learners.made import WINDOWS, batch_of, gru, module_of, training_data


def distilled_module(data: TrainingData, *, seed: int = 1, **options: Any) -> RolloutModule:
    """A module whose untrained students imitate untrained experts that answer at random."""
    module = module_of(data, **options)
    dataset = module.dataset.for_base(torch.tensor([0.6]))
    blank = torch.full((len(dataset.pair), 1), 0.5)
    features, generator = dataset.scaler.mean.shape[-1], torch.Generator().manual_seed(seed)
    network = gru(start="middle").build(features, blank[0], blank, generator)
    network.requires_grad_(False)
    core = AgentCore(gru(), network, dataset.scaler, OffsetHead.for_model(Direct()))
    module.expert = Expert(WindowStep(core, Direct(), WINDOWS, 0.1), dataset)
    return module


def test_an_expert_says_what_it_would_do_where_the_student_stands() -> None:
    """Beside its own trajectory it says exactly what it does, elsewhere something else."""
    module = distilled_module(training_data(networks=1))
    expert = module.expert
    assert expert is not None
    step, dataset = expert.step, expert.dataset
    cold_start = torch.tensor([[False, False, False, True, True, True]])
    batch = batch_of(dataset, torch.where(cold_start, 0, 15), cold_start)
    with torch.no_grad():
        conditioning = dataset.condition(batch)
        inputs = RolloutInputs.of(dataset.recordings.batch, conditioning.pair, batch, step, 8)
        own = inputs.initial(burn_in(step, dataset, batch, conditioning))
        state = expert.begin(batch, None)
        for window in range(8):
            leader = inputs.leader_window(window)
            before = state
            label, state = expert.label(state, own, leader, inputs.leader_length)
            own, speed, _ = step.drive_window(
                own, leader, inputs.leader_length, conditioning.base, conditioning.features
            )
            torch.testing.assert_close(label, speed, rtol=0, atol=1e-6)
        elsewhere = own._replace(speed=own.speed + 1.0)
        label, _ = expert.label(before, elsewhere, leader, inputs.leader_length)
    assert not torch.allclose(label, speed, atol=0.1)


def test_a_student_learns_from_each_window_alone() -> None:
    """The loss reported is the trajectory's; the gradient comes from the expert's answers."""
    data = training_data(networks=1)
    options = {"distillation_epochs": 1, "cold_start_fraction": 0.0}
    gradients, losses = [], []
    other_expert = distilled_module(data, seed=2, **options)
    for module in (distilled_module(data, **options), module_of(data, **options), other_expert):
        loss = next(module.step_losses(0))
        loss.sum().backward()
        losses.append(loss.detach())
        gradients.append(module.network.get_parameter("b_out").grad)
    torch.testing.assert_close(losses[0], losses[1])
    assert not torch.allclose(gradients[0], gradients[1], rtol=0.1)
    torch.testing.assert_close(losses[0], losses[2])
    assert not torch.allclose(gradients[0], gradients[2], rtol=0.1)


def test_nothing_is_imitated_beyond_the_training_part() -> None:
    """A trajectory may end behind it. Neither measurements nor experts count there."""
    gradients = []
    for beyond in (0.0, 5.0):
        data = training_data(networks=1)
        module = distilled_module(data, distillation_epochs=1, cold_start_fraction=0.0)
        dataset = module.dataset
        ends = dataset.last - 100
        dataset.last, dataset.until = ends, ends
        frames = torch.arange(dataset.recordings.batch.mask.shape[1])
        secret = frames > ends[0, dataset.pair[0].argsort()][:, None]
        dataset.recordings.batch = replace(
            dataset.recordings.batch,
            leader_speed=dataset.recordings.batch.leader_speed + beyond * secret,
            leader_position=dataset.recordings.batch.leader_position + beyond * secret,
        )
        starts = module.sampler.training(0).start
        assert bool((starts * WINDOWS.stride + 60 > ends[:, :1]).any())
        next(module.step_losses(0)).sum().backward()
        gradients.append(module.network.get_parameter("w_out").grad)
    assert torch.equal(*gradients)
