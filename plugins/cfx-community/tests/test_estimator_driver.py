"""Live: a classical estimator learns while it watches a vehicle, and keeps that when it drives it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.models.krauss import Krauss
from cfx.policies.agent import Agent
from cfx_community.policies.estimator import EstimatorPolicy

pytest.importorskip("cfx_sumo", reason="its live driver drives here")

from cfx_sumo.live.driver import Driver
from tests.road import Car, Road

from .test_estimators import ESTIMATORS, agent_of


def live(policy: EstimatorPolicy) -> Agent:
    prior = torch.tensor([[1.5, 0.15]], dtype=torch.float64)
    return replace(agent_of(policy, Krauss(), prior), names=("all",))


def waves(road: Road, step: int) -> None:
    """The leader's speed varies, and the follower keeps 0.8 s behind."""
    now = torch.tensor([step, step - 8, step - 9]) * 0.1
    speed = 12.0 + 3.0 * torch.sin(0.7 * now)
    lead, car = road.cars["lead"], road.cars["car"]
    lead.acceleration = 10 * (float(speed[0]) - lead.speed)
    lead.speed = float(speed[0])
    car.acceleration = 10 * float(speed[1] - speed[2])
    car.speed = float(speed[1])
    car.gap += 0.1 * (lead.speed - car.speed)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_what_was_watched_is_kept_while_driving(name: str) -> None:
    road = Road(lead=Car(speed=12.0), car=Car(speed=12.0, gap=10.0, leader="lead"))
    driver = Driver(live(ESTIMATORS[name]))
    for step in range(80):
        waves(road, step)
        driver.step(road, "car", drive=False)
        road.advance()
    chosen = []
    for step in range(80, 100):
        waves(road, step)
        driver.step(road, "car")
        road.advance()
        chosen.append(driver.parameters("car"))
    assert chosen[0]["t_r"] == pytest.approx(0.8, abs=0.3)
    assert chosen[0] == chosen[-1]
    assert len(road.cars["car"].told) == 20


def test_a_vehicle_that_nobody_watched_has_the_pooled_parameters() -> None:
    road = Road(lead=Car(speed=12.0), car=Car(speed=12.0, gap=10.0, leader="lead"))
    driver = Driver(live(ESTIMATORS["ukf"]))
    for step in range(12):
        waves(road, step)
        driver.step(road, "car")
        road.advance()
    assert driver.parameters("car")["t_r"] == pytest.approx(1.5)
