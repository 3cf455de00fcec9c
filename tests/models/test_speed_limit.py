"""Speed limits of a road, around any model."""

from __future__ import annotations

import torch

from cfx.models.base import Follower, Leader
from cfx.models.composed import COMFORTABLE_BRAKING, SPEED_LIMIT, WithSpeedLimit
from cfx.models.idm import IDM
from cfx.models.w99 import W99


def _states(memory: int) -> tuple[Follower, Leader]:
    speed = torch.tensor([2.0, 8.0, 15.0, 15.0]).double()
    zero = torch.zeros_like(speed)
    follower = Follower(zero, speed, zero, zero[:, None].expand(-1, memory))
    gap = torch.tensor([60.0, 60.0, 60.0, 6.0]).double()
    return follower, Leader(gap + 5.0, speed, zero, torch.tensor(5.0).double())


def test_nobody_exceeds_the_limit_and_who_is_faster_slows_down() -> None:
    model = IDM()
    follower, leader = _states(0)
    p = model.space.unpack(model.space.defaults())
    free = model.next_speed(follower, leader, p, 0.1)
    p[SPEED_LIMIT] = torch.tensor([8.0, 8.0, 6.0, 6.0]).double()
    limited = WithSpeedLimit(model).next_speed(follower, leader, p, 0.1)
    assert limited[0] == free[0]
    assert limited[1] == 8.0
    assert limited[2] == 15.0 - COMFORTABLE_BRAKING * 0.1
    # Whom the leader makes brake harder than the limit does brakes as hard as before.
    assert limited[3] == free[3] < 15.0 - COMFORTABLE_BRAKING * 0.1


def test_without_a_limit_it_is_the_model_itself() -> None:
    for model in (IDM(), W99()):
        around = WithSpeedLimit(model)
        follower, leader = _states(model.memory_size)
        p = model.space.unpack(model.space.defaults())
        p[SPEED_LIMIT] = torch.full((4,), torch.inf).double()
        speed = model.next_speed(follower, leader, p, 0.1)
        assert torch.equal(around.next_speed(follower, leader, p, 0.1), speed)
        memory = model.next_memory(follower, leader, p, 0.1, speed)
        assert torch.equal(around.next_memory(follower, leader, p, 0.1, speed), memory)
        assert around.space == model.space
        assert around.identity() != model.identity()
