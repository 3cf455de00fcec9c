"""An agent's life: begin, observe, act; the same core on the grid and for drivers in any order."""

from __future__ import annotations

import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from cfx.policies.context import DriverContext
from cfx.policies.history import changed, measured_history
from tests.agents import adaptive
from tests.drives import wavy_pairs

NODE = {"name": "krauss"}
TRUE = torch.tensor([[1.5, 0.1], [2.5, 0.4], [2.0, 0.0]], dtype=torch.float64)
BATCH = PairBatch.of(wavy_pairs(Krauss(), TRUE, frames=120))


def history(frame: int, length: int = 5):  # type: ignore[no-untyped-def]
    return measured_history(BATCH, torch.arange(3), torch.full((3,), frame), length)


@pytest.mark.parametrize("offsets", [False, True])
def test_the_grid_and_drivers_in_any_order_get_the_same_parameters(offsets: bool) -> None:
    """One network for three drivers, so that the grid is the drivers in order."""
    agent = adaptive(NODE, offsets=offsets)
    context = DriverContext(TRUE if offsets else None)
    state = agent.begin(torch.zeros(3, dtype=torch.int64), context)
    found, after = agent.act(history(50), state)
    core = agent.core
    base = core.head.space.to_unit(TRUE)[None]
    grid = changed(history(50), lambda signal: signal[None])
    initial = core.network.initial_state(1, 3)
    features = torch.cat([core.encode(grid), core.condition(base, None)], -1)
    answer, grid_after = core.answer(features, initial)
    unit = core.head.unit_parameters(answer, base)
    torch.testing.assert_close(found, core.head.space.from_unit(unit[0]), rtol=0, atol=1e-12)
    torch.testing.assert_close(after.state, grid_after, rtol=0, atol=1e-12)


def test_only_drivers_that_have_a_window_observe_it() -> None:
    agent = adaptive(NODE, ("one", "two"))
    state = agent.begin(torch.tensor([0, 1, 0]))
    present = torch.tensor([True, False, False])
    after = agent.observe(history(50), state, present)
    moved = (after.state != state.state).any(-1)
    assert moved.tolist() == [[True, False], [False, False]]
    everyone = agent.observe(history(50), state, torch.ones(3, dtype=torch.bool))
    assert torch.equal(everyone.state[0, 0], after.state[0, 0])


def test_observing_leaves_the_state_in_which_acting_leaves_it() -> None:
    agent = adaptive(NODE, offsets=True)
    state = agent.begin(torch.zeros(3, dtype=torch.int64))
    observed = agent.observe(history(40), state, torch.ones(3, dtype=torch.bool))
    _, acted = agent.act(history(40), state)
    assert torch.equal(observed.state, acted.state)


def test_burn_in_observes_the_windows_between_two_frames() -> None:
    agent = adaptive(NODE)
    network = torch.zeros(3, dtype=torch.int64)
    state = agent.begin(network)
    everyone = torch.ones(3, dtype=torch.bool)
    for frame in (10, 15, 20):
        state = agent.observe(history(frame), state, everyone)
    until, since = torch.full((3,), 25), torch.full((3,), 10)
    found = agent.burn_in(BATCH, until, agent.begin(network), since)
    assert torch.equal(found.state, state.state)
    nothing = agent.burn_in(BATCH, until, agent.begin(network), until)
    assert torch.equal(nothing.state, agent.begin(network).state)


def test_drivers_without_a_base_start_from_the_agents() -> None:
    agent = adaptive(NODE, ("one", "two"), offsets=True)
    assert agent.base is not None
    network = torch.tensor([1, 0, 1])
    given = agent.begin(network, DriverContext(agent.base[network]))
    assert torch.equal(given.conditioning, agent.begin(network).conditioning)
    other = agent.begin(network, DriverContext(TRUE))
    assert not torch.equal(other.conditioning, given.conditioning)


def test_one_network_of_many_drives_as_it_did_among_them() -> None:
    agent = adaptive(NODE, ("one", "all"), offsets=True)
    alone = agent.for_unseen_drivers()
    assert alone.names == ("all",)
    found, _ = alone.act(history(50), alone.begin(torch.zeros(3, dtype=torch.int64)))
    expected, _ = agent.act(history(50), agent.begin(torch.ones(3, dtype=torch.int64)))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_networks_for_single_pairs_are_for_no_other_driver() -> None:
    with pytest.raises(DataError, match="2 networks, one for each of its own pairs"):
        adaptive(NODE, ("one", "two")).for_unseen_drivers()
