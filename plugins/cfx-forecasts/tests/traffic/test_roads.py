"""Flows of simulated roads against theory."""

from __future__ import annotations

import pytest
import torch

from cfx.evaluation.roads import Bottleneck, open_roads
from cfx.models.idm import IDM
from cfx_forecasts.traffic.edie import region
from cfx_forecasts.traffic.measure import Settled
from tests.evaluation.test_roads import LENGTH, driven, growth


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
