"""Simulated roads against theory: equilibrium, string stability, order of vehicles."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import cfx
from cfx.evaluation.roads import (
    Driven,
    Lanes,
    joined,
    platoons,
    ring_roads,
    simulate_roads,
)
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from tests.evaluation.test_closed_loop import adaptive, constant
from tests.evaluation.test_platoon import STABLE, UNSTABLE, Linear

LENGTH = 5.0


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def driven(model: DrivingModel, lanes: Lanes, seconds: float, *values: float) -> Driven:
    """Lets the same constant parameters drive every vehicle; none given: the defaults."""
    parameters = model.space.defaults()[None]
    if values:
        parameters = torch.tensor([values]).double()
    agent = constant(model, parameters)
    state = agent.begin(torch.zeros(len(lanes), dtype=torch.int64))
    return simulate_roads(model, agent, state, lanes, seconds)


def rings(*densities: float, vehicles: int = 12, perturbation: float = 0.1) -> Lanes:
    return ring_roads(densities, vehicles, 1, LENGTH, perturbation, drawn())


def test_a_calm_ring_has_the_equilibrium_of_idm() -> None:
    """Treiber et al. (2000), eq. 8: s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^delta)."""
    model, calm = IDM(), (20.0, 1.5, 2.0, 2.0, 2.0)
    v0, headway, s0 = calm[:3]
    found = driven(model, rings(30.0, 60.0, 90.0), 500.0, *calm)
    for k, density in enumerate((30.0, 60.0, 90.0)):
        speeds = found.speed[k * 12 : (k + 1) * 12, -1]
        assert float(speeds.std()) < 0.01
        speed = float(speeds.mean())
        gap = (s0 + speed * headway) / (1.0 - (speed / v0) ** 4) ** 0.5
        assert 1000.0 / density - LENGTH == pytest.approx(gap, rel=1e-3)


def growth(model: DrivingModel, density: float, *values: float) -> float:
    """Returns by how much the standard deviation of speeds on a ring grows."""
    found = driven(model, rings(density, vehicles=40, perturbation=0.02), 300.0, *values)
    std = found.speed.std(0)
    # Short waves have died out after twenty seconds; the long ones decide.
    return float(std[-1] / std[round(20.0 / found.interval)])


def test_a_linear_model_is_unstable_where_theory_says_so() -> None:
    """Treiber and Kesting (2013), eq. 15: stable where k_gap h^2 + 2 k_speed h > 2."""
    assert growth(Linear(), 40.0, *STABLE) < 0.5
    assert growth(Linear(), 40.0, *UNSTABLE) > 2.0


@pytest.mark.parametrize("model", [IDM(), Krauss(), W99()])
def test_vehicles_of_a_ring_stay_in_order_and_on_it(model: DrivingModel) -> None:
    lanes = rings(40.0, 90.0)
    found = driven(model, lanes, 60.0)
    assert bool((found.min_gap >= 0).all())
    for road in lanes.roads:
        place = found.position[road.vehicles]
        assert bool((place[:-1] > place[1:]).all())
        # All gaps and vehicles together are the ring at any time.
        ahead = torch.roll(place, 1, 0)
        ahead[0] += road.circumference
        total = (ahead - place).sum(0)
        assert torch.allclose(total, torch.full_like(total, road.circumference))


def test_leaders_of_platoons_keep_their_speed_and_followers_settle() -> None:
    lanes = platoons((4.0, 10.0), 6, 2, LENGTH)
    found = driven(IDM(), lanes, 200.0)
    for road in lanes.roads:
        speeds = found.speed[road.vehicles]
        assert bool((speeds[0] == road.level).all())
        assert torch.allclose(speeds[:, -1], torch.full((6,), road.level).double(), atol=0.01)


def test_roads_that_are_simulated_together_do_not_meet() -> None:
    model = Krauss()
    one, other = rings(40.0, vehicles=7), platoons((8.0,), 5, 1, LENGTH)
    together = driven(model, joined([one, other]), 30.0)
    assert torch.equal(together.position[:7], driven(model, one, 30.0).position)
    assert torch.equal(together.position[7:], driven(model, other, 30.0).position)


def test_recurrent_policies_drive_each_vehicle_as_the_driver_that_it_is() -> None:
    """The same drivers at other places of the state's grid drive the same."""
    model = Krauss()
    agent = adaptive(model, cfx.get("policy", "gru")(hidden_size=4), networks=3, features=30)
    with torch.no_grad():
        for weights in agent.core.network.parameters():
            weights.add_(torch.randn(weights.shape, generator=drawn()))
    lanes = rings(40.0, vehicles=8)
    start = agent.begin(torch.tensor([0, 1, 2]))
    drivers = torch.tensor([2, 0, 1, 1, 2, 0, 0, 2])

    def position(state: Tensor) -> Tensor:
        return simulate_roads(model, agent, start.of(state), lanes, 10.0).position

    before = position(drivers)
    assert torch.equal(before, position(drivers))
    assert not torch.equal(before, position(drivers.flip(0)))
    again = agent.begin(torch.tensor([0, 1, 2])[drivers])
    assert torch.equal(before, simulate_roads(model, agent, again, lanes, 10.0).position)
