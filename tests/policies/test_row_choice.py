"""Networks that answer for rows of a table choose what agents choose."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cfx.data.signals import OBSERVED
from cfx.errors import PluginError
from cfx.policies.agent import Agent
from cfx.policies.context import DriverContext
from cfx.policies.row_choice import DriverRows, RowChoice
from cfx.policies.valid_range import RANGE_SIGNALS, ValidRange
from tests.agents import adaptive

COUNT, TABLE = 9, 20


def drivers_of(agent: Agent, network: Tensor) -> DriverRows:
    """Returns a table of drivers whose histories vary."""
    generator = torch.Generator().manual_seed(5)
    head, length = agent.core.head, agent.windows.length
    begun = agent.begin(torch.zeros(1, dtype=torch.int64))

    def zeros(*width: int) -> Tensor:
        return torch.zeros((TABLE, *width), dtype=torch.float64)

    history = torch.rand((TABLE, len(OBSERVED), length), generator=generator, dtype=torch.float64)
    history = 6.0 + 6.0 * history
    return DriverRows(
        history=history,
        network=network,
        base=zeros(len(agent.space) if head.needs_base else 0),
        conditioning=zeros(begun.conditioning.shape[-1]),
        state=begun.state.new_zeros((TABLE, begun.state.shape[-1])),
        latent=zeros(head.latent_width),
        parameters=zeros(len(agent.space)),
        score=zeros(),
        beyond=zeros(2 * len(RANGE_SIGNALS)),
    )


def with_range(agent: Agent) -> Agent:
    """Returns an agent whose networks learned from slow traffic: some drivers are outside."""
    generator = torch.Generator().manual_seed(6)
    shape = (len(agent.names), 400, len(RANGE_SIGNALS))
    learned = 3.0 + 6.0 * torch.rand(shape, generator=generator, dtype=torch.float64)
    pooled = agent.space.defaults().expand(len(agent.names), -1)
    return replace(agent, valid_range=ValidRange.of(list(learned)), pooled=pooled)


@pytest.mark.parametrize(
    ("names", "options"),
    [
        (("all",), {"residual": True, "driver_features": ("time_gap",)}),
        (("all",), {"stochastic": True}),
        (("one", "two", "three"), {"offsets": True}),
    ],
    ids=["one network", "with noise", "a network for each driver"],
)
def test_rows_are_chosen_as_agents_choose(
    names: tuple[str, ...], options: dict[str, bool | tuple[str, ...]]
) -> None:
    agent = with_range(adaptive({"name": "idm"}, names, **options))  # type: ignore[arg-type]  # one of each
    generator = torch.Generator().manual_seed(7)
    network = torch.randint(len(names), (TABLE,), generator=generator)
    rows = torch.randperm(TABLE, generator=generator)[:COUNT]
    drivers, choice, noise = drivers_of(agent, network), RowChoice(agent), None
    if agent.core.head.is_stochastic:
        width = agent.core.head.noise_width
        noise = torch.randn((COUNT, width), generator=generator, dtype=torch.float64)
    features = torch.full((COUNT, len(agent.core.driver_features)), torch.nan).double()
    context = DriverContext(driver_features=features)
    choice.begin(drivers, rows, context)
    state = agent.begin(network[rows], context)
    history = dict(zip(OBSERVED, drivers.history[rows].unbind(1), strict=True))
    choice.observe(drivers, rows)
    state = agent.observe(history, state, torch.ones(COUNT, dtype=torch.bool))
    for _ in range(2):
        choice.act(drivers, rows, noise)
        chosen, state = agent.act(history, state, noise=noise)
        close = {"rtol": 1e-12, "atol": 1e-12}
        torch.testing.assert_close(drivers.parameters[rows], chosen, **close)
        torch.testing.assert_close(drivers.score[rows], state.score, **close)
        torch.testing.assert_close(drivers.latent[rows], state.latent, **close)
        assert torch.equal(drivers.beyond[rows], state.beyond.double())
        assert torch.equal(drivers.state[rows], state.state[state.network, state.place])
    assert int((state.score > 1.0).sum()) > 0, "some are outside"
    untouched = torch.ones(TABLE, dtype=torch.bool)
    untouched[rows] = False
    assert not bool(drivers.parameters[untouched].any())


def test_answers_that_are_not_finite_are_refused() -> None:
    agent = adaptive({"name": "krauss"})
    for weights in agent.core.network.parameters():
        weights.data.fill_(torch.nan)
    drivers = drivers_of(agent, torch.zeros(TABLE, dtype=torch.int64))
    rows = torch.arange(COUNT)
    choice = RowChoice(agent)
    choice.begin(drivers, rows, DriverContext())
    with pytest.raises(PluginError, match="its networks answer numbers that are not finite"):
        choice.act(drivers, rows)


@pytest.mark.parametrize("name", ["gru", "lstm"])
def test_networks_that_act_at_once_answer_to_the_bits(name: str) -> None:
    from cfx.core import registry
    from cfx.policies.base import Policy
    from cfx.policies.core import Ensemble

    policy = registry.create("policy", {"name": name, "layers": 2, "acting_bias": True})
    assert isinstance(policy, Policy)
    generator = torch.Generator().manual_seed(8)
    fixed = torch.rand((6, 3), generator=generator)
    network = Ensemble(policy.build(4, fixed[0], fixed, generator).eval(), 2)
    for weights in network.parameters():
        weights.data.normal_(0.0, 0.5, generator=generator)
    tokens = torch.randn((3, 7, 4), generator=generator)
    state = torch.randn(network.initial_state(3, 7).shape, generator=generator)
    kept = state.clone()
    with torch.no_grad():
        answers, after = network(tokens[:, :, None], state)
        at_once, then = network.act_once(tokens, state)
    assert torch.equal(at_once, answers[:, :, 0])
    assert torch.equal(then, after)
    assert torch.equal(state, kept), "the state that is given stays"
