"""The guard: whatever a model wants, a vehicle does what a vehicle can."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.limits import LimitSettings, at_limits, limited_speed
from cfx.models.w99 import W99
from cfx.simulation.step import advance_vehicle

DT = 0.1
speeds = st.floats(0.0, 60.0)
accelerations = st.floats(-9.0, 2.6)


def tensor(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


@given(speed=speeds, before=accelerations, wanted=speeds, lag=st.none() | st.floats(0.01, 2.0))
def test_no_step_leaves_the_limits(
    speed: float, before: float, wanted: float, lag: float | None
) -> None:
    limits = LimitSettings(response_time=lag)
    after = float(limited_speed(limits, tensor(speed), tensor(before), tensor(wanted), DT))
    acceleration = (after - speed) / DT
    assert after >= 0.0
    assert -limits.emergency_deceleration - 1e-9 <= acceleration <= limits.acceleration + 1e-9


@given(speed=speeds, acceleration=accelerations)
def test_what_a_vehicle_can_do_is_left_as_it_is(speed: float, acceleration: float) -> None:
    wanted = max(0.0, speed + acceleration * DT)
    after = limited_speed(LimitSettings(), tensor(speed), tensor(0.0), tensor(wanted), DT)
    assert float(after) == pytest.approx(wanted, abs=1e-12)


def test_without_limits_a_model_does_what_it_wants() -> None:
    assert float(limited_speed(None, tensor(20.0), tensor(0.0), tensor(0.0), DT)) == 0.0


def test_a_response_time_is_a_first_order_lag() -> None:
    """Its closed form after n steps: `a (1 - exp(-n dt / t))`."""
    limits = LimitSettings(response_time=0.4)
    speed, acceleration = tensor(10.0), tensor(0.0)
    for _ in range(7):
        after = limited_speed(limits, speed, acceleration, speed + 1.5 * DT, DT)
        speed, acceleration = after, (after - speed) / DT
    assert float(acceleration) == pytest.approx(1.5 * (1.0 - math.exp(-0.7 / 0.4)))


def check_limits(model: DrivingModel, seed: int) -> None:
    """Takes a step from 32 random states with random parameters, and looks at the accelerations."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        lots = torch.rand(32, generator=generator, dtype=torch.float64)
        return low + (high - low) * lots

    speed = between(0.0, 40.0)
    follower = Follower(between(0.0, 1.0), speed, between(-3.0, 2.0), model.initial_memory(speed))
    leader = Leader(between(3.0, 60.0), between(0.0, 40.0), between(-9.0, 3.0), tensor(4.5))
    lots = torch.rand((32, len(model.space)), generator=generator, dtype=torch.float64)
    p = model.space.unpack(model.space.from_unit(lots))
    after = advance_vehicle(model, follower, leader, p, DT)
    assert bool((after.acceleration <= 2.6 + 1e-9).all())
    assert bool((after.acceleration >= -9.0 - 1e-9).all())


@pytest.mark.parametrize("model", [Krauss(), IDM(), W99()], ids=lambda one: type(one).__name__)
@given(seed=st.integers(0, 1000))
def test_any_parameters_at_any_moment_keep_to_the_limits(model: DrivingModel, seed: int) -> None:
    """So that a change of parameters never makes the speed jump."""
    check_limits(model, seed)


def test_frames_at_a_limit_are_found() -> None:
    speed = torch.tensor([[10.0, 10.26, 10.26, 9.36, 9.0]], dtype=torch.float64)
    found = at_limits(LimitSettings(), speed, DT)
    assert found.tolist() == [[False, True, False, True, False]]
    assert not bool(at_limits(None, speed, DT).any())


def test_comfort_cannot_exceed_emergency() -> None:
    with pytest.raises(ConfigError, match=r"comfortable_deceleration=9\.5 exceeds"):
        IDM(limits={"comfortable_deceleration": 9.5})


def test_models_say_whether_their_braking_is_bounded() -> None:
    assert IDM().brakes_within_bounds
    assert not IDM(limits=None).brakes_within_bounds
    assert not Krauss(limits=None).brakes_within_bounds
    assert Krauss(limits=None, variant="sumo").brakes_within_bounds
    assert W99(limits=None).brakes_within_bounds
