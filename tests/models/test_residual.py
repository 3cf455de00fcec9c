"""The residual acceleration beside a driving model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import pytest
import torch
from torch import Tensor

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.composed import RESIDUAL, WithResidual
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.kernel.run import model_key
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Start
from tests.models.wrapped import CHECKS
from tests.without_equations import WithoutEquations

DT = 0.1


class Steady(DrivingModel):
    """Wants one acceleration whatever happens, so that all else is the residual's."""

    parameters = ParameterSpace.of(Parameter("a", "m/s2", -2.0, 2.0, 0.0, "acceleration"))

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        return (follower.speed + p["a"] * dt).clamp(min=0.0)


def far_leader(steps: int, *batch: int) -> Leader:
    position = (1000.0 + 1.5 * torch.arange(steps).double())[:, None].expand(steps, *batch)
    speed = torch.full((steps, *batch), 15.0).double()
    return Leader(position, speed, torch.zeros_like(speed), torch.tensor(5.0).double())


def speeds(model: DrivingModel, start: Start, leader: Leader, *parameters: float) -> Tensor:
    """Returns the speeds of one follower at all steps, `(T,)`."""
    wrapped = WithResidual(model)
    p = wrapped.space.unpack(torch.tensor([parameters]).double())
    stepper = MemoryStepper(wrapped, DT)
    return stepper.advance(stepper.begin(start), leader, p)[2][:, 0]


def start(speed: float, acceleration: float) -> Start:
    values = (0.0, speed, acceleration)
    return Start(*(torch.tensor([value], dtype=torch.float64) for value in values))


@pytest.mark.parametrize("check", CHECKS, ids=[check.__name__ for check in CHECKS])
def test_the_contract_of_models_holds(check: Callable[[DrivingModel], None]) -> None:
    check(WithResidual(Krauss()))


def test_it_starts_with_the_measured_acceleration_and_hands_over_to_the_model() -> None:
    """Against the closed form, for many values at once: the speed is a sum of accelerations."""
    draw = torch.rand((6, 200), generator=torch.Generator().manual_seed(0)).double()
    alone, measured, target = 4.0 * draw[0] - 2.0, 4.0 * draw[1] - 2.0, 2.0 * draw[2] - 1.0
    tau, jerk, forget = 0.3 + 10.0 * draw[3], 2.0 * draw[4] - 1.0, 0.37
    handover = 0.3 + 5.0 * draw[5]
    model = WithResidual(Steady(limits=None))
    begin = Start(torch.zeros_like(alone), torch.full_like(alone, 50.0), measured)
    p = {"a": alone, "residual_time": tau, "residual_target": target}
    p |= {"residual_jerk": jerk, "residual_jerk_time": torch.full_like(jerk, forget)}
    p |= {"residual_handover": handover}
    stepper = MemoryStepper(model, DT)
    _, _, speed = stepper.advance(stepper.begin(begin), far_leader(60, 1), p)
    kept, steps = torch.exp(-DT / tau), torch.arange(60).double()[:, None]
    lost = math.exp(-DT / forget)
    held = measured + jerk * DT * lost * (1.0 - lost**steps) / (1.0 - lost)
    residual = target * (1.0 - kept**steps)
    share = 1.0 - torch.exp(-((DT * steps / handover) ** 2))
    acceleration = (1.0 - share) * held + share * alone + share.sqrt() * residual
    torch.testing.assert_close(speed, 50.0 + DT * acceleration.cumsum(0), rtol=0, atol=1e-9)
    torch.testing.assert_close((speed[0] - 50.0) / DT, measured, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", [Krauss(), IDM(), W99()], ids=["krauss", "idm", "w99"])
def test_the_acceleration_hardly_changes_from_step_to_step(model: DrivingModel) -> None:
    """Also of a model that takes the speed that it wants at once, and wants quite another."""
    leader = far_leader(20, 1)
    leader = leader._replace(position=leader.position - 985.0)
    parameters = (*model.space.defaults().tolist(), *(each.default for each in RESIDUAL))
    speed = speeds(model, start(14.0, -0.4), leader, *parameters)
    stepper, p = MemoryStepper(model, DT), model.space.unpack(model.space.defaults())
    alone = stepper.advance(stepper.begin(start(14.0, -0.4)), leader, p)[2][:, 0]
    wanted = abs(float(alone[0] - 14.0) / DT + 0.4)
    assert wanted > 0.3, "the model wants another acceleration"
    acceleration = torch.cat([torch.tensor([14.0]).double(), speed]).diff() / DT
    assert float(acceleration[0]) == pytest.approx(-0.4, abs=1e-9)
    assert float(acceleration[:4].diff().abs().max()) < 0.1 * wanted


@pytest.mark.parametrize("model", [Krauss(), IDM(), W99()], ids=["krauss", "idm", "w99"])
def test_the_first_step_is_the_drivers_and_the_rest_becomes_the_models(
    model: DrivingModel,
) -> None:
    """With a short time constant it is soon where the model alone is."""
    leader = far_leader(600, 1)
    leader = leader._replace(position=leader.position - 970.0)
    first = start(14.0, -0.4)
    parameters = model.space.defaults().tolist()
    with_residual = speeds(model, first, leader, *parameters, 0.2, 0.0, 0.0, 0.5, 0.2)
    assert (float(with_residual[0]) - 14.0) / DT == pytest.approx(-0.4, abs=1e-9)
    if not isinstance(model, W99):  # who never stops oscillating
        stepper, p = MemoryStepper(model, DT), model.space.unpack(model.space.defaults())
        alone = stepper.advance(stepper.begin(first), leader, p)[2][:, 0]
        assert float(with_residual[-1]) == pytest.approx(float(alone[-1]), abs=0.02)


def test_no_residual_keeps_a_vehicle_from_braking_for_its_leader() -> None:
    """The leader stands; the residual alone would let the follower run into it."""
    steps = 200
    still = torch.zeros((steps, 1)).double()
    leader = Leader(still + 65.0, still, still, torch.tensor(5.0).double())
    model = IDM()
    parameters = (*model.space.defaults().tolist(), 20.0, 3.0, 0.0, 0.5, 20.0)
    wrapped = WithResidual(model)
    p = wrapped.space.unpack(torch.tensor([parameters]).double())
    stepper = MemoryStepper(wrapped, DT)
    _, position, speed = stepper.advance(stepper.begin(start(12.0, 1.5)), leader, p)
    assert float((speed[:1] - 12.0) / DT) == pytest.approx(1.5, abs=1e-6), "not needed yet"
    assert float(position.max()) < 60.0
    assert float(speed[100:].max()) < 1.0


def test_no_residual_closes_the_last_metre_behind_a_leader_who_only_seems_to_move() -> None:
    """A standing leader whose measured speed is noise: the vehicle stays where the model stands."""
    steps = 600
    still = torch.zeros((steps, 1)).double()
    noise = 0.01 + 0.01 * torch.rand((steps, 1), generator=torch.Generator().manual_seed(0))
    leader = Leader(still + 5.15, noise.double(), still, torch.tensor(5.0).double())
    wrapped = WithResidual(IDM())
    p = wrapped.space.unpack(wrapped.space.defaults()) | {"s0": torch.tensor(0.2).double()}
    p["residual_target"] = torch.tensor(0.5).double()
    stepper = MemoryStepper(wrapped, DT)
    _, position, _ = stepper.advance(stepper.begin(start(0.0, 0.0)), leader, p)
    assert float(position.max()) == 0.0, "at 0.15 m, within s0, IDM alone stands"


@pytest.mark.parametrize("model", [Krauss(), IDM(), W99()], ids=["krauss", "idm", "w99"])
def test_no_residual_holds_a_queue_that_the_model_lets_move(model: DrivingModel) -> None:
    """At rest, 12 m behind a leader who crawls: a queue moves on as it does without a residual."""
    steps = 600
    crawl = torch.full((steps, 1), 1.5).double()
    position = 17.0 + 0.15 * torch.arange(steps).double()[:, None]
    leader = Leader(position, crawl, crawl - crawl, torch.tensor(5.0).double())
    parameters = model.space.defaults().tolist()
    first = start(0.0, 0.0)
    free = speeds(model, first, leader, *parameters, 1.0, 0.0, 0.0, 0.5, 2.0)
    slowed = speeds(model, first, leader, *parameters, 1.0, -3.0, 0.0, 0.5, 2.0)
    assert float(slowed[300:].mean()) == pytest.approx(1.5, abs=0.1)
    assert float(free[300:].mean()) == pytest.approx(1.5, abs=0.1)
    first_moves = [int((speed > 0.1).int().argmax()) for speed in (free, slowed)]
    assert first_moves[1] <= first_moves[0] + 3


def test_a_residual_brakes_in_full_at_speed_and_not_at_rest() -> None:
    """Against the formula; the gradient with respect to the target is that of the weight."""
    model = WithResidual(Steady(limits=None))
    speed = torch.tensor([0.0, 1.0, 2.5, 5.0, 20.0], dtype=torch.float64)
    for residual in (-0.8, 0.6):
        memory = torch.tensor([0.0, 0.0, residual, 1e3]).double().expand(5, -1).clone()
        memory.requires_grad_()
        follower = Follower(torch.zeros(5).double(), speed, torch.zeros(5).double(), memory)
        leader = Leader(*(torch.tensor(value).double() for value in (500.0, 20.0, 0.0, 5.0)))
        p = model.space.unpack(model.space.defaults()) | {"a": torch.tensor(1.0).double()}
        after = model.next_speed(follower, leader, p, DT)
        weight = (speed / 5.0).clamp(max=1.0).square() if residual < 0 else torch.ones(5).double()
        torch.testing.assert_close((after - speed) / DT, 1.0 + weight * residual)
        (gradient,) = torch.autograd.grad(after.sum(), memory)
        torch.testing.assert_close(gradient[:, 2], DT * weight)


def test_each_vehicle_has_its_own_residual_and_candidates_broadcast() -> None:
    model = WithResidual(IDM())
    leader = far_leader(30, 1)
    many = torch.tensor([-1.0, 0.0, 0.7]).double()
    together = simulate_starts(model, many, leader)
    for number, acceleration in enumerate(many.tolist()):
        alone = simulate_starts(model, torch.tensor([acceleration]).double(), leader)
        torch.testing.assert_close(together[:, number], alone[:, 0], rtol=0, atol=1e-12)


def simulate_starts(model: WithResidual, acceleration: Tensor, leader: Leader) -> Tensor:
    begin = Start(torch.zeros_like(acceleration), 10.0 + 0 * acceleration, acceleration)
    stepper = MemoryStepper(model, DT)
    p = model.space.unpack(model.space.defaults())
    return stepper.advance(stepper.begin(begin), leader, p)[2]


def test_compiled_code_is_that_of_the_inner_model() -> None:
    """Two inner models with equal settings are told apart."""
    assert Krauss().settings.model_dump_json() != ""
    keys = {model_key(WithResidual(model)) for model in (Steady(), IDM(), Krauss())}
    assert len(keys) == 3
    assert model_key(WithResidual(IDM())) == model_key(WithResidual(IDM()))


def test_a_model_without_equations_is_refused() -> None:
    with pytest.raises(ConfigError, match="has equations in sumo only"):
        WithResidual(WithoutEquations())
