"""The contract of a driving model, statement by statement. Letters as in `cfx.models.base`."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Literal, get_args, get_origin

import torch
from torch import Tensor

from cfx.core.contract import NotApplicable, expect_close
from cfx.errors import CfxError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.contract import (
    DRIVES,
    DT,
    FIRST,
    LENGTH,
    Step,
    in_dtype,
    on_all,
    ordinary,
    require_equations,
)
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.trajectory import Start
from cfx_contracts import contract_of

Equilibrium = Callable[[Tensor, Mapping[str, Tensor]], Tensor]
"""Gap at which nothing changes, m, of the common speed, m/s, and the parameters."""

_BEHIND = 32  # leaders of its kinds behind which parameters are moved
_PERIOD = 450  # frames in which a leader of `_stop_and_go` stops and starts again
_FELT = 1e-3  # m/s: a parameter that changes no speed by this much changes none


_EXTREMES = (
    (-20, -0.1, 0, 0.01, 1, 30, 1e3),  # gap, m
    (0, 1e-3, 5, 60),  # speed, m/s
    (0, 1e-3, 15, 60),  # the leader's
    (-9, 0, 5),  # the leader's acceleration, m/s2
    (-9, 0, 3),  # acceleration, m/s2
)


def _extreme(model: DrivingModel) -> Step:
    """Returns all combinations of extreme states at 200 corners of the bounds, float64."""
    require_equations(model)
    states = torch.tensor(list(itertools.product(*_EXTREMES)), dtype=torch.float64)
    gap, v, v_l, a_l, a = states.unbind(dim=1)
    corner = torch.randint(
        0, 2, (200, 1, len(model.space.parameters)), generator=torch.Generator().manual_seed(1)
    ).bool()
    p = {}
    for i, parameter in enumerate(model.space):
        p[parameter.name] = torch.where(corner[..., i], parameter.high, parameter.low).double()
    shape = (200, len(gap))
    position = (-gap - LENGTH).expand(shape)
    speed = v.expand(shape)
    follower = Follower(position, speed, a.expand(shape), model.initial_memory(speed))
    return follower, Leader(torch.zeros_like(gap), v_l, a_l, torch.full_like(gap, LENGTH)), p


def every_parameter_says_what_it_is(model: DrivingModel) -> None:
    for parameter in model.space:
        for field in ("unit", "meaning", "source"):
            assert getattr(parameter, field), (
                f"parameter {parameter.name} has no {field}: the documentation, the config's"
                " comments and the figures show it"
            )
    assert model.reference, (
        "a model says where its equations come from (set `reference`): who reads a result must"
        " find them"
    )


def constants_can_be_tuned_and_tuned_parameters_fixed(model: DrivingModel) -> None:
    constants = [parameter.name for parameter in model.space if not parameter.tuned]
    everything = _with_tuned(model, dict.fromkeys(constants, True))
    assert set(everything.space.names) == {parameter.name for parameter in model.space}, (
        "`model.parameters.NAME.tuned=true` must turn a constant into a tuned parameter; build"
        " `space` in the base class"
    )
    for name in constants:
        value = model.space.unpack(model.space.defaults()[None])[name]
        assert value.dim() == 0, (
            f"constant {name} must reach the step as one number for all followers, for it costs"
            " no memory so"
        )


def every_tuned_parameter_changes_a_trajectory(model: DrivingModel) -> None:
    require_equations(model)
    for variant, said in _variants(model):
        moved = _largest_changes(variant)
        dead = [name for name, change in moved.items() if change < _FELT]
        assert not dead, (
            f"{', '.join(dead)} changes no trajectory{said}, from bound to bound behind leaders in"
            " stop-and-go and on a free road: whatever calibration finds for it is arbitrary"
            " (say with which setting the model uses it, `Parameter(..., used_with=(SETTING,"
            " VALUE))`, or `tuned=False`)"
        )


def a_batch_equals_the_loop_over_it(model: DrivingModel) -> None:
    states = ordinary(model)
    follower, leader, p = states
    together = model.next_speed(follower, leader, p, DT)
    for k in range(DRIVES):
        alone = model.next_speed(*on_all(states, partial(_of_one, k)), DT)
        expect_close(
            alone,
            together[k],
            msg=f"follower {k} moves differently alone than in a batch: results would depend on"
            " shards",
        )


def leaders_and_parameters_broadcast(model: DrivingModel) -> None:
    follower, leader, p = ordinary(model)
    wide = Follower(*(x[:, None].expand(DRIVES, 3, *x.shape[1:]) for x in follower))
    narrow = Leader(*(x[:, None] for x in leader))
    columns = {name: value[:, None] if value.dim() else value for name, value in p.items()}
    speed = model.next_speed(wide, narrow, columns, DT)
    assert speed.shape == (DRIVES, 3), (
        "leaders (P, 1) and parameters (P, 1) must broadcast over followers (P, q): q candidates"
        " behind one leader"
    )
    single = model.next_speed(follower, leader, p, DT)
    expect_close(
        speed,
        single[:, None].expand(DRIVES, 3),
        msg="broadcasting changes the numbers: a candidate must move the same beside others as"
        " alone",
    )


def single_precision_agrees_with_double(model: DrivingModel) -> None:
    states = ordinary(model)
    double = model.next_speed(*states, DT)
    single = model.next_speed(*in_dtype(states, torch.float32), DT).double()
    # A state may lie on a threshold, where the last bit decides.
    share = (double - single).abs().lt(1e-3).double().mean().item()
    assert share >= 0.95, (
        f"float32 agrees with float64 to 1 mm/s in {share:.0%} of ordinary states only: something"
        " cancels, and jobs with dtype=float32 would calibrate noise"
    )


def speeds_are_finite_and_not_negative_at_every_extreme(model: DrivingModel) -> None:
    extreme = _extreme(model)
    for dtype in (torch.float64, torch.float32):
        speed = model.next_speed(*in_dtype(extreme, dtype), DT)
        wrong = ~(speed.isfinite() & (speed >= 0))
        assert not bool(wrong.any()), (
            f"{int(wrong.sum())} of {wrong.numel()} extreme states give a negative or infinite"
            f" speed in {dtype}, such as "
            f"{_describe(extreme, wrong)}: optimizers visit every corner of the bounds, and"
            " rollouts go on after collisions"
        )


def a_bad_neighbour_does_no_harm(model: DrivingModel) -> None:
    follower, leader, p = ordinary(model)
    clean = model.next_speed(follower, leader, p, DT)
    broken = {
        name: value.index_fill(0, torch.tensor([0]), torch.nan) if value.dim() else value
        for name, value in p.items()
    }
    speed = model.next_speed(follower, leader, broken, DT)
    assert torch.equal(speed[1:], clean[1:]), (
        "NaN parameters of one follower must not reach the others: one diverged candidate would"
        " spoil all"
    )


def gradients_are_right(model: DrivingModel) -> None:
    if not model.differentiable:
        raise NotApplicable("the model does not claim to be differentiable")
    states = ordinary(model)
    follower, leader, p = states
    names = [name for name, value in p.items() if value.dim()]

    def step(*inputs: Tensor) -> Tensor:
        states, values = inputs[:5], inputs[5:]
        moved = Follower(states[0], states[1], states[2], follower.memory)
        ahead = leader._replace(speed=states[3], acceleration=states[4])
        return model.next_speed(moved, ahead, p | dict(zip(names, values, strict=True)), DT)

    inputs = (
        follower.position,
        follower.speed,
        follower.acceleration,
        leader.speed,
        leader.acceleration,
        *(p[n] for n in names),
    )
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    slopes = torch.autograd.grad(step(*inputs).sum(), inputs, materialize_grads=True)
    for k, slope in enumerate(slopes):
        # Followers do not depend on one another, so that one difference serves all of them.
        up, down = (step(*inputs[:k], inputs[k] + e, *inputs[k + 1 :]) for e in (1e-7, -1e-7))
        assert torch.allclose(slope, (up - down).detach() / 2e-7, rtol=1e-3, atol=1e-4), (
            "analytic and numeric gradients differ: the model claims `differentiable`, and learning"
            " relies on it"
        )


def gradients_are_finite_at_every_extreme(model: DrivingModel) -> None:
    if not model.differentiable:
        raise NotApplicable("the model does not claim to be differentiable")
    extreme = _extreme(model)
    follower, leader, p = extreme
    position, speed, acceleration = (x.clone().requires_grad_() for x in follower[:3])
    values = {
        name: value.expand(follower.speed.shape).clone().requires_grad_()
        for name, value in p.items()
    }
    inputs = {"position": position, "speed": speed, "acceleration": acceleration, **values}
    out = model.next_speed(
        Follower(position, speed, acceleration, follower.memory), leader, values, DT
    )
    gradients = torch.autograd.grad(out.sum(), list(inputs.values()), materialize_grads=True)
    for name, gradient in zip(inputs, gradients, strict=True):
        wrong = ~gradient.isfinite()
        assert not bool(wrong.any()), (
            f"the gradient with respect to {name} is not finite, for instance at"
            f" {_describe(extreme, wrong)}: replace the "
            "argument of a root or a division in the branch that is not taken (see"
            " cfx.models.regimes)"
        )


def has_a_constant_baseline_as_claimed(model: DrivingModel) -> None:
    if not model.has_constant_baseline:
        raise NotApplicable("the model does not claim to follow with constant parameters")
    follower, leader, p = ordinary(model)
    near = model.next_speed(follower, leader, p, DT)
    far = model.next_speed(
        follower, leader._replace(position=leader.position + 1e3, speed=leader.speed + 20.0), p, DT
    )
    reacts = (near - far).abs().gt(1e-6).double().mean().item()
    assert reacts >= 0.1, (
        "the model claims `has_constant_baseline`, but takes notice of its leader in"
        f" {reacts:.0%} of ordinary states: constant parameters would"
        " be no baseline (set `has_constant_baseline = False` for a model whose parameters are"
        " the control itself)"
    )


def no_rollout_leaves_what_is_finite(model: DrivingModel) -> None:
    require_equations(model)
    draw = torch.Generator().manual_seed(3)
    corner = torch.randint(0, 2, (256, len(model.space)), generator=draw).double()
    leader = _stop_and_go(torch.tensor(25.0, dtype=torch.float64), 6.0)
    zero = torch.zeros(256, dtype=torch.float64)
    start = Start(zero - LENGTH - 60 * torch.rand(256, generator=draw).double(), zero + 25.0, zero)
    out = simulate_follower(model, model.space.from_unit(corner), leader, start, DT)
    assert bool(out.speed.isfinite().all()), (
        "a rollout at a corner of the bounds ends in infinity or NaN, and optimizers visit every"
        " corner"
    )
    assert out.speed.max() <= 200.0, (
        "a rollout at a corner of the bounds reaches absurd speeds: bound the acceleration or the"
        " speed"
    )


def keeps_its_equilibrium(model: DrivingModel, equilibrium: Equilibrium | None = None) -> None:
    states = ordinary(model)
    if equilibrium is None:
        raise NotApplicable("the model gives no closed form of its equilibrium gap")
    follower, leader, p = states
    gap = equilibrium(leader.speed, p)
    calm = follower._replace(
        position=leader.position - leader.length - gap, speed=leader.speed.clone()
    )
    calm = calm._replace(acceleration=torch.zeros_like(gap))
    ahead = leader._replace(acceleration=torch.zeros_like(gap))
    expect_close(
        model.next_speed(calm, ahead, p, DT),
        leader.speed,
        msg="at the equilibrium gap and equal speeds the speed must stay",
    )


def collision_free_as_claimed(model: DrivingModel, leader_deceleration: float = 4.5) -> None:
    if not model.collision_free:
        raise NotApplicable("the model does not claim to be free of collisions")
    speed = torch.linspace(1, 33, 33, dtype=torch.float64)
    leader = _stop_and_go(speed, leader_deceleration)
    headway = torch.tensor([1.8, 3.0, 6.0], dtype=torch.float64)[:, None]
    start = Start(-LENGTH - 3.0 - headway * speed, speed, torch.zeros_like(speed))
    hit = simulate_follower(model, None, leader, start, DT).collided.any(dim=-1)
    assert not bool(hit.any()), (
        "the model claims `collision_free`, but with default parameters it hits a leader"
        " that brakes at "
        f"{leader_deceleration} m/s2 from {speed.expand_as(hit)[hit][0].item():g} m/s, starting"
        f" {headway.expand_as(hit)[hit][0].item():g} s and 3 m behind"
    )


def can_be_compiled_as_one_graph(model: DrivingModel) -> None:
    follower, leader, p = ordinary(model)

    def step(follower: Follower, leader: Leader, p: dict[str, Tensor]) -> Tensor:
        return model.next_speed(follower, leader, p, DT)

    # torch gives up after eight recompilations of a function, and to it all these are one.
    whole = torch.compile(  # type: ignore[call-overload]  # torch's overloads leave isolate_recompiles out
        step, fullgraph=True, backend="eager", isolate_recompiles=True
    )
    with torch.no_grad(), warnings.catch_warnings():
        # PyTorch's advice to take a newer Python than 3.13.0; it says nothing about the model.
        warnings.filterwarnings("ignore", "Guards may run slower", RuntimeWarning)
        try:
            compiled = whole(follower, leader, p)
        except Exception as error:  # the compiler's errors have no common base
            raise AssertionError(
                "long calibrations run the step compiled as one graph, so Python must not look at"
                " the values of tensors (write"
                " torch.where instead of if); the compiler says:"
                f" {str(error).strip().partition(chr(10))[0]}"
            ) from error
        eager = model.next_speed(follower, leader, p, DT)
    expect_close(
        compiled,
        eager,
        msg="compiling the step changes its numbers: calibrations would find others",
    )


def _variants(model: DrivingModel) -> Iterator[tuple[DrivingModel, str]]:
    """Yields the model, and with each choice of its settings that it does not have; says which."""
    yield model, ""
    for name, field in model.schema.model_fields.items():
        if get_origin(field.annotation) is not Literal:
            continue
        for choice in get_args(field.annotation):
            if choice == getattr(model.settings, name):
                continue
            # What the first one tunes explicitly, the others may not use.
            given = {**dict(model.settings), name: choice, "parameters": {}}
            with suppress(CfxError):  # it does not go with the other settings
                yield type(model)(**given), f" with {name}={choice}"


def _largest_changes(model: DrivingModel) -> dict[str, float]:
    """Returns by how much each tuned parameter changes a speed at most, m/s.

    Each is moved from bound to bound, the others are drawn within the bounds, or at their defaults.
    """
    draw = torch.Generator().manual_seed(4)
    places, count = 3, len(model.space)
    unit = torch.rand((_BEHIND, count), generator=draw, dtype=torch.float64)
    unit[::2] = model.space.to_unit(model.space.defaults())
    moved = unit.repeat(count, places, 1, 1)  # (n, places, drives, n)
    for column in range(count):
        moved[column, ..., column] = torch.linspace(0, 1, places, dtype=torch.float64)[:, None]
    top = torch.linspace(3, 33, _BEHIND, dtype=torch.float64)
    ahead = _stop_and_go(top, 3.0)
    leader = ahead._replace(
        position=ahead.position[..., :_PERIOD],
        speed=ahead.speed[..., :_PERIOD],
        acceleration=ahead.acceleration[..., :_PERIOD],
    )
    far = torch.arange(_BEHIND) % 4 == 3
    gap = torch.where(far, 400.0, 3.0 + 3.0 * top * torch.rand(_BEHIND, generator=draw).double())
    speed = top * (0.5 + 0.7 * torch.rand(_BEHIND, generator=draw).double())
    start = Start(-LENGTH - gap, speed, torch.zeros_like(speed))
    with torch.no_grad():
        out = simulate_follower(model, model.space.from_unit(moved), leader, start, DT).speed
    change = (out - out[:, :1]).abs().flatten(1).amax(1)
    return dict(zip(model.space.names, change.tolist(), strict=True))


def _with_tuned(model: DrivingModel, tuned: Mapping[str, bool]) -> DrivingModel:
    options = model.settings.model_dump()
    for name, value in tuned.items():
        options["parameters"].setdefault(name, {})["tuned"] = value
    return type(model)(**options)


def _stop_and_go(speed: Tensor, deceleration: float) -> Leader:
    """Returns a leader that cruises for 3 s, brakes to a standstill, waits 5 s, and starts again.

    Shapes: `speed` `(*batch,)`, the leader's signals `(*batch, time)`.
    """
    time = torch.arange(900, dtype=torch.float64) * DT
    period = time % 45.0
    top = speed[..., None]
    braking = (top - deceleration * (period - 3.0)).clamp(min=0.0)
    v = torch.where(
        period < 3.0,
        top,
        torch.where(
            period < 20.0, torch.minimum(braking, top), torch.minimum(1.5 * (period - 20.0), top)
        ),
    )
    position = torch.cat(
        [torch.zeros_like(v[..., :1]), torch.cumsum(v[..., 1:] * DT, dim=-1)], dim=-1
    )
    acceleration = torch.diff(v, dim=-1, prepend=v[..., :1]) / DT
    return Leader(position, v, acceleration, torch.full(speed.shape, LENGTH, dtype=torch.float64))


def _of_one(k: int, value: Tensor) -> Tensor:
    return value[k] if value.dim() else value


def _describe(step: Step, wrong: Tensor) -> str:
    """Names the first state and parameters that are wrong."""
    follower, leader, p = step
    row, column = (int(i) for i in wrong.nonzero()[0])
    gap = leader.position[column] - leader.length[column] - follower.position[row, column]
    values = ", ".join(f"{name}={value[row, 0].item():g}" for name, value in p.items())
    return (
        f"gap {gap.item():g} m, v {follower.speed[row, column].item():g}, v_l"
        f" {leader.speed[column].item():g} m/s, "
        f"a {follower.acceleration[row, column].item():g}, a_l"
        f" {leader.acceleration[column].item():g} m/s2, {values}"
    )


CONTRACT = contract_of(
    __name__, "model", first=FIRST, slow=[can_be_compiled_as_one_graph, gradients_are_right]
)
