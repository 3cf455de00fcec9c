from __future__ import annotations

from pathlib import Path

import pytest
import torch

import cfx
from cfx.errors import ConfigError
from cfx.models.base import Follower, Leader
from cfx.models.w99 import W99
from cfx_contracts import check_contract


def test_contract_of_the_other_variant() -> None:
    check_contract(W99(variant="vissim"))


def free_acceleration(model: W99, speed: float) -> float:
    p = model.space.unpack(model.space.defaults())
    follower = Follower(
        *(torch.tensor(x, dtype=torch.float64) for x in (0.0, speed, 0.0)), torch.zeros(0)
    )
    leader = Leader(*(torch.tensor(x, dtype=torch.float64) for x in (1000.0, 40.0, 0.0, 5.0)))
    return (model.next_speed(follower, leader, p, 0.1).item() - speed) / 0.1


def test_cc9_has_no_effect_in_sumo_and_is_the_acceleration_at_80_kmh_in_vissim() -> None:
    assert free_acceleration(W99(), 22.2) == pytest.approx(2.0)
    assert free_acceleration(W99(variant="vissim"), 22.2) == pytest.approx(1.5)
    assert free_acceleration(W99(variant="vissim"), 0.0) == pytest.approx(2.0)
    assert free_acceleration(W99(variant="vissim"), 11.1) == pytest.approx(1.75)


def test_cc9_is_tuned_where_it_is_used_and_else_held_at_its_default() -> None:
    assert "cc9" in W99(variant="vissim").space.names
    space = W99(parameters={"cc9": {"default": 2.5}}).space
    assert space.names == tuple(f"cc{number}" for number in range(9))
    assert space.unpack(space.defaults())["cc9"].item() == 2.5


def test_a_job_refuses_to_tune_what_the_variant_does_not_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"cc9\.tuned=true: .* set model\.variant=vissim"):
        cfx.run(["model=w99", "model.parameters.cc9.tuned=true", "policy=fixed", "data=synthetic"])
    with pytest.raises(ConfigError, match=r"b_max\.tuned=true: .* set model\.variant=sumo"):
        cfx.run(["model.parameters.b_max.tuned=true", "model=krauss", "data=synthetic"])


def test_it_does_not_creep_into_a_standing_leader() -> None:
    # Too close behind a standing leader SUMO's rule says a = 0, but the last tenth of CC0 is never
    # given up.
    p = W99().space.unpack(W99().space.defaults())
    leader = Leader(*(torch.tensor(x, dtype=torch.float64) for x in (5.3, 0.0, 0.0, 5.0)))
    for speed, wanted in ((0.3, 0.3), (0.6, 0.0)):
        follower = Follower(
            *(torch.tensor(x, dtype=torch.float64) for x in (0.0, speed, 0.0)), torch.zeros(0)
        )
        assert W99().next_speed(follower, leader, p, 0.1).item() == pytest.approx(wanted)


OF_ITS_REGIME = {
    # Thresholds at 10 m/s: near 1.5 + 1.3 * 10 = 14.5 m, far 14.5 + 8 = 22.5 m.
    "too close": ((10.0, 0.0), (6.0, 9.5, -0.4), -0.4 + 0.5**2 / (1.5 - 6.0)),
    "approaching": ((10.0, 0.0), (40.0, 7.0, 0.0), 0.5 * 3.0**2 / (14.5 - 40.0 - 0.1)),
    "following, slower": ((10.0, -0.4), (20.0, 9.9, 0.0), -0.4),
    "following, faster": ((10.0, 0.1), (20.0, 9.9, 0.0), 0.25),
    "closing the gap": ((10.0, 0.0), (20.0, 11.0, 0.0), 1.0**2 / (22.5 - 20.0)),
}
"""Speed and last acceleration; gap, the leader's speed and acceleration; what follows by hand."""


def acceleration_of(
    model: W99, follower: tuple[float, float], leader: tuple[float, float, float]
) -> float:
    """Returns the acceleration over a step of 0.1 s, m/s2, with SUMO's defaults."""

    def number(value: float) -> torch.Tensor:
        return torch.tensor(value, dtype=torch.float64)

    defaults = {"cc0": 1.5, "cc1": 1.3, "cc2": 8.0, "cc3": -12.0, "cc4": -0.25, "cc5": 0.35}
    defaults |= {"cc6": 6.0, "cc7": 0.25}
    p = dict(model.space.unpack(model.space.defaults()))
    p |= {name: number(value) for name, value in defaults.items()}
    (speed, acceleration), (gap, leader_speed, leader_acceleration) = follower, leader
    next_speed = model.next_speed(
        Follower(number(0.0), number(speed), number(acceleration), torch.zeros(0)),
        Leader(number(gap + 5.0), number(leader_speed), number(leader_acceleration), number(5.0)),
        p,
        0.1,
    )
    return (next_speed.item() - speed) / 0.1


@pytest.mark.parametrize("regime", OF_ITS_REGIME)
def test_each_regime_accelerates_by_its_equation(regime: str) -> None:
    follower, leader, wanted = OF_ITS_REGIME[regime]
    assert acceleration_of(W99(), follower, leader) == pytest.approx(wanted)


def test_mixed_regimes_are_each_what_a_vehicle_can_do() -> None:
    # 0.09 m before the threshold of the gap the approach asks for -1,250 m/s2, which counts half.
    leader = (14.5 - 0.09, 5.0, 0.0)
    exact = acceleration_of(W99(), (10.0, 0.0), leader)
    mixed = acceleration_of(W99().at_temperature(1.0), (10.0, 0.0), leader)
    assert -9.0 < mixed < exact
