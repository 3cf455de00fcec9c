"""Two models that share one vehicle."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cfx.models.base import DrivingModel, Leader
from cfx.models.composed import Combined, WithResidual, for_both
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Start
from tests.models.wrapped import CHECKS

DT = 0.1


@pytest.mark.parametrize("check", CHECKS, ids=[check.__name__ for check in CHECKS])
def test_the_contract_of_models_holds(check: Callable[[DrivingModel], None]) -> None:
    check(Combined(WithResidual(IDM()), Krauss()))


def speeds(model: DrivingModel, p: dict[str, Tensor]) -> Tensor:
    """Returns 100 speeds of a follower behind a leader that changes speed, `(100, 1)`."""
    time = DT * torch.arange(101, dtype=torch.float64)
    speed = 12.0 + 3.0 * torch.sin(0.4 * time)
    position = 30.0 + torch.cumsum(speed, 0) * DT
    leader = Leader(
        position[:100, None],
        speed[:100, None],
        torch.diff(speed)[:, None] / DT,
        torch.tensor(5.0).double(),
    )
    begin = Start(*(torch.tensor([value]).double() for value in (0.0, 11.0, 0.2)))
    stepper = MemoryStepper(model, DT)
    return stepper.advance(stepper.begin(begin), leader, p)[2]


def defaults(model: DrivingModel) -> dict[str, Tensor]:
    return model.space.unpack(model.space.defaults(dtype=torch.float64)[None])


def test_with_the_whole_weight_each_model_drives_as_alone() -> None:
    first, second = WithResidual(IDM()), W99()
    both = Combined(first, second)
    for weight, alone in ((1.0, first), (0.0, second)):
        p = for_both(defaults(first), defaults(second), torch.tensor([weight]).double())
        torch.testing.assert_close(speeds(both, p), speeds(alone, defaults(alone)))


def test_equal_models_share_a_vehicle_without_a_trace() -> None:
    model, p = IDM(), defaults(IDM())
    shared = for_both(p, p, torch.tensor([0.37]).double())
    torch.testing.assert_close(speeds(Combined(model, IDM()), shared), speeds(model, p))


def test_a_step_is_the_weighted_mean_of_both() -> None:
    first, second = IDM(), Krauss()
    weight = torch.tensor([0.3]).double()
    one, other = (speeds(model, defaults(model))[0] for model in (first, second))
    p = for_both(defaults(first), defaults(second), weight)
    mixed = speeds(Combined(first, second), p)[0]
    torch.testing.assert_close(mixed, 0.3 * one + 0.7 * other)
