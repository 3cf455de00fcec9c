"""A driver trained at one time step drives in simulations with other steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from cfx.data.signals import OBSERVED
from cfx.errors import SumoError
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.driver import Driver
from cfx_sumo.live.fleet import Fleet
from tests.agents import adaptive
from tests.road import Car, Road

pytest.importorskip("traci", reason="needs the extra sumo")

SECONDS = 30


class Motion:
    """A follower behind a leader that accelerates and brakes, in steps of `dt` as SUMO's."""

    def __init__(self, dt: float) -> None:
        self.road = Road(dt=dt, lead=Car(speed=12.0), car=Car(speed=11.0, gap=18.0, leader="lead"))
        self.dt, self.steps = dt, 0
        self.place = 0.0
        self.ahead = 18.0
        self.told: list[float] = []
        self.at: dict[int, tuple[float, float]] = {}

    @staticmethod
    def leader(time: float) -> tuple[float, float]:
        """Returns a leader's distance, m, and speed, m/s."""
        return 12.0 * time + 8.0 * (1.0 - math.cos(0.4 * time)), 12.0 + 3.2 * math.sin(0.4 * time)

    def go(self, step: Callable[[Road], None]) -> Motion:
        lead, car = self.road.cars["lead"], self.road.cars["car"]
        for k in range(round(SECONDS / self.dt) + 1):
            time = k * self.dt
            self.road.time = time
            distance, speed = self.leader(time)
            lead.acceleration = (speed - lead.speed) / self.dt
            lead.speed = speed
            car.gap = self.ahead + distance - self.place
            if abs(time - round(time)) < 1e-6:
                self.at[round(time)] = car.speed, car.gap
            step(self.road)
            told = car.told[-1]
            car.acceleration, car.speed = (told - car.speed) / self.dt, told
            self.place += told * self.dt
        return self


def driven(dt: float, **policy: Any) -> Motion:
    driver = Driver(adaptive({"name": "idm"}, **policy), speed_mode=0)
    return Motion(dt).go(lambda road: driver.step(road, "car"))


@pytest.mark.parametrize(
    ("dt", "speed", "gap"),
    [
        pytest.param(0.01, 0.05, 0.3, marks=pytest.mark.slow),
        (0.05, 0.05, 0.3),
        pytest.param(0.2, 0.1, 0.5, marks=pytest.mark.slow),
        (0.25, 0.2, 1.0),  # two steps of 0.125 s
        pytest.param(0.5, 0.2, 0.8, marks=pytest.mark.slow),
        (1.0, 0.5, 2.0),
    ],
)
@pytest.mark.parametrize("residual", [False, True])
def test_trajectories_are_those_at_the_policys_own_step(
    dt: float, speed: float, gap: float, residual: bool
) -> None:
    """To within m/s and m; the error with which cfx reproduces drivers is several times that."""
    own = driven(0.1, residual=residual).at
    other = driven(dt, residual=residual).at
    assert len(other) == SECONDS + 1
    for second, (own_speed, own_gap) in own.items():
        assert other[second] == (
            pytest.approx(own_speed, abs=speed),
            pytest.approx(own_gap, abs=gap),
        )


@pytest.mark.parametrize("drivers", [1, 2])
def test_in_a_long_step_a_leader_that_is_driven_is_where_its_own_steps_lead(drivers: int) -> None:
    """So vehicles in a row drive as at the policy's own step, and none answers what was."""

    def speeds_after(dt: float, seconds: float) -> list[float]:
        lead = Car(speed=10.0, kind="other")
        first = Car(speed=12.0, gap=20.0, leader="lead")
        second = Car(speed=12.0, gap=25.0, leader="first")
        road = Road(dt=dt, lead=lead, free=Car(), second=second, first=first)
        made = [Driver(adaptive({"name": "idm"}), speed_mode=0) for _ in range(drivers)]
        fleet = Fleet({"calm": made[0], "hasty": made[-1]})
        first.kind = "hasty"
        for _ in range(round(seconds / dt)):
            fleet.step(road)
            for car in (first, second):
                car.acceleration, car.speed = (car.told[-1] - car.speed) / dt, car.told[-1]
            first.gap += (lead.speed - first.speed) * dt
            second.gap += (first.speed - second.speed) * dt
            road.advance()
        return [first.speed, second.speed]

    assert speeds_after(0.5, 0.5) == pytest.approx(speeds_after(0.1, 0.5), abs=1e-9)
    assert min(speeds_after(0.1, 0.5)) > 8.0, "limits of braking would make all alike"


def test_acceleration_is_held_between_the_models_steps() -> None:
    told = driven(0.02).road.cars["car"].told
    first = torch.tensor(told[:50]).diff().reshape(-1)
    held = torch.cat([torch.tensor([told[0] - 11.0]), first]).reshape(-1, 5)
    assert torch.allclose(held, held[:, :1].expand(-1, 5), atol=1e-6)
    assert len(set(held[:, 0].tolist())) > 5


def test_history_holds_what_the_leader_did_within_a_long_step() -> None:
    driver = Driver(adaptive({"name": "idm"}, length=8), speed_mode=0)
    Motion(0.5).go(lambda road: driver.step(road, "car"))
    history = driver._vehicles.table.history[driver._vehicles.row("car")]
    speeds = history[OBSERVED.index("leader_speed")].tolist()
    # The frame at 30 s is followed by four that are expected; before it are those of a past step.
    end = len(speeds) - 5
    for number in range(4):
        time = SECONDS - 0.1 * (end - number)
        assert speeds[number] == pytest.approx(Motion.leader(time)[1], abs=0.02)


def test_a_watched_vehicle_is_known_when_it_is_taken_over() -> None:
    """In long steps and short ones: the policy chooses what it chooses at its own step."""
    chosen = []
    for dt in (0.1, 0.05, 0.5):
        driver = Driver(adaptive({"name": "idm"}), speed_mode=0)
        road = Road(dt=dt, lead=Car(speed=12.0), car=Car(speed=12.0, gap=20.0, leader="lead"))
        for k in range(round(4.0 / dt) + 1):
            road.time = k * dt
            driver.step(road, "car", drive=k * dt > 3.75)
        chosen.append(driver.parameters("car"))
        assert road.cars["car"].told
    assert chosen[1] == pytest.approx(chosen[0], rel=1e-6)
    assert chosen[2] == pytest.approx(chosen[0], rel=1e-2)


def test_whole_numbers_of_steps_fit() -> None:
    assert Clock.of(0.1, 0.1, "x") == (0.1, 1, 1, 0.1)
    assert Clock.of(1.0, 0.1, "x") == (1.0, 10, 1, 0.1)
    assert Clock.of(0.01, 0.1, "x")[1:] == (1, 10, pytest.approx(0.1))
    assert Clock.of(0.03, 0.1, "x")[1:] == (1, 3, pytest.approx(0.09))
    assert Clock.of(0.25, 0.1, "x").steps_in(0.5) == 4
    for dt in (0.0, 0.009, 1.01):
        with pytest.raises(SumoError, match=r"drives in steps of 0\.01 to 1 s"):
            Clock.of(dt, 0.1, "x")


def test_speeds_that_sumo_changes_are_counted() -> None:
    road = Road(lead=Car(), car=Car(leader="lead"), other=Car(leader="lead"))
    driver = Driver(adaptive({"name": "idm"}))
    for _ in range(6):
        driver.step(road, ["car", "other"])
        road.cars["car"].speed = road.cars["car"].told[-1]
        road.cars["other"].speed = road.cars["other"].told[-1] - 0.3
        road.advance()
    assert (driver.counts.told, driver.counts.changed) == (10, 5)
