"""Each metric against its closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.evaluation.metrics.base import Trajectories
from cfx.evaluation.metrics.errors import (
    FinalPositionError,
    MaeGap,
    MaeSpeed,
    NrmseGap,
    NrmseSpeed,
    RmseAcceleration,
    RmseGap,
    RmseSpeed,
    TheilU,
)
from cfx.evaluation.metrics.safety import (
    AtBounds,
    Collisions,
    HardBraking,
    HardBrakingShare,
    Jerk,
    MinTtc,
)

SPACE = ParameterSpace.of(
    Parameter("t", "s", 0.0, 10.0, 1.0, "time"),
    Parameter("a", "m/s2", 1.0, 2.0, 1.5, "acceleration"),
)


def one_pair(
    speed: list[float],
    *,
    measured_speed: list[float] | None = None,
    gap: list[float] | None = None,
    measured_gap: list[float] | None = None,
    leader_speed: float = 10.0,
    counted: int | None = None,
    parameters: tuple[float, float] = (5.0, 1.5),
) -> Trajectories:
    """One pair at 0.1 s; of its frames but the first, the first `counted` count."""
    frames = torch.arange(len(speed))

    def row(values: list[float] | None, default: float) -> torch.Tensor:
        if values is None:
            values = [default] * len(speed)
        return torch.tensor([values], dtype=torch.float64)

    last = len(speed) if counted is None else counted
    return Trajectories(
        speed=row(speed, 0.0),
        gap=row(gap, 20.0),
        measured_speed=row(measured_speed, 10.0),
        measured_gap=row(measured_gap, 20.0),
        leader_speed=row(None, leader_speed),
        parameters=torch.tensor(parameters, dtype=torch.float64).expand(1, len(speed), 2),
        counted=((frames > 0) & (frames <= last))[None],
        dt=0.1,
        space=SPACE,
    )


def test_errors_of_speed() -> None:
    given = one_pair([10.0, 11.0, 8.0, 99.0], counted=2)
    rmse = math.sqrt((1 + 4) / 2)
    assert RmseSpeed().compute(given).item() == pytest.approx(rmse)
    assert MaeSpeed().compute(given).item() == pytest.approx(1.5)
    assert NrmseSpeed().compute(given).item() == pytest.approx(rmse / 10)
    size = math.sqrt((121 + 64) / 2) + 10
    assert TheilU().compute(given).item() == pytest.approx(rmse / size)


def test_errors_of_the_gap() -> None:
    given = one_pair([10.0] * 4, gap=[20.0, 21.0, 17.0, -9.0], counted=2)
    rmse = math.sqrt((1 + 9) / 2)
    assert RmseGap().compute(given).item() == pytest.approx(rmse)
    assert MaeGap().compute(given).item() == pytest.approx(2.0)
    assert NrmseGap().compute(given).item() == pytest.approx(rmse / 20)
    assert FinalPositionError().compute(given).item() == pytest.approx(3.0)
    assert Collisions().compute(given).item() == 0
    assert Collisions().compute(replace(given, counted=torch.ones(1, 4).bool())).item() == 1


def test_the_acceleration_at_a_frame_is_that_on_the_way_to_it() -> None:
    given = one_pair([10.0, 10.1, 10.4], measured_speed=[10.0, 10.0, 10.0])
    assert RmseAcceleration().compute(given).item() == pytest.approx(math.sqrt((1 + 9) / 2))


def test_theils_u_is_bounded() -> None:
    opposite = one_pair([0.0, 0.0, 0.0], measured_speed=[3.0, 3.0, 3.0])
    assert TheilU().compute(opposite).item() == pytest.approx(1.0)
    nothing = one_pair([0.0] * 3, measured_speed=[0.0] * 3)
    assert math.isnan(TheilU().compute(nothing).item())


def test_an_acceleration_below_minus_8_is_hard_braking() -> None:
    # -7.9, -8.1, -9 and +9 m/s2 at 0.1 s.
    speed = [20.0, 19.21, 18.4, 17.5, 18.4]
    assert HardBraking().compute(one_pair(speed)).item() == 2
    assert HardBraking().compute(one_pair(speed, counted=2)).item() == 1
    assert HardBrakingShare().compute(one_pair(speed)).item() == pytest.approx(0.5)


def test_jerk_is_the_change_of_the_simulated_acceleration() -> None:
    # a = 2t has a jerk of 2 m/s3; the second has accelerations 1, -1, 1: jerks of 20 and -20.
    time = 0.1 * np.arange(40)
    square = [float(t**2) for t in time]
    assert Jerk().compute(one_pair(square)).item() == pytest.approx(2.0)
    zigzag = [10.0, 10.1, 10.0, 10.1]
    assert Jerk().compute(one_pair(zigzag)).item() == pytest.approx(20.0)
    # Beyond the pair's end nothing counts, and a single frame has no jerk.
    assert Jerk().compute(one_pair([*zigzag, 99.0], counted=3)).item() == pytest.approx(20.0)
    assert math.isnan(Jerk().compute(one_pair([10.0, 10.1, 10.0], counted=1)).item())


@pytest.mark.parametrize(
    ("parameters", "share"),
    [
        ((5.0, 1.5), 0.0),
        ((0.09, 1.5), 0.5),
        ((0.11, 1.5), 0.0),
        ((9.95, 1.995), 1.0),
        ((0.0, 1.0), 1.0),
    ],
)
def test_a_value_within_a_hundredth_of_the_range_is_at_the_bound(
    parameters: tuple[float, float], share: float
) -> None:
    given = one_pair([10.0] * 5, parameters=parameters)
    assert AtBounds().compute(given).item() == pytest.approx(share)


def test_time_to_collision_is_the_gap_over_the_speed_difference() -> None:
    # Frame 0 does not count; then 20 m at 2 m/s, 9 m at 3 m/s, and slower than the leader.
    given = one_pair([30.0, 12.0, 13.0, 9.0], gap=[1.0, 20.0, 9.0, 0.5])
    assert MinTtc().compute(given).item() == pytest.approx(3.0)
    never = one_pair([10.0, 10.0, 9.0])
    assert math.isnan(MinTtc().compute(never).item())
    collided = one_pair([10.0, 9.0, 9.0], gap=[5.0, 1.0, -1.0])
    assert MinTtc().compute(collided).item() == 0
