from __future__ import annotations

import pytest
import torch

from cfx.contracts import ModelContract
from cfx.models.base import Follower, Leader
from cfx.models.w99 import W99


class TestSumo(ModelContract):
    @pytest.fixture
    def model(self) -> W99:
        return W99()


class TestVissim(ModelContract):
    @pytest.fixture
    def model(self) -> W99:
        return W99(variant="vissim")


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
