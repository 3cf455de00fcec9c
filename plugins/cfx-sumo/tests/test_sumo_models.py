from __future__ import annotations

import pytest
import torch

from cfx.errors import ConfigError
from cfx.models.krauss import Krauss
from cfx.models.vtype import sumo_speed
from cfx.models.w99 import W99
from cfx_sumo.krauss import KraussSumo


def test_krauss_sumo_keeps_its_time_gap_behind_a_steady_leader() -> None:
    from cfx.models.base import Leader
    from cfx.simulation.rollout import simulate_follower
    from cfx.simulation.trajectory import Start

    time = torch.arange(3000, dtype=torch.float64) * 0.1
    speed = torch.full_like(time, 15.0)
    leader = Leader(
        15.0 * time, speed, torch.zeros_like(time), torch.tensor(5.0, dtype=torch.float64)
    )
    start = Start(*(torch.tensor(x, dtype=torch.float64) for x in (-80.0, 15.0, 0.0)))
    gap = simulate_follower(KraussSumo(), {"tau": 1.4}, leader, start, 0.1).gap[-1]
    assert gap.item() == pytest.approx(2.5 + 1.4 * 15.0, abs=0.01)


@pytest.mark.parametrize(
    "model",
    [
        Krauss(),
        Krauss(variant="sumo"),
        Krauss(parameters={"t_i": {"default": 0.0, "tuned": False}}),
        W99(variant="vissim"),
    ],
)
def test_a_variant_that_sumo_does_not_have_says_what_it_has(model: Krauss | W99) -> None:
    with pytest.raises(ConfigError, match="simulator=sumo: SUMO has model="):
        model.sumo_vtype(model.space.unpack(model.space.defaults()))


@pytest.mark.parametrize("dt", [0.1, 0.5, 1.0])
def test_a_vehicle_stops_below_the_speed_at_which_sumo_stops_it(dt: float) -> None:
    """SUMO's slowest speeds at these steps are just above 1e-4 m/s2 times the step."""
    wanted = torch.tensor([0.9e-4, 1.1e-4], dtype=torch.float64) * dt
    one = torch.ones_like(wanted)
    limits = {"accel": 2.6 * one, "decel": 4.5 * one, "emergency_decel": 9.0 * one}
    speed = sumo_speed(0.0 * one, wanted, v_max=50.0 * one, dt=dt, **limits)
    assert speed.tolist() == [0.0, wanted[1].item()]
