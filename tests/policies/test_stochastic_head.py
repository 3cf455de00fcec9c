"""The stochastic head: noise on the acceleration and on parameters, drawn from a generator."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cfx.core.parameters import Parameter
from cfx.models.base import DrivingModel
from cfx.models.composed import HANDOVER, JERK, RELAXATION_TIME, TARGET
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies import checkpoint
from cfx.policies.agent import Agent, AgentState
from cfx.policies.heads.stochastic import NOISE_SCALE, PARAMETER_TIME, StochasticHead
from cfx.policies.history import History
from cfx.policies.valid_range import ValidRange
from tests.agents import adaptive
from tests.histories import observed

WINDOW_S = 0.5
HEAD = StochasticHead.for_model(Krauss())
KRAUSS = {"name": "krauss"}
DRAWN = [HEAD.space.names.index(name) for name in ("t_r", "t_i", HANDOVER.name)]


def column(name: str) -> int:
    return HEAD.space.names.index(name)


def parameters(count: int, *values: tuple[Parameter, float]) -> Tensor:
    """Returns what a network may say of `count` drivers, all else being the defaults."""
    chosen = HEAD.space.defaults().expand(count, -1).clone()
    for parameter, value in values:
        chosen[:, column(parameter.name)] = value
    return chosen


def unseen(count: int) -> Tensor:
    """Returns the latent of drivers of whom nothing was drawn."""
    return torch.zeros((count, HEAD.latent_width)).double()


def drawn_noise(count: int, generator: torch.Generator) -> Tensor:
    return torch.randn((count, HEAD.noise_width), generator=generator).double()


def logits(values: Tensor) -> Tensor:
    """Returns the parameters that are drawn in the squashed space, `(D, q)`."""
    return torch.logit(HEAD.space.to_unit(values)[:, DRAWN])


def steady(count: int, length: int = 5) -> History:
    signals = (9.0, 0.0, 9.0, 0.1, 20.0)
    return observed(*(torch.full((count, length), value).double() for value in signals))


# ---- the acceleration


def test_the_residual_is_an_ar_process_of_the_scale_that_the_network_says() -> None:
    """Mean, standard deviation and correlation from window to window, in the long run."""
    time, target, scale = 1.5, 0.3, 0.4
    chosen = parameters(4_000, (RELAXATION_TIME, time), (TARGET, target), (NOISE_SCALE, scale))
    kept = math.exp(-WINDOW_S / time)
    generator = torch.Generator().manual_seed(0)
    residual, latent = torch.zeros(4_000).double(), unseen(4_000)
    for _ in range(40):
        before = residual
        noise = drawn_noise(4_000, generator)
        drawn, latent = HEAD.sampled(chosen, noise, latent, WINDOW_S)
        goes_to = drawn[:, column(TARGET.name)]
        residual = goes_to + (residual - goes_to) * kept
    assert float(residual.mean()) == pytest.approx(target, abs=0.02)
    assert float(residual.std()) == pytest.approx(scale, rel=0.05)
    together = torch.corrcoef(torch.stack([before, residual]))
    assert float(together[0, 1]) == pytest.approx(kept, abs=0.03)


def test_the_jerk_is_measured_between_the_last_two_frames_and_bounded() -> None:
    chosen = parameters(3)
    blank = torch.zeros((3, 5)).double()
    acceleration = blank.clone()
    acceleration[:, -1] = torch.tensor([0.1, -0.05, 2.0])
    history = observed(blank, blank, blank, acceleration, blank)
    found = HEAD.measured(chosen, history, 0.1)
    assert found[:, column(JERK.name)].tolist() == pytest.approx([1.0, -0.5, JERK.high])
    others = torch.arange(chosen.shape[-1]) != column(JERK.name)
    assert torch.equal(found[:, others], chosen[:, others])
    first = blank[:, :1]
    one = observed(first, first, first, first, first)
    assert torch.equal(HEAD.measured(chosen, one, 0.1), chosen)


def test_of_the_acceleration_nothing_but_the_target_is_drawn() -> None:
    head = HEAD.of_acceleration()
    assert (head.noise_width, head.latent_width) == (1, 0)
    chosen = parameters(5)[:, : len(head.space)]
    nothing = torch.zeros((5, 0)).double()
    drawn, _ = head.sampled(chosen, torch.ones((5, 1)).double(), nothing, WINDOW_S)
    others = torch.arange(chosen.shape[-1]) != column(TARGET.name)
    assert torch.equal(drawn[:, others], chosen[:, others])
    assert bool((drawn[:, column(TARGET.name)] > chosen[:, column(TARGET.name)]).all())


# ---- the parameters


@settings(max_examples=15, deadline=None)
@given(
    scale=st.floats(0.01, 2.0),
    time=st.floats(PARAMETER_TIME.low, PARAMETER_TIME.high),
    unit=st.floats(0.02, 0.98),
    seed=st.integers(0, 1_000),
)
def test_parameters_are_an_ar_process_on_logits(
    scale: float, time: float, unit: float, seed: int
) -> None:
    """Standard deviation from the first window on, and the correlation between windows."""
    chosen = parameters(8_000, (PARAMETER_TIME, time))
    chosen[:, DRAWN] = HEAD.space.from_unit(torch.full_like(chosen, unit))[:, DRAWN]
    chosen[:, -len(DRAWN) :] = scale
    generator, latent = torch.Generator().manual_seed(seed), unseen(8_000)
    moves = []
    for _ in range(3):
        noise = drawn_noise(8_000, generator)
        drawn, latent = HEAD.sampled(chosen, noise, latent, WINDOW_S)
        moves.append(logits(drawn) - logits(chosen))
    for move in moves:
        assert move.mean(0).tolist() == pytest.approx([0.0] * 3, abs=0.06 * scale)
        assert move.std(0).tolist() == pytest.approx([scale] * 3, rel=0.05)
    for windows in (1, 2):
        together = torch.corrcoef(torch.stack([moves[0][:, 0], moves[windows][:, 0]]))
        kept = math.exp(-windows * WINDOW_S / time)
        assert float(together[0, 1]) == pytest.approx(kept, abs=0.06)
    apart = torch.corrcoef(torch.stack([moves[2][:, 0], moves[2][:, 1]]))
    assert float(apart[0, 1]) == pytest.approx(0.0, abs=0.06), "each parameter on its own"


def test_the_noise_keeps_its_variance_whatever_time_constants_follow_one_another() -> None:
    generator = torch.Generator().manual_seed(0)
    chosen, latent = parameters(20_000), unseen(20_000)
    for _ in range(20):
        span = PARAMETER_TIME.high - PARAMETER_TIME.low
        times = torch.rand(20_000, generator=generator).double() * span
        chosen[:, column(PARAMETER_TIME.name)] = PARAMETER_TIME.low + times
        noise = drawn_noise(20_000, generator)
        _, latent = HEAD.sampled(chosen, noise, latent, WINDOW_S)
    assert latent.std(0).tolist() == pytest.approx([1.0] * 3, abs=0.02)


@pytest.mark.parametrize("model", [Krauss(), IDM(), W99()], ids=["krauss", "idm", "w99"])
@pytest.mark.parametrize("unit", [0.0, 0.3, 1.0])
def test_no_draw_leaves_the_bounds(model: DrivingModel, unit: float) -> None:
    head = StochasticHead.for_model(model)
    chosen = head.space.from_unit(torch.full((500, len(head.space)), unit).double())
    generator = torch.Generator().manual_seed(0)
    noise = 4.0 * torch.randn((500, head.noise_width), generator=generator).double()
    latent = torch.zeros((500, head.latent_width)).double()
    drawn, _ = head.sampled(chosen, noise, latent, WINDOW_S)
    own = [*range(len(head.model_space)), head.space.names.index(HANDOVER.name)]
    low, high = head.space.bounds()[:, own]
    assert bool(((low <= drawn[:, own]) & (drawn[:, own] <= high)).all())
    assert torch.equal(drawn[:, own], chosen[:, own]) == (unit == 0.0), "the scale is 0 there"


def test_frozen_parameters_are_not_drawn() -> None:
    head = StochasticHead.for_model(Krauss(adaptation_bounds={"t_i": None}))
    chosen = head.space.defaults().expand(5, -1)
    noise = torch.ones((5, head.noise_width)).double()
    drawn, _ = head.sampled(chosen, noise, unseen(5), WINDOW_S)
    assert torch.equal(drawn[:, 1], chosen[:, 1])
    assert bool((drawn[:, 0] > chosen[:, 0]).all())
    answer = torch.full((1, len(head.space)), 0.9).double()
    base = head.space.to_unit(head.space.defaults())[None]
    scale = head.space.names.index("t_i_scale")
    assert float(head.unit_parameters(answer, base)[0, scale]) == 0.0, "no answer changes that"


def test_nothing_is_drawn_without_noise() -> None:
    chosen = parameters(5)
    noise = torch.zeros((5, HEAD.noise_width)).double()
    drawn, latent = HEAD.sampled(chosen, noise, unseen(5), WINDOW_S)
    assert torch.equal(drawn, chosen)
    assert torch.equal(latent, unseen(5))


def test_gradients_reach_scales_and_the_time_constant() -> None:
    chosen = parameters(50).requires_grad_()
    generator, latent = torch.Generator().manual_seed(0), unseen(50)
    for _ in range(2):
        noise = drawn_noise(50, generator)
        drawn, latent = HEAD.sampled(chosen, noise, latent, WINDOW_S)
    drawn[:, DRAWN].square().sum().backward()
    assert chosen.grad is not None
    assert bool(chosen.grad.isfinite().all())
    reached = chosen.grad.abs().sum(0) > 0
    for name in ("t_r", "t_r_scale", "t_i_scale", "residual_handover_scale", PARAMETER_TIME.name):
        assert bool(reached[column(name)])


# ---- agents


def act(agent: Agent, state: AgentState, seed: int | None) -> tuple[Tensor, AgentState]:
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return agent.act(steady(len(state.network), agent.windows.length), state, generator)


def test_an_agent_draws_only_from_a_generator_and_the_same_from_the_same_seed() -> None:
    agent = adaptive(KRAUSS, stochastic=True)
    assert agent.core.head.is_stochastic
    state = agent.begin(torch.zeros(3, dtype=torch.int64))
    centre, after = act(agent, state, None)
    assert torch.equal(act(agent, state, None)[0], centre)
    assert torch.equal(after.latent, unseen(3)), "nothing was drawn"
    sampled, after = act(agent, state, 3)
    assert torch.equal(act(agent, state, 3)[0], sampled)
    assert not torch.equal(act(agent, state, 4)[0], sampled)
    for name in ("t_r", TARGET.name):
        assert len(sampled[:, column(name)].unique()) == 3, "each driver has noise of their own"
    time = column(RELAXATION_TIME.name)
    assert torch.equal(sampled[:, time], centre[:, time])
    assert len(after.latent.unique()) == 9


def test_a_sampled_driver_stays_themselves_for_seconds() -> None:
    """Also where states are copied, from window to window."""
    agent = adaptive(KRAUSS, stochastic=True)
    state = agent.begin(torch.zeros(200, dtype=torch.int64))
    generator = torch.Generator().manual_seed(0)
    history = steady(200, agent.windows.length)
    _, first = agent.act(history, state, generator)
    every_other = torch.arange(0, 200, 2)
    some = first.of(every_other)
    assert torch.equal(some.latent, first.latent[every_other])
    centre, _ = act(agent, some, None)
    kept = torch.exp(-WINDOW_S / centre[:, column(PARAMETER_TIME.name)])
    _, second = agent.act(steady(100, agent.windows.length), some, generator)
    together = torch.corrcoef(torch.stack([some.latent[:, 0], second.latent[:, 0]]))
    assert float(together[0, 1]) == pytest.approx(float(kept.mean()), abs=0.1)


def test_outside_the_valid_range_scales_fade_to_what_they_are_at_first() -> None:
    rows = torch.randn((500, 5), generator=torch.Generator().manual_seed(0)).double()
    agent = adaptive(KRAUSS, stochastic=True)
    agent = replace(agent, base=HEAD.space.defaults()[None])
    far = replace(agent, valid_range=ValidRange.of([rows * 0.1 + 100.0]))
    network = torch.zeros(1, dtype=torch.int64)
    inside, _ = act(agent, agent.begin(network), None)
    outside, _ = act(far, far.begin(network), None)
    scales = [column("t_r_scale"), column("t_i_scale"), column(PARAMETER_TIME.name)]
    assert not torch.allclose(inside[:, scales], HEAD.space.defaults()[scales])
    torch.testing.assert_close(outside[0, scales], HEAD.space.defaults()[scales])


def test_dispersion_widens_the_noise_and_is_saved(tmp_path: Path) -> None:
    agent = adaptive(KRAUSS, stochastic=True)
    wide = replace(agent, dispersion=torch.tensor([2.0]))
    checkpoint.save_agent(wide, tmp_path)
    loaded = checkpoint.load_agent(tmp_path)
    assert loaded.dispersion is not None
    assert loaded.dispersion.tolist() == [2.0]
    targets, moves = [], []
    for one in (agent, loaded):
        state = one.begin(torch.zeros(1, dtype=torch.int64))
        centre, _ = act(one, state, None)
        sampled, _ = act(one, state, 0)
        targets.append(float((sampled - centre)[0, column(TARGET.name)]))
        moves.append((logits(sampled) - logits(centre))[0].tolist())
    assert targets[1] == pytest.approx(2.0 * targets[0], rel=1e-6)
    assert moves[1] == pytest.approx([2.0 * move for move in moves[0]], rel=1e-6)


def test_vehicles_on_a_road_vary_as_was_learned_not_as_wide_as_forecasts() -> None:
    agent = adaptive(KRAUSS, stochastic=True)
    wide = replace(agent, dispersion=torch.tensor([3.0]))
    state = agent.begin(torch.zeros(1, dtype=torch.int64))
    assert not torch.equal(act(wide, state, 0)[0], act(agent, state, 0)[0])
    assert torch.equal(act(wide.for_live_driving(), state, 0)[0], act(agent, state, 0)[0])


def test_a_saved_policy_draws_as_it_did(tmp_path: Path) -> None:
    agent = adaptive(KRAUSS, ("one", "two"), stochastic=True)
    checkpoint.save_agent(agent, tmp_path)
    loaded = checkpoint.load_agent(tmp_path)
    network = torch.tensor([0, 1, 1])
    for seed in (None, 0):
        expected, _ = act(agent, agent.begin(network), seed)
        assert torch.equal(act(loaded, loaded.begin(network), seed)[0], expected)
