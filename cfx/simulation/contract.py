"""The first statements of a simulator's contract. Shapes as in `cfx.simulation.base`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.contract import NotApplicable, expect_tensor, once
from cfx.errors import CfxError, ConfigError
from cfx.models.base import DrivingModel, Leader
from cfx.models.contract import DRIVES, DT, in_dtype, ordinary
from cfx.simulation.base import Simulator, Stepper
from cfx.simulation.trajectory import Start

STEPS = 5
_MODELS = ("krauss", "krauss_sumo", "idm_sumo", "w99", "w74")


def drivable(simulator: Simulator, model: DrivingModel | None = None) -> DrivingModel:
    """Returns the given model, or the first of those installed that the simulator can drive.

    Raises:
        NotApplicable: it drives none of them, or what it needs is not installed.
    """

    def first() -> DrivingModel | None:
        return _first_drivable(simulator)

    usual = once(simulator, "drivable", first)
    if model is None and usual is None:
        raise NotApplicable("the simulator drives none of the usual models; give it one of its own")
    return cast(DrivingModel, model or usual)


def _first_drivable(simulator: Simulator) -> DrivingModel | None:
    for name in _MODELS:
        if name not in registry.names("model"):
            continue
        candidate = cast(DrivingModel, registry.get("model", name)())
        try:
            simulator.require(candidate)
        except ConfigError:
            continue
        except CfxError as missing:
            raise NotApplicable(str(missing)) from missing
        return candidate
    return None


def stepper_of(simulator: Simulator, model: DrivingModel) -> Stepper:
    """Returns one stepper for all checks of a simulator: it may take seconds to start."""

    def made() -> Stepper:
        return simulator.stepper(model, DT)

    return once(simulator, model, made)


def makes_a_stepper_for_the_model(simulator: Simulator, model: DrivingModel | None = None) -> None:
    chosen = drivable(simulator, model)
    stepper = stepper_of(simulator, chosen)
    assert isinstance(stepper, Stepper), (
        f"stepper returns a {type(stepper).__name__} and no Stepper"
    )
    assert stepper.model is chosen, (
        "the stepper's `model` must be the model it was made for: calibration reads its parameters"
    )
    assert stepper.dt == DT, "the stepper's `dt` must be the time step it was made for"
    assert stepper.differentiable == simulator.differentiable, (
        "a simulator and its stepper must agree on `differentiable`: jobs ask the one, learners the"
        " other"
    )


def says_what_results_depend_on(simulator: Simulator, model: DrivingModel | None = None) -> None:
    chosen = drivable(simulator, model)
    identity = stepper_of(simulator, chosen).identity()
    assert isinstance(identity, str) and identity, (  # noqa: PT018 - one sentence
        "identity() must give a text that changes with whatever changes results: caches carry it"
    )
    assert simulator.stepper(chosen, DT).identity() == identity, (
        "two steppers of one simulator must have one `identity`, or no cached result is found again"
    )


def steps_in_this_process_keep_shape_and_dtype(
    simulator: Simulator, model: DrivingModel | None = None
) -> None:
    if not simulator.differentiable:
        raise NotApplicable("its steps may be another process's, which takes seconds to start")
    chosen = drivable(simulator, model)
    stepper, states = stepper_of(simulator, chosen), ordinary(chosen)
    for dtype in (torch.float64, torch.float32):
        follower, ahead, p = in_dtype(states, dtype)
        start = Start(follower.position, follower.speed, follower.acceleration)
        leader = Leader(
            ahead.position.expand(STEPS, DRIVES),
            ahead.speed.expand(STEPS, DRIVES),
            ahead.acceleration.expand(STEPS, DRIVES),
            ahead.length,
        )
        expect_steps(stepper, start, leader, p)


def expect_steps(stepper: Stepper, start: Start, leader: Leader, p: Mapping[str, Tensor]) -> None:
    """Asserts that steps are finite, and keep shape, dtype and device of what is given."""
    batch, dtype = start.speed.shape, start.speed.dtype
    end, position, speed = stepper.advance(stepper.begin(start), leader, p)
    expect_tensor(end.speed, "advance's follower", batch, dtype, "(*batch,)")
    steps = (len(leader.position), *batch)
    for name, value in (("positions", position), ("speeds", speed)):
        expect_tensor(value, f"advance's {name}", steps, dtype, "(K, *batch)")
        assert value.device == start.speed.device, f"{name} must stay on their device"
        assert bool(value.isfinite().all()), (
            f"advance gives {name} that are not finite in ordinary states"
        )


FIRST = (
    makes_a_stepper_for_the_model,
    says_what_results_depend_on,
    steps_in_this_process_keep_shape_and_dtype,
)
