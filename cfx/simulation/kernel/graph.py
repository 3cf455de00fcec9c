"""The operations of one vehicle step, recorded from the model's own definition.

Shapes: everything recorded is elementwise over vehicles, `(V,)`, or a constant, `()`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx

from cfx.models.base import DrivingModel, Follower, Leader
from cfx.simulation.step import advance_vehicle
from cfx.simulation.trajectory import Terms

INPUTS = (
    "position",
    "speed",
    "acceleration",
    "leader_position",
    "leader_speed",
    "leader_acceleration",
    "leader_length",
    "leader_rear",
    "measured_speed",
    "measured_gap",
)
"""What a step reads, before the model's parameters. The last three are of the next frame."""

_VEHICLES = 7
"""Vehicles in the recording: a number that no other dimension has by chance."""


def parameter_names(count: int) -> tuple[str, ...]:
    """Returns what expressions call the parameters: a model's own names need not be C++'s."""
    return tuple(f"p{k}" for k in range(count))


class Unsupported(Exception):  # noqa: N818 - no error: PyTorch simulates such a model
    """A step does something that has no place in a kernel."""


class Statement(NamedTuple):
    """One operation: `name = expression`, a number or (`is_condition`) true or false."""

    name: str
    expression: str
    is_condition: bool


class StepProgram(NamedTuple):
    """One step, as C++ expressions over `INPUTS` and `parameter_names`.

    Attributes:
        statements: in order.
        state: expressions of position, speed and acceleration after the step.
        terms: expressions of what the frame adds to each sum.
    """

    statements: tuple[Statement, ...]
    state: tuple[str, str, str]
    terms: tuple[str, ...]


def record(
    model: DrivingModel, parameters: Sequence[str], dt: float, terms: Terms, dtype: torch.dtype
) -> StepProgram:
    """Records one step of a model and what its frame adds to an objective's sums.

    Args:
        model: without a memory of its own.
        parameters: names of all the model's parameters, in the order of the kernel's inputs.
        dt: time step, s.
        terms: the objective's.
        dtype: of all values.

    Raises:
        Unsupported: the step is not elementwise, branches on values, or uses an operation that has
            no C++ counterpart here.
    """
    from torch.fx.experimental.proxy_tensor import make_fx

    if model.memory_size:
        raise Unsupported("a memory of its own")

    nothing = torch.empty((_VEHICLES, 0), dtype=dtype)

    def step(*values: Tensor) -> tuple[Tensor, ...]:
        known = dict(zip(INPUTS, values, strict=False))
        p = dict(zip(parameters, values[len(INPUTS) :], strict=True))
        follower = Follower(known["position"], known["speed"], known["acceleration"], nothing)
        leader = Leader(
            known["leader_position"],
            known["leader_speed"],
            known["leader_acceleration"],
            known["leader_length"],
        )
        after = advance_vehicle(model, follower, leader, p, dt)
        gap = known["leader_rear"] - after.position
        added = terms(after.speed, gap, known["measured_speed"], known["measured_gap"])
        return (after.position, after.speed, after.acceleration, *added)

    examples = []
    for number in range(len(INPUTS) + len(parameters)):
        examples.append(torch.full((_VEHICLES,), 1.0 + number, dtype=dtype))
    try:
        graph = make_fx(step)(*examples).graph
    except Exception as error:
        raise Unsupported(f"recording it failed ({type(error).__name__})") from error
    return _program(graph, [*INPUTS, *parameter_names(len(parameters))])


def _program(graph: fx.Graph, inputs: Sequence[str]) -> StepProgram:
    expressions: dict[fx.Node, str] = {}
    statements: list[Statement] = []
    names = iter(inputs)
    for node in graph.nodes:
        if node.op == "placeholder":
            expressions[node] = next(names)
        elif node.op == "call_function":
            value = node.meta.get("val")
            _check_elementwise(value)
            expression = _expression(node, expressions)
            if expression.startswith("("):
                name = f"s{len(statements)}"
                statements.append(Statement(name, expression, value.dtype == torch.bool))
                expressions[node] = name
            else:
                expressions[node] = expression
        elif node.op == "get_attr":
            expressions[node] = _constant(graph, node)
        elif node.op == "output":
            found = [expressions[one] for one in node.args[0]]
            state = (found[0], found[1], found[2])
            return StepProgram(tuple(statements), state, tuple(found[3:]))
    raise Unsupported("it returns nothing")


def _check_elementwise(value: Any) -> None:
    if not isinstance(value, Tensor) or tuple(value.shape) not in {
        (),
        (_VEHICLES,),
        (_VEHICLES, 0),
    }:
        raise Unsupported("an operation that is not elementwise")


def _constant(graph: fx.Graph, node: fx.Node) -> str:
    value: Any = graph.owning_module
    for name in str(node.target).split("."):
        value = getattr(value, name)
    if not isinstance(value, Tensor) or value.numel() != 1:
        raise Unsupported("a constant that is no number")
    return literal(value.item())


def literal(value: float | bool) -> str:
    """Returns a number as C++ writes it, exactly."""
    if isinstance(value, bool):
        return "true" if value else "false"
    number = float(value)
    if math.isnan(number):
        return "real(NAN)"
    if math.isinf(number):
        return "real(INFINITY)" if number > 0 else "real(-INFINITY)"
    return f"real({number.hex()})"


_TEMPLATES: dict[str, str] = {
    "add": "({0} + {1})",
    "sub": "({0} - {1})",
    "rsub": "({1} - {0})",
    "mul": "({0} * {1})",
    "div": "({0} / {1})",
    "neg": "(-{0})",
    "abs": "(std::fabs({0}))",
    "sqrt": "(std::sqrt({0}))",
    "rsqrt": "(real(1) / std::sqrt({0}))",
    "reciprocal": "(real(1) / {0})",
    "square": "({0} * {0})",
    "exp": "(std::exp({0}))",
    "log": "(std::log({0}))",
    "log1p": "(std::log1p({0}))",
    "expm1": "(std::expm1({0}))",
    "tanh": "(std::tanh({0}))",
    "sin": "(std::sin({0}))",
    "cos": "(std::cos({0}))",
    "atan": "(std::atan({0}))",
    "floor": "(std::floor({0}))",
    "ceil": "(std::ceil({0}))",
    "sigmoid": "(real(1) / (real(1) + std::exp(-{0})))",
    "relu": "(greater({0}, real(0)))",
    "minimum": "(smaller({0}, {1}))",
    "maximum": "(greater({0}, {1}))",
    "clamp_min": "(greater({0}, {1}))",
    "clamp_max": "(smaller({0}, {1}))",
    "pow": "(std::pow({0}, {1}))",
    "where": "({0} ? {1} : {2})",
    "gt": "({0} > {1})",
    "ge": "({0} >= {1})",
    "lt": "({0} < {1})",
    "le": "({0} <= {1})",
    "eq": "({0} == {1})",
    "ne": "({0} != {1})",
    "logical_and": "({0} && {1})",
    "logical_or": "({0} || {1})",
    "logical_not": "(!{0})",
    "bitwise_and": "({0} & {1})",
    "bitwise_or": "({0} | {1})",
    "bitwise_not": "(!{0})",
    "isnan": "({0} != {0})",
}
"""PyTorch's elementwise operations in C++; `smaller` and `greater` treat NaN as it does."""

_UNCHANGED = {"alias", "clone", "detach", "expand", "lift_fresh_copy", "scalar_tensor", "view"}
"""Operations that return what they are given; a constant's shape does not matter here."""

_HUBER_ARGUMENTS = 4
"""Input, target, reduction and delta; PyTorch leaves a delta of 1 out."""

_FILLED = {"zeros_like": 0.0, "ones_like": 1.0}


def _expression(node: fx.Node, known: dict[fx.Node, str]) -> str:
    """Returns what an operation computes, in parentheses, or the expression that it passes on."""
    operation = str(node.target).removeprefix("aten.").partition(".")[0]
    if operation == "_to_copy":
        return _converted(node, known)
    arguments = [_argument(one, known) for one in node.args]
    if operation == "clamp":
        return _clamped(node, arguments, known)
    if operation == "huber_loss":
        return _huber(node, arguments)
    passed_on = _passed_on(operation, arguments)
    if passed_on:
        return passed_on
    if operation not in _TEMPLATES or "rounding_mode" in node.kwargs:
        raise Unsupported(f"the operation {operation}")
    if node.kwargs.get("alpha", 1) != 1:
        arguments[1] = f"({literal(float(str(node.kwargs['alpha'])))} * {arguments[1]})"
    if operation == "pow" and isinstance(node.args[1], int | float):
        return _power(arguments[0], float(node.args[1]), arguments[1])
    return _TEMPLATES[operation].format(*arguments)


def _passed_on(operation: str, arguments: list[str]) -> str:
    """Returns the expression that an operation passes on; "" if it computes something."""
    if operation in {"full_like", "full"}:
        return arguments[1]
    if operation in _FILLED:
        return literal(_FILLED[operation])
    return arguments[0] if operation in _UNCHANGED else ""


def _argument(value: Any, known: dict[fx.Node, str]) -> str:
    if isinstance(value, fx.Node):
        return known[value]
    if isinstance(value, bool | int | float):
        return literal(value)
    return ""


def _converted(node: fx.Node, known: dict[fx.Node, str]) -> str:
    """Returns a condition as a number; other conversions have no place here."""
    source: Any = node.args[0]
    before, after = source.meta["val"].dtype, node.meta["val"].dtype
    if before == after:
        return known[source]
    if before == torch.bool and after.is_floating_point:
        return f"({known[source]} ? real(1) : real(0))"
    raise Unsupported(f"a conversion from {before} to {after}")


def _clamped(node: fx.Node, arguments: list[str], known: dict[fx.Node, str]) -> str:
    low, high = [*arguments[1:], "", ""][:2]
    if "min" in node.kwargs:
        low = _argument(node.kwargs["min"], known)
    if "max" in node.kwargs:
        high = _argument(node.kwargs["max"], known)
    expression = arguments[0]
    if low:
        expression = f"(greater({expression}, {low}))"
    if high:
        expression = f"(smaller({expression}, {high}))"
    return expression


def _huber(node: fx.Node, arguments: list[str]) -> str:
    """Returns Huber's loss of each element; one that is reduced over elements has no place here."""
    if len(node.args) < _HUBER_ARGUMENTS - 1 or node.args[2] != 0:
        raise Unsupported("a loss that is reduced over vehicles")
    delta = literal(1.0)
    if len(node.args) == _HUBER_ARGUMENTS:
        delta = arguments[3]
    return f"(huber({arguments[0]} - {arguments[1]}, {delta}))"


def _power(base: str, exponent: float, given: str) -> str:
    """Returns a power with a constant exponent, computed as PyTorch does."""
    simple = {
        0.5: f"(std::sqrt({base}))",
        1.0: f"({base} * real(1))",
        2.0: f"({base} * {base})",
        3.0: f"({base} * {base} * {base})",
        4.0: f"(({base} * {base}) * ({base} * {base}))",
        -0.5: f"(real(1) / std::sqrt({base}))",
        -1.0: f"(real(1) / {base})",
        -2.0: f"(real(1) / ({base} * {base}))",
    }
    return simple.get(exponent, f"(std::pow({base}, {given}))")
