"""The contract of a simulator, statement by statement. Shapes as in `cfx.simulation.base`.

The scene: nine followers behind leaders that speed up and slow down, with parameters all over their
bounds. The driving model is the first of a few of cfx's own that the simulator can drive.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.core.contract import expect_close
from cfx.errors import CfxError, ConfigError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.krauss import Krauss
from cfx.simulation.base import Simulator, Stepper
from cfx.simulation.contract import FIRST, drivable, expect_steps, stepper_of
from cfx.simulation.trajectory import Start
from cfx_contracts import contract_of

DT = 0.1
FOLLOWERS, STEPS = 9, 20
TOLERANCE = 1e-6
"""How far, in m and m/s, simulations of the same thing in double precision may differ."""


Model = DrivingModel | None

_Parameters = dict[str, Tensor]


class _Scene(NamedTuple):
    """Everything that one call of `advance` is given."""

    start: Start
    leader: Leader
    p: _Parameters


class _Elsewhere(Krauss):
    """A model that another simulator alone can drive."""

    needs_simulator = "a_simulator_that_nobody_has"


def refuses_what_it_cannot_drive(simulator: Simulator) -> None:
    drivable(simulator)
    try:
        simulator.require(_Elsewhere())
    except ConfigError:
        return
    raise AssertionError(
        "`require` must raise a ConfigError for a model without equations that names another"
        " simulator (`needs_simulator`): a job would find out only after its data are read"
    )


def keeps_shape_dtype_and_device(simulator: Simulator, model: Model = None) -> None:
    stepper, wide = _ready(simulator, model)
    for dtype in (torch.float64, torch.float32):
        scene = _to(wide, dtype)
        expect_steps(stepper, scene.start, scene.leader, scene.p)


def ends_where_the_last_step_led(simulator: Simulator, model: Model = None) -> None:
    stepper = stepper_of(simulator, drivable(simulator, model))
    end, position, speed = _advance(stepper, _scene(stepper.model))
    realised = (speed[-1] - speed[-2]) / stepper.dt
    for name, value, expected in (
        ("position", end.position, position[-1]),
        ("speed", end.speed, speed[-1]),
        ("acceleration", end.acceleration, realised),
    ):
        _close(
            value,
            expected,
            f"the {name} of the follower at the end must be that of the last step, realised and not"
            " wished for: the next call goes on from there",
        )


def no_steps_change_nothing(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    end, position, speed = _advance(stepper, scene._replace(leader=_frames(scene.leader, 0, 0)))
    assert position.shape == speed.shape == (0, FOLLOWERS), (
        "a leader without frames must give no positions and no speeds, (0, *batch)"
    )
    assert torch.equal(end.speed, scene.start.speed), "without a step the follower stays as it is"


def positions_and_speeds_belong_together(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, position, speed = _advance(stepper, scene)
    assert bool(speed.isfinite().all()), "speeds must be finite"
    assert bool((speed >= 0).all()), "speeds must not be negative"
    before = torch.cat([scene.start.position[None], position[:-1]])
    from_speed = torch.cat([scene.start.speed[None], speed[:-1]])
    driven = (position - before) / stepper.dt
    slowest, fastest = torch.minimum(from_speed, speed), torch.maximum(from_speed, speed)
    inside = (driven >= slowest - TOLERANCE) & (driven <= fastest + TOLERANCE)
    assert bool(inside.all()), (
        "within a step a follower must drive between its speed before and its speed after, or gaps"
        " and speeds tell two stories"
    )


def followers_are_independent(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, _, together = _advance(stepper, scene)
    for first, last in ((0, 1), (4, FOLLOWERS)):
        _, _, alone = _advance(stepper, _some(scene, first, last))
        _close(
            alone,
            together[:, first:last],
            "a follower must drive the same alone as beside others: a batch is no traffic, and"
            " results would depend on shards",
        )


def leaders_and_parameters_broadcast(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, _, expected = _advance(stepper, scene)
    shape = (FOLLOWERS, 2)
    wide = Start(*(state[:, None].expand(shape) for state in scene.start))
    leader = Leader(
        scene.leader.position[..., None],
        scene.leader.speed[..., None],
        scene.leader.acceleration[..., None],
        scene.leader.length[:, None],
    )
    columns = {}
    for name, value in scene.p.items():
        columns[name] = value[:, None] if value.dim() else value
    _, _, speed = _advance(stepper, _Scene(wide, leader, columns))
    assert speed.shape == (STEPS, *shape), (
        "a leader (K, P, 1) and parameters (P, 1) must broadcast over followers (P, q): q"
        " candidates behind one leader"
    )
    _close(
        speed,
        expected[..., None].expand(STEPS, *shape),
        "broadcasting must not change the numbers",
    )


def sees_no_later_frame_of_the_leader(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, _, expected = _advance(stepper, scene)
    change = STEPS // 2
    later = torch.arange(STEPS)[:, None] >= change
    leader = scene.leader._replace(
        speed=torch.where(later, 0.5 * scene.leader.speed, scene.leader.speed),
        acceleration=torch.where(later, -1.0, scene.leader.acceleration),
    )
    _, _, speed = _advance(stepper, scene._replace(leader=leader))
    _close(
        speed[:change],
        expected[:change],
        f"what the leader does from frame {change} on must not change the speeds up to there: a"
        " driver sees no future",
    )


def parts_give_the_whole(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, position, speed = _advance(stepper, scene)
    half = STEPS // 2
    follower = stepper.begin(scene.start)
    follower, _, _ = stepper.advance(follower, _frames(scene.leader, 0, half), scene.p)
    _, second_position, second_speed = stepper.advance(
        follower, _frames(scene.leader, half, STEPS), scene.p
    )
    sentence = (
        "two calls with the same parameters must give what one call gives: a policy chooses anew"
        " every few steps, and must not pay for it"
    )
    _close(second_position, position[half:], sentence)
    _close(second_speed, speed[half:], sentence)


def the_same_again_gives_the_same(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, _, first = _advance(stepper, scene)
    _, _, second = _advance(stepper, scene)
    assert torch.equal(first, second), (
        "the same call must give the same speeds to the last bit: caches rely on it"
    )


def the_inputs_stay_as_they_are(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    inputs = (*scene.start, *scene.leader, *scene.p.values())
    before = [tensor.clone() for tensor in inputs]
    _advance(stepper, scene)
    for tensor, copy in zip(inputs, before, strict=True):
        assert torch.equal(tensor, copy), (
            "`advance` must not change its inputs in place: they are the recorded trajectories"
        )


def goes_on_after_it_was_closed(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    _, _, expected = _advance(stepper, scene)
    stepper.close()
    _, _, again = _advance(stepper.for_work(STEPS * FOLLOWERS), scene)
    _close(
        again,
        expected,
        "`close` lets go of processes and the like, and the next `advance` must start them again;"
        " `for_work` must not change the numbers",
    )


def gradients_are_as_claimed(simulator: Simulator, model: Model = None) -> None:
    stepper, scene = _ready(simulator, model)
    names = stepper.model.space.names
    wanting = dict(scene.p)
    for name in names:
        wanting[name] = scene.p[name].clone().requires_grad_()
    if not simulator.differentiable:
        try:
            _advance(stepper, scene._replace(p=wanting))
        except CfxError:
            return
        raise AssertionError(
            "a simulator without gradients must raise a CfxError where an input wants them, or a"
            " learner trains on nothing"
        )
    _, _, speed = _advance(stepper, scene._replace(p=wanting))
    inputs = [wanting[name] for name in names]
    gradients = torch.autograd.grad(speed.sum(), inputs, materialize_grads=True)
    for name, gradient in zip(names, gradients, strict=True):
        assert bool(gradient.isfinite().all()), (
            f"the gradient with respect to {name} is not finite, and the simulator claims"
            " `differentiable`"
        )
    assert any(bool(gradient.any()) for gradient in gradients), (
        "all gradients are 0, and the simulator claims `differentiable`: parameters must reach the"
        " speeds"
    )


def _ready(simulator: Simulator, model: Model) -> tuple[Stepper, _Scene]:
    stepper = stepper_of(simulator, drivable(simulator, model))
    return stepper, _scene(stepper.model)


def _scene(model: DrivingModel) -> _Scene:
    """Returns followers behind wavy leaders, float64."""
    draw = torch.Generator().manual_seed(5)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=draw, dtype=torch.float64)

    first = uniform(3.0, 20.0, FOLLOWERS)
    acceleration = (0.2 * uniform(-1.0, 1.0, STEPS, FOLLOWERS).cumsum(0)).clamp(-2.0, 0.9)
    speed = (first + acceleration.cumsum(0) * DT).clamp(min=0.0)
    position = 100.0 + (speed * DT).cumsum(0)
    length = uniform(4.0, 9.0, FOLLOWERS)
    begin = (first + uniform(-2.0, 2.0, FOLLOWERS)).clamp(min=0.0)
    behind = position[0] - length - 5.0 - 1.5 * begin
    start = Start(behind, begin, uniform(-1.0, 1.0, FOLLOWERS))
    unit = uniform(0.0, 1.0, FOLLOWERS, len(model.space))
    p = model.space.unpack(model.space.from_unit(unit))
    return _Scene(start, Leader(position, speed, acceleration, length), p)


def _advance(stepper: Stepper, scene: _Scene) -> tuple[Follower, Tensor, Tensor]:
    return stepper.advance(stepper.begin(scene.start), scene.leader, scene.p)


def _frames(leader: Leader, first: int, last: int) -> Leader:
    return _on_signals(leader, lambda signal: signal[first:last])


def _some(scene: _Scene, first: int, last: int) -> _Scene:
    start = Start(*(state[first:last] for state in scene.start))
    leader = _on_signals(scene.leader, lambda signal: signal[:, first:last])
    p = {}
    for name, value in scene.p.items():
        p[name] = value[first:last] if value.dim() else value
    return _Scene(start, leader._replace(length=scene.leader.length[first:last]), p)


def _to(scene: _Scene, dtype: torch.dtype) -> _Scene:
    start = Start(*(state.to(dtype) for state in scene.start))
    leader = _on_signals(scene.leader, lambda signal: signal.to(dtype))
    p = {name: value.to(dtype) for name, value in scene.p.items()}
    return _Scene(start, leader._replace(length=scene.leader.length.to(dtype)), p)


def _on_signals(leader: Leader, change: Callable[[Tensor], Tensor]) -> Leader:
    return Leader(
        change(leader.position), change(leader.speed), change(leader.acceleration), leader.length
    )


def _close(value: Tensor, expected: Tensor, sentence: str) -> None:
    expect_close(value, expected, rtol=0.0, atol=TOLERANCE, msg=sentence)


CONTRACT = contract_of(__name__, "simulator", first=FIRST)
