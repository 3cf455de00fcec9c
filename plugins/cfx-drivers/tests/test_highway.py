"""A vehicle of highway-env drives as cfx's closed loop does."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cfx.errors import ConfigError
from cfx.policies.driver_step import Motion
from cfx_drivers.gym.drivers import driver_step

pytest.importorskip("highway_env", reason="highway-env is not installed: pip install highway-env")

from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from cfx_drivers.gym.highway import CfxVehicle


def platoon(followers: int) -> Road:
    """A leader at 12 m/s, and vehicles 20 m behind one another, on one lane."""
    network = RoadNetwork.straight_road_network(1, speed_limit=40)
    road = Road(network, np_random=np.random.RandomState(0))
    road.vehicles = [Vehicle(road, [500.0, 0.0], speed=12.0)]
    for number in range(1, followers + 1):
        vehicle = CfxVehicle(road, [500.0 - 25.0 * number, 0.0], speed=12.0, target_speed=30.0)
        road.vehicles.append(vehicle)
    return road


def test_a_platoon_drives_as_cfx_does() -> None:
    road = platoon(2)
    step = driver_step("cfx://idm")
    state = step.begin(2)
    position = torch.tensor([475.0, 450.0]).double()
    speed, acceleration = torch.full((2,), 12.0).double(), torch.zeros(2).double()
    x_l, v_l, last_v_l = 500.0, 12.0, 12.0
    for number in range(200):
        command = -1.0 if 50 <= number < 90 else 0.0
        road.vehicles[0].act({"steering": 0.0, "acceleration": command})
        road.act()
        road.step(0.1)
        v_ahead = torch.cat([torch.tensor([v_l]).double(), speed[:-1]])
        a_l = torch.tensor([(v_l - last_v_l) / 0.1]).double()
        ahead = torch.cat([torch.tensor([x_l]).double(), position[:-1]])
        a_ahead = torch.cat([a_l, acceleration[:-1]])
        after, state = step(
            state, Motion(speed, acceleration), Motion(v_ahead, a_ahead), ahead - position - 5.0
        )
        acceleration, position, speed = (after - speed) / 0.1, position + after * 0.1, after
        x_l, last_v_l, v_l = x_l + v_l * 0.1, v_l, v_l + command * 0.1
        found = [vehicle.speed for vehicle in road.vehicles[1:]]
        np.testing.assert_allclose(found, speed.numpy(), rtol=0, atol=1e-4)
    assert road.vehicles[1].speed < 10.0


def test_the_lanes_limit_holds_and_another_step_is_refused() -> None:
    road = platoon(1)
    road.vehicles[1].lane.speed_limit = 10.0
    for _ in range(30):
        road.act()
        road.step(0.1)
    assert road.vehicles[1].speed == pytest.approx(10.0)
    road.act()
    with pytest.raises(ConfigError, match="simulation_frequency=10"):
        road.step(1 / 15)


def test_it_drives_in_highway_envs_own_environment() -> None:
    import gymnasium
    import highway_env  # noqa: F401 - registers its environments

    env = gymnasium.make(
        "highway-fast-v0",
        config={
            "other_vehicles_type": "cfx_drivers.gym.highway.CfxVehicle",
            "simulation_frequency": 10,
            "vehicles_count": 10,
            "duration": 5,
        },
    )
    env.reset(seed=0)
    for _ in range(5):
        env.step(env.unwrapped.action_type.actions_indexes["IDLE"])
    others = [one for one in env.unwrapped.road.vehicles if isinstance(one, CfxVehicle)]
    assert len(others) == 10
    assert any(one._driven is not None for one in others)
