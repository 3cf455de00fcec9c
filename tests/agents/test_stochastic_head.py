"""The stochastic head: noise on the acceleration, drawn from a generator."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cfx.agents import checkpoint
from cfx.agents.heads.stochastic import SCALE, StochasticHead
from cfx.models.krauss import Krauss
from cfx.models.residual import JERK, TARGET, TIME
from cfx.policies.features import History
from tests.sumo.policies import adaptive

WINDOW_S = 0.5


def parameters(time: float, target: float, scale: float, count: int) -> torch.Tensor:
    head = StochasticHead.for_model(Krauss())
    values = head.space.defaults().expand(count, -1).clone()
    for parameter, value in ((TIME, time), (TARGET, target), (SCALE, scale)):
        values[:, head.space.names.index(parameter.name)] = value
    return values


def test_the_residual_is_an_ar_process_of_the_scale_that_the_network_says() -> None:
    """Mean, standard deviation and correlation from window to window, in the long run."""
    head, time, target, scale = StochasticHead.for_model(Krauss()), 1.5, 0.3, 0.4
    chosen = parameters(time, target, scale, 4_000)
    column = head.space.names.index(TARGET.name)
    kept = math.exp(-WINDOW_S / time)
    generator = torch.Generator().manual_seed(0)
    residual = torch.zeros(4_000).double()
    for _ in range(40):
        before = residual
        noise = torch.randn((4_000, 1), generator=generator).double()
        drawn = head.sampled(chosen, noise, WINDOW_S)[:, column]
        residual = drawn + (residual - drawn) * kept
    assert float(residual.mean()) == pytest.approx(target, abs=0.02)
    assert float(residual.std()) == pytest.approx(scale, rel=0.05)
    together = torch.corrcoef(torch.stack([before, residual]))
    assert float(together[0, 1]) == pytest.approx(kept, abs=0.03)


def test_the_jerk_is_measured_between_the_last_two_frames_and_bounded() -> None:
    head = StochasticHead.for_model(Krauss())
    chosen = parameters(2.0, 0.0, 0.3, 3)
    blank = torch.zeros((3, 5)).double()
    acceleration = blank.clone()
    acceleration[:, -1] = torch.tensor([0.1, -0.05, 2.0])
    history = History(blank, blank, blank, acceleration, blank)
    found = head.measured(chosen, history, 0.1)
    column = head.space.names.index(JERK.name)
    assert found[:, column].tolist() == pytest.approx([1.0, -0.5, JERK.high])
    others = torch.arange(chosen.shape[-1]) != column
    assert torch.equal(found[:, others], chosen[:, others])
    first = blank[:, :1]
    one = History(first, first, first, first, first)
    assert torch.equal(head.measured(chosen, one, 0.1), chosen)


def test_nothing_but_the_target_is_drawn() -> None:
    head = StochasticHead.for_model(Krauss())
    chosen = parameters(2.0, 0.0, 0.3, 5)
    drawn = head.sampled(chosen, torch.ones((5, 1)).double(), WINDOW_S)
    column = head.space.names.index(TARGET.name)
    others = torch.arange(chosen.shape[-1]) != column
    assert torch.equal(drawn[:, others], chosen[:, others])
    assert bool((drawn[:, column] > chosen[:, column]).all())
    assert torch.equal(head.sampled(chosen, torch.zeros((5, 1)).double(), WINDOW_S), chosen)


def test_an_agent_draws_only_from_a_generator_and_the_same_from_the_same_seed() -> None:
    agent = adaptive({"name": "krauss"}, stochastic=True)
    assert agent.is_stochastic
    network = torch.zeros(3, dtype=torch.int64)
    shape = (3, agent.windows.length)
    history = History(*(torch.full(shape, value).double() for value in (9.0, 0.0, 9.0, 0.1, 20.0)))
    state = agent.begin(network)

    def act(seed: int | None) -> torch.Tensor:
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return agent.act(history, state, generator)[0]

    column = agent.space.names.index(TARGET.name)
    assert torch.equal(act(None), act(None))
    assert torch.equal(act(3), act(3))
    assert not torch.equal(act(3), act(4))
    assert len(act(3)[:, column].unique()) == 3, "each driver has noise of their own"
    time = agent.space.names.index(TIME.name)
    assert torch.equal(act(3)[:, time], act(None)[:, time])


def test_dispersion_widens_the_noise_and_is_saved(tmp_path: Path) -> None:
    agent = adaptive({"name": "krauss"}, stochastic=True)
    wide = replace(agent, dispersion=torch.tensor([2.0]))
    checkpoint.save(wide, tmp_path)
    loaded = checkpoint.load(tmp_path)
    assert loaded.dispersion is not None
    assert loaded.dispersion.tolist() == [2.0]
    shape = (1, agent.windows.length)
    history = History(*(torch.full(shape, value).double() for value in (9.0, 0.0, 9.0, 0.1, 20.0)))
    column = agent.space.names.index(TARGET.name)
    drawn = []
    for one in (agent, loaded):
        state = one.begin(torch.zeros(1, dtype=torch.int64))
        centre, _ = one.act(history, state)
        sampled, _ = one.act(history, state, torch.Generator().manual_seed(0))
        drawn.append(float((sampled - centre)[0, column]))
    assert drawn[1] == pytest.approx(2.0 * drawn[0], rel=1e-6)
