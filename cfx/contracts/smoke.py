"""What a new component must do before a job relies on it: a few steps on made-up input, once.

A smoke check takes some milliseconds. It catches what would otherwise end in a torch traceback, or
in numbers that mean nothing, minutes later: the wrong shape or dtype, NaN, another number of
parameters than declared. The whole contract of each kind is in `cfx.contracts`; `cfx plugins check`
runs its quick part. Datasets, learners and protocols have no smoke check: they do nothing before
they are given something to work on, and their base classes check what they give.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from cfx.calibration.objectives.base import FrameValues, Objective
from cfx.calibration.optimizers.base import Optimizer
from cfx.calibration.settings import WindowSettings
from cfx.contracts.metrics import PAIRS, trajectories
from cfx.core.errors import CfxError, PluginError
from cfx.core.parameters import ParameterSpace
from cfx.evaluation.metrics.base import Metric
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import token_width
from cfx.simulation.base import Stepper
from cfx.simulation.simulator import Simulator
from cfx.simulation.trajectory import Start

STATES = 24
"""Vehicles whose step is tried."""

DT = 0.1
"""Time step, s."""

NETWORKS, DRIVERS, WINDOWS, PARAMETERS, LENGTH = 3, 2, 4, 5, 5
"""As many parameters as IDM has, for which a policy is built."""


@torch.no_grad()
def smoke_check_model(model: DrivingModel) -> None:
    """Takes one step from ordinary states, with parameters as the class declares them.

    The step is taken in double and in single precision.

    Raises:
        PluginError: a speed or the memory has another shape or dtype than the states or is not
            finite, a speed is negative, or the step reads other parameters than the class declares.
    """
    if model.needs_simulator:  # it has no step to try
        return
    for dtype in (torch.float64, torch.float32):
        follower, leader = _states(model, dtype)
        values = _values(model.parameters, dtype)
        p = _Noted(values)
        before = _copies(follower, leader, values)
        speed = model.next_speed(follower, leader, p, DT)
        _require_tensor(speed, "next_speed", (STATES,), dtype, "(*batch,)")
        wrong = ~(speed.isfinite() & (speed >= 0))
        if bool(wrong.any()):
            example = speed[wrong][0].item()
            raise PluginError(
                f"next_speed gives {example:g} m/s in {int(wrong.sum())} of {STATES} ordinary"
                " states; it must give finite speeds, not negative"
            )
        memory = model.next_memory(follower, leader, p, DT, speed)
        _require_tensor(
            memory, "next_memory", (STATES, model.memory_size), dtype, "(*batch, memory_size)"
        )
        if not bool(memory.isfinite().all()):
            raise PluginError("next_memory gives a number that is not finite in an ordinary state")
        _require_unchanged(before, _copies(follower, leader, values))
        _require_all_read(model, p)


def _copies(follower: Follower, leader: Leader, p: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns copies of all that a step is given, by name."""
    given = {f"follower.{name}": value for name, value in follower._asdict().items()}
    given |= {f"leader.{name}": value for name, value in leader._asdict().items()}
    given |= {f"p['{name}']": value for name, value in p.items()}
    return {name: value.clone() for name, value in given.items()}


def _require_unchanged(before: dict[str, Tensor], after: dict[str, Tensor]) -> None:
    for name, value in before.items():
        if not torch.equal(value, after[name]):
            raise PluginError(
                f"a step changes {name} in place; compute new tensors, for others read these"
            )


def _states(model: DrivingModel, dtype: torch.dtype) -> tuple[Follower, Leader]:
    """Returns followers and leaders at a standstill, in a queue and on a free road."""
    draw = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float) -> Tensor:
        unit = torch.rand(STATES, generator=draw, dtype=torch.float64)
        return low + (high - low) * unit.to(dtype)

    speed = uniform(0.0, 25.0)
    leader_speed = uniform(0.0, 25.0)
    speed[:2] = 0.0
    leader_speed[1:3] = 0.0
    length = uniform(4.0, 6.0)
    leader = Leader(uniform(100.0, 200.0), leader_speed, uniform(-1.0, 1.0), length)
    memory = model.initial_memory(speed)
    _require_tensor(
        memory, "initial_memory", (STATES, model.memory_size), dtype, "(*batch, memory_size)"
    )
    position = leader.position - length - 2.0 - 1.5 * speed - uniform(0.0, 30.0)
    return Follower(position, speed, uniform(-1.0, 1.0), memory), leader


def _values(space: ParameterSpace, dtype: torch.dtype) -> dict[str, Tensor]:
    """Returns parameters for each state: defaults, then values within the declared bounds."""
    draw = torch.Generator().manual_seed(1)
    unit = torch.rand((STATES, len(space)), generator=draw, dtype=torch.float64)
    unit[: STATES // 2] = space.to_unit(space.defaults())
    return space.unpack(space.from_unit(unit).to(dtype))


class _Noted(Mapping[str, Tensor]):
    """Parameters by name, with a note of which were read; reading them all at once notes all."""

    def __init__(self, values: dict[str, Tensor]) -> None:
        self._values = values
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._values:
            raise PluginError(
                f"next_speed reads the parameter '{name}',"
                f" which is not in its `parameters` ({', '.join(self._values)})"
            )
        self.read.add(name)
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __or__(self, other: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {**self, **other}


def _require_all_read(model: DrivingModel, p: _Noted) -> None:
    """Checks that a model in its default settings reads each tuned parameter that it declares."""
    if not _has_default_settings(model):  # a variant of a model may leave some out
        return
    names = model.parameters.for_settings(model.settings).names
    unread = [name for name in names if name not in p.read]
    if unread:
        raise PluginError(
            f"it declares {len(names)} tuned parameters ({', '.join(names)}),"
            f" but next_speed never reads {', '.join(unread)}"
        )


def _has_default_settings(model: DrivingModel) -> bool:
    """Says whether a model has the settings of its class, whatever its parameters' bounds are."""
    for name, field in model.schema.model_fields.items():
        if name == "parameters":
            continue
        if field.is_required():
            return False
        default = field.get_default(call_default_factory=True)
        if model.settings.__dict__[name] != default:
            return False
    return True


@torch.no_grad()
def smoke_check_policy(policy: Policy) -> None:
    """Builds a few networks and asks them about a few windows, in the precision of a job.

    Raises:
        PluginError: an answer or the state has another shape or dtype than it must have, or an
            answer is NaN or outside [0, 1].
    """
    # A learner trains in single precision; what needs no training computes in double precision, so
    # that constants stay what they are.
    dtype = torch.float32 if policy.trainable else torch.float64
    draw = torch.Generator().manual_seed(0)
    windows = WindowSettings(length=LENGTH, stride=LENGTH)
    policy = policy.for_model(IDM(), DT, windows)
    features = token_width(policy.inputs, policy.summary, LENGTH)
    fixed = torch.rand((NETWORKS, PARAMETERS), generator=draw, dtype=dtype)
    with torch.random.fork_rng(devices=[]):
        network = policy.build(features, torch.full((PARAMETERS,), 0.5, dtype=dtype), fixed, draw)
        if not isinstance(network, PolicyNetwork):
            raise PluginError(f"build returns a {type(network).__name__} and no PolicyNetwork")
        tokens = torch.randn((NETWORKS, DRIVERS, WINDOWS, features), generator=draw, dtype=dtype)
        state = network.initial_state(NETWORKS, DRIVERS)
        answer, after = network.eval()(tokens, state)
    if not isinstance(state, Tensor) or state.dim() != 3 or state.shape[:2] != (NETWORKS, DRIVERS):
        raise PluginError(
            f"initial_state gives {_shown(state)}; it must give (networks, drivers, s)"
        )
    _require_tensor(
        after,
        "the state after the last window",
        tuple(state.shape),
        state.dtype,
        "(networks, drivers, s)",
    )
    expected = (NETWORKS, DRIVERS, WINDOWS, PARAMETERS)
    _require_tensor(answer, "forward", expected, dtype, "(networks, drivers, windows, parameters)")
    if not bool(((answer >= 0) & (answer <= 1)).all()):  # written so that NaN fails too
        raise PluginError(
            "forward answers NaN or a number outside [0, 1]; parameters are chosen in unit space"
        )


@torch.no_grad()
def smoke_check_simulator(simulator: Simulator) -> None:
    """Makes a stepper for Krauss's model; one that works in this process takes two steps.

    Whether it works in this process is known by its gradients. Another one may take seconds to
    start, so that its steps are left to `cfx plugins check`. A simulator that cannot simulate this
    model, or misses something that is not installed, says so itself when a job asks it.

    Raises:
        PluginError: what `stepper` returns is no stepper, its identity is no text, or a step gives
            another shape or dtype than the states have, or a number that is not finite.
    """
    model = Krauss()
    try:
        simulator.require(model)
        stepper: object = simulator.stepper(model, DT)
    except PluginError:
        raise
    except CfxError:
        return
    if not isinstance(stepper, Stepper):
        raise PluginError(f"stepper returns a {type(stepper).__name__} and no Stepper")
    if not isinstance(stepper.identity(), str):
        raise PluginError("identity() must give a text: caches carry it")
    if simulator.differentiable:
        _smoke_check_steps(stepper, model)


def _smoke_check_steps(stepper: Stepper, model: DrivingModel) -> None:
    for dtype in (torch.float64, torch.float32):
        follower, ahead = _states(model, dtype)
        leader = Leader(
            ahead.position.expand(2, -1),
            ahead.speed.expand(2, -1),
            ahead.acceleration.expand(2, -1),
            ahead.length,
        )
        start = Start(follower.position, follower.speed, follower.acceleration)
        values = _values(model.parameters, dtype)
        end, position, speed = stepper.advance(stepper.begin(start), leader, values)
        _require_tensor(end.speed, "advance's follower", (STATES,), dtype, "(*batch,)")
        for name, found in (("positions", position), ("speeds", speed)):
            _require_tensor(found, f"advance's {name}", (2, STATES), dtype, "(K, *batch)")
            if not bool(found.isfinite().all()):
                raise PluginError(f"advance gives {name} that are not finite in ordinary states")


def smoke_check_optimizer(optimizer: Optimizer) -> None:
    """Asks an optimizer for its numbers; what it finds is checked by `Optimizer.minimize`.

    Raises:
        PluginError: one of them is no whole number or out of range.
    """
    evaluations = _whole(optimizer.evaluations(), "evaluations()", least=1)
    _whole(optimizer.evaluations_at_once(), "evaluations_at_once()", least=1)
    _whole(optimizer.bytes_per_problem(PARAMETERS), "bytes_per_problem(n)", least=0)
    if _whole(optimizer.space_filling(), "space_filling()", least=1) > evaluations:
        raise PluginError(
            "space_filling() gives more than the"
            f" {evaluations} evaluations that evaluations() gives"
        )


@torch.no_grad()
def smoke_check_objective(objective: Objective) -> None:
    """Asks for the loss of a few ordinary trajectories, in double and in single precision.

    Raises:
        PluginError: it has no unit, or signals that do not exist; a loss has another shape or dtype
            than the trajectories, is negative or not finite, or reads a signal that it does not
            name.
    """
    if not isinstance(getattr(objective, "unit", None), str):
        raise PluginError("it has no `unit`; it must say the unit of its loss, '' if there is none")
    signals = set(objective.signals)
    if not signals or not signals <= {"speed", "gap"}:
        raise PluginError(
            f"its `signals` are {objective.signals!r}; they must be of 'speed', 'gap'"
        )
    for dtype in (torch.float64, torch.float32):
        loss = objective(_trajectories(objective, dtype), torch.ones((LENGTH, 1), dtype=dtype))
        _require_tensor(loss, "finish", (DRIVERS,), dtype, "(*batch,)")
        if not bool((loss.isfinite() & (loss >= 0)).all()):
            raise PluginError(
                f"it gives the losses {loss.tolist()} of ordinary trajectories; losses must be"
                " finite and not negative"
                f" (it says that it reads {' and '.join(sorted(signals))} alone)"
            )


def _trajectories(objective: Objective, dtype: torch.dtype) -> FrameValues:
    """Returns a few trajectories `(LENGTH, DRIVERS)`.

    A signal that the objective does not name is NaN.
    """
    draw = torch.Generator().manual_seed(0)
    values = {}
    for signal in ("speed", "gap"):
        measured = 5.0 + 10.0 * torch.rand((LENGTH, DRIVERS), generator=draw, dtype=torch.float64)
        error = torch.randn((LENGTH, DRIVERS), generator=draw, dtype=torch.float64)
        for name, signals in {signal: measured + error, f"measured_{signal}": measured}.items():
            if signal in objective.signals:
                values[name] = signals.to(dtype)
            else:
                values[name] = torch.full_like(measured, torch.nan, dtype=dtype)
    return FrameValues(**values, dt=DT)


@torch.no_grad()
def smoke_check_metric(metric: Metric) -> None:
    """Measures a few trajectories, in double and in single precision.

    Raises:
        PluginError: it gives something else than one floating-point number for each pair.
    """
    for dtype in (torch.float64, torch.float32):
        values = metric.compute(trajectories(dtype))
        if not isinstance(values, Tensor) or values.shape != (PAIRS,):
            raise PluginError(
                f"compute gives {_shown(values)}; it must give a number for each pair, (pairs,)"
            )
        if not values.is_floating_point():
            raise PluginError(f"compute gives {values.dtype}; it must give floating-point numbers")


def _whole(value: object, name: str, *, least: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise PluginError(f"{name} gives {value!r}; it must give a whole number, at least {least}")
    return value


def _require_tensor(
    value: object, name: str, shape: tuple[int, ...], dtype: torch.dtype, shape_in_words: str
) -> None:
    if not isinstance(value, Tensor) or value.shape != shape:
        raise PluginError(
            f"{name} gives {_shown(value)}; it must give {shape_in_words}, here {shape}"
        )
    if value.dtype != dtype:
        raise PluginError(
            f"{name} gives {value.dtype} for {dtype};"
            " a component computes in the dtype of what it is given"
        )


def _shown(value: object) -> str:
    if isinstance(value, Tensor):
        return f"the shape {tuple(value.shape)}"
    return f"a {type(value).__name__}"
