"""The traffic of one driver, against theory."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cfx.data.steady import VEHICLE_M
from cfx.errors import DataError
from cfx.evaluation.traffic import (
    PLATOON,
    SPEEDS_MPS,
    Measure,
    driver_traffic,
    recorded_flows,
    settled_gaps,
    table_of,
)
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from tests.agents import adaptive
from tests.evaluation.test_closed_loop import constant


@pytest.mark.slow
def test_a_driver_of_krauss_has_the_traffic_of_theory() -> None:
    """At equilibrium the gap of Krauss's model is v t_r; a ring's flow follows from it."""
    model = Krauss()
    agent = constant(model, torch.tensor([[1.2, 0.0]]).double())
    found = driver_traffic(agent, model, recorded_flows("human"))
    speeds = np.array(SPEEDS_MPS)
    theory = 3600.0 * speeds / (1.2 * speeds + VEHICLE_M)
    np.testing.assert_allclose(found.equilibrium, theory[:, None].repeat(2, 1), rtol=0.01)
    values = {measure.name: measure.value for measure in found.measures}
    assert values["starts_differ"] < 1.0
    assert found.dips.shape == (PLATOON + 1,)
    assert found.dips[0] == pytest.approx(5.0)
    density, flow = found.ring[-1]
    spacing = 1000.0 / density
    assert flow == pytest.approx(3.6 * density * (spacing - VEHICLE_M) / 1.2, rel=0.02)


@pytest.mark.slow
def test_a_driver_who_varies_draws_with_the_seed_on_rings_and_in_platoons() -> None:
    """Equilibria are those of the centre, and nothing is widened as forecasts are."""
    agent = adaptive({"name": "idm"}, stochastic=True)
    first, other = driver_traffic(agent), driver_traffic(agent, seed=1)
    np.testing.assert_array_equal(first.equilibrium, other.equilibrium)
    assert not np.allclose(first.dips, other.dips, atol=1e-3)
    wide = driver_traffic(replace(agent, dispersion=torch.tensor([3.0])))
    np.testing.assert_array_equal(wide.ring, first.ring)
    np.testing.assert_array_equal(wide.dips, first.dips)


def test_a_context_is_that_of_each_follower() -> None:
    """IDM, eq. 8 of Treiber et al. (2000): (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    model = IDM()
    agent = constant(model, torch.tensor([[30.0, 1.5, 2.0, 1.5, 2.0]]).double())
    speed = torch.tensor([5.0, 15.0]).double()
    gaps = settled_gaps(agent, model, speed, torch.tensor([1.0, 2.5]).double())
    theory = (2.0 + 1.5 * speed) / (1.0 - (speed / 30.0) ** 4).sqrt()
    torch.testing.assert_close(gaps, theory, rtol=0.01, atol=0.05)


def test_a_value_outside_has_a_word() -> None:
    assert Measure.of("capacity", 1900.0, 0.1).word == "low"
    assert Measure.of("capacity", 2100.0, 0.1).word == ""
    assert Measure.of("dip_last", 9.0, 0.1).word == "grows"
    assert Measure.of("ring_wave_speed", math.nan, 0.1).text == "none"
    flow = Measure.of_flow(10.5, np.array([1500.0, 1700.0]), 1800.0, 0.1)
    assert (flow.value, flow.word, flow.usual) == (1600.0, "low", "1,620 to 1,980")
    apart = Measure.of_flow(10.5, np.array([1500.0, 2100.0]), 1800.0, 0.1)
    assert apart.word == "low and high"
    assert Measure.of_flow(10.5, np.array([1500.0]), math.nan, 0.1).word == ""
    row = table_of([flow])[0]
    assert (row["measure"], row["outside"], row["usual_low"]) == ("flow_at_10.5", "low", 1620.0)


def test_recorded_flows_are_read(tmp_path: Path) -> None:
    """Those that come with cfx, and a file's type with most drivers."""
    people = recorded_flows("human").at(np.array([4.5, 14.0, 60.0]))
    assert 1000 < people[0] < 1500
    assert 1800 < people[1] < 2200
    assert math.isnan(people[2])
    table = {"speed": [5.0, 9.0], "gap": [10.0, 18.0]}
    table |= {name: [10.0, 18.0] for name in ("low", "median", "high")}
    relations = {"acc": table | {"drivers": [3, 3]}, "human": table | {"drivers": [9, 9]}}
    file = tmp_path / "flows.json"
    file.write_text(json.dumps({"relations": relations}), encoding="utf-8")
    assert recorded_flows(file).of == "human"
    assert recorded_flows(f"{file}#acc").of == "acc"
    with pytest.raises(DataError, match="cfx data flows"):
        recorded_flows(f"{file}#truck")
