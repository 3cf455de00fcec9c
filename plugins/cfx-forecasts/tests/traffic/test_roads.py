"""Simulated roads against theory: equilibrium, string stability, conservation of vehicles."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import cfx
from cfx.evaluation.roads import (
    Bottleneck,
    Driven,
    Lanes,
    joined,
    open_roads,
    platoons,
    ring_roads,
    simulate_roads,
)
from cfx.models.base import DrivingModel
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx_forecasts.traffic.edie import region
from cfx_forecasts.traffic.measure import Settled
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


@pytest.mark.parametrize(("share", "grows"), [(0.7, False), (1.6, True)])
def test_the_optimal_velocity_model_is_unstable_where_theory_says_so(
    share: float, *, grows: bool
) -> None:
    """Bando et al. (1995): unstable where V'(s) > 1 / (2 tau)."""
    pytest.importorskip("cfx_community", reason="the model is cfx-community's")
    from cfx_community.models.optimal_velocity import optimal_velocity
    from cfx_community.models.ovm import OVM

    model = OVM()
    p = model.space.unpack(model.space.defaults())
    gap = torch.tensor(1000.0 / 45.0 - LENGTH).double().requires_grad_()
    optimal_velocity(gap, p).backward()
    assert gap.grad is not None
    critical = 0.5 / float(gap.grad)
    values = model.space.defaults().tolist()
    values[model.space.names.index("tau")] = share * critical
    assert (growth(model, 45.0, *values) > 1.0) == grows


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


def test_what_enters_an_open_road_leaves_it() -> None:
    zone = Bottleneck(300.0, 500.0, 30.0)
    lanes = open_roads((600.0, 1200.0), 12.0, 400.0, zone, LENGTH)
    found = driven(IDM(), lanes, 400.0)
    settled = Settled.of(found, lanes, 200.0)
    for road, demand in zip(lanes.roads, (600.0, 1200.0), strict=True):
        place = (settled.position[road.vehicles], settled.speed[road.vehicles])
        for begin, end in ((0.0, 200.0), (600.0, 1000.0)):
            assert region(*place, begin, end).flow == pytest.approx(demand, rel=0.05)


def test_a_bottleneck_lets_through_what_drivers_take_at_its_limit() -> None:
    """Behind the queue the flow is that of the equilibrium at the limit."""
    model, calm, limit = IDM(), (20.0, 1.5, 2.0, 2.0, 2.0), 5.0
    lanes = open_roads((2000.0,), 15.0, 500.0, Bottleneck(600.0, 1200.0, limit), LENGTH)
    found = driven(model, lanes, 500.0, *calm)
    assert bool((found.min_gap > 0).all())
    settled = Settled.of(found, lanes, 350.0)
    gap = (2.0 + limit * 1.5) / (1.0 - (limit / 20.0) ** 4) ** 0.5
    capacity = 3600.0 * limit / (gap + LENGTH)
    out = region(settled.position, settled.speed, 1200.0, 1500.0)
    before = region(settled.position, settled.speed, 100.0, 600.0)
    assert out.flow == pytest.approx(capacity, rel=0.03)
    assert before.flow == pytest.approx(capacity, rel=0.05)
    assert before.speed < 1.2 * limit
    inside = (settled.position > 900.0) & (settled.position < 1200.0)
    assert float(settled.speed[inside].max()) <= limit + 1e-9


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
