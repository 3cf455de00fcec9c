"""The operations of one vehicle step, recorded from the model's own definition.

Shapes: everything recorded is elementwise over vehicles, `(V,)`, or a constant, `()`. Where the
model has a memory there are columns too, `(V, m)`; `columns` says how they are kept.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx

from cfx.models.base import DrivingModel, Follower, Leader
from cfx.simulation.kernel.columns import (
    MOVES,
    VEHICLES,
    Expressions,
    Unsupported,
    array,
    broadcast,
    literal,
    memory_names,
    operation_of,
    shape_of,
)
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
"""Inputs of a step, before the model's parameters. The last three are of the next frame."""

_MOST_COLUMNS = 512
"""The widest memory of a model that has a kernel; two of them lie on a thread's stack."""


def parameter_names(count: int) -> tuple[str, ...]:
    """Returns what expressions call the parameters: a model's own names need not be C++'s."""
    return tuple(f"p{k}" for k in range(count))


class Assignment(NamedTuple):
    """One operation: `name = expression`, a number or (`is_condition`) true or false.

    `cfx.learners.compiled` differentiates `operation` by its `operands`.
    """

    name: str
    expression: str
    is_condition: bool
    operation: str = ""
    operands: tuple[str, ...] = ()

    @property
    def declaration(self) -> str:
        """The statement in C++."""
        if self.is_condition:
            return f"const bool {self.name} = {self.expression};"
        return f"const real {self.name} = {self.expression};"


class StepProgram(NamedTuple):
    """One step, as C++ expressions over `INPUTS` and `parameter_names`.

    Attributes:
        statements: in order.
        state: expressions of position, speed and acceleration after the step.
        memory: expressions of the columns of the model's memory after the step.
        terms: expressions of what the frame adds to each sum.
    """

    statements: tuple[Assignment, ...]
    state: tuple[str, str, str]
    memory: tuple[str, ...]
    terms: tuple[str, ...]


def record(
    model: DrivingModel, parameters: Sequence[str], dt: float, terms: Terms, dtype: torch.dtype
) -> StepProgram:
    """Records one step of a model and what its frame adds to an objective's sums.

    Args:
        model: the driving model.
        parameters: names of all the model's parameters, in the order of the kernel's inputs.
        dt: time step, s.
        terms: the objective's.
        dtype: of all values.

    Raises:
        Unsupported: the step is not elementwise, branches on values, has a very wide memory, or
            uses an operation that has no C++ counterpart here.
    """
    width = model.memory_size
    if width > _MOST_COLUMNS:
        raise Unsupported(f"a memory of {width} numbers")
    last = len(INPUTS) + len(parameters)

    def step(*values: Tensor) -> tuple[Tensor, ...]:
        inputs = dict(zip(INPUTS, values, strict=False))
        p = dict(zip(parameters, values[len(INPUTS) : last], strict=True))
        memory = torch.empty((VEHICLES, 0), dtype=dtype)
        if width:
            memory = torch.stack(values[last:], dim=-1)
        follower = Follower(inputs["position"], inputs["speed"], inputs["acceleration"], memory)
        leader = Leader(
            inputs["leader_position"],
            inputs["leader_speed"],
            inputs["leader_acceleration"],
            inputs["leader_length"],
        )
        after = advance_vehicle(model, follower, leader, p, dt)
        gap = inputs["leader_rear"] - after.position
        measured = inputs["measured_speed"], inputs["measured_gap"]
        added = terms.function(after.speed, gap, *measured)
        return (after.position, after.speed, after.acceleration, after.memory, *added)

    graph = traced(step, last + width, dtype)
    names = [*INPUTS, *parameter_names(len(parameters)), *memory_names(width)]
    statements, (position, speed, acceleration, memory, *added) = Recording(names).function(graph)
    if len(memory) != width:
        raise Unsupported("a memory that changes its width")
    state = (position[0], speed[0], acceleration[0])
    return StepProgram(statements, state, memory, tuple(term[0] for term in added))


def record_terms(terms: Terms, dtype: torch.dtype) -> None:
    """Records what a frame adds to an objective's sums alone, without a model.

    Tells whether the objective or the model is why a step has no kernel.

    Raises:
        Unsupported: as `record`.
    """
    names = INPUTS[:4]
    Recording(names).function(traced(terms.function, len(names), dtype))


def traced(
    function: Callable[..., Sequence[Tensor]],
    inputs: int,
    dtype: torch.dtype,
    decompositions: Any = None,
) -> fx.Graph:
    """Returns the operations of a function of so many tensors `(V,)`."""
    # Imported here: it takes seconds, and a process that finds its kernels on the disk needs none.
    from torch.fx.experimental.proxy_tensor import make_fx

    examples = []
    for number in range(inputs):
        # Different values, all above 0: none is special to an equation.
        examples.append(torch.full((VEHICLES,), 1.0 + number, dtype=dtype))
    try:
        graph: fx.Graph = make_fx(function, decompositions)(*examples).graph
    except Exception as error:
        raise Unsupported(f"recording it failed ({type(error).__name__})") from error
    return graph


class Recording:
    """Turns a recorded graph into statements."""

    def __init__(self, inputs: Sequence[str]) -> None:
        self._inputs = iter(inputs)
        self._statements: list[Assignment] = []
        self._expressions_of: dict[fx.Node, Any] = {}

    def function(
        self, graph: fx.Graph
    ) -> tuple[tuple[Assignment, ...], tuple[tuple[str, ...], ...]]:
        """Returns the statements, and the expressions of the columns of each result."""
        for node in graph.nodes:
            if node.op == "placeholder":
                self._expressions_of[node] = array((1,), [next(self._inputs)])
            elif node.op == "call_function":
                self._expressions_of[node] = self._computed(node)
            elif node.op == "get_attr":
                self._expressions_of[node] = _constant(graph, node)
            elif node.op == "output":
                returned: Any = node.args[0]
                results = []
                for value in returned:
                    results.append(tuple(map(str, self._expressions_of[value].flat)))
                return tuple(self._statements), tuple(results)
        raise Unsupported("it returns nothing")

    def _computed(self, node: fx.Node) -> Any:
        """Returns the expressions that an operation gives; several arrays if it gives several."""
        value = node.meta.get("val")
        move = MOVES.get(operation_of(node))
        if move is not None:
            moved = move(node, self._expressions_of)
            if isinstance(value, Tensor):
                return self._named(moved.reshape(shape_of(value)), value)
            return moved
        if not isinstance(value, Tensor):
            raise Unsupported(f"the operation {operation_of(node)}")
        return self._named(self._elementwise(node, shape_of(value)), value)

    def _elementwise(self, node: fx.Node, shape: tuple[int, ...]) -> Expressions:
        """Returns what an operation computes of each element of its operands."""
        operands: list[Expressions] = []
        for argument in node.args:
            if isinstance(argument, fx.Node):
                operands.append(broadcast(self._expressions_of[argument], shape))
            else:
                operands.append(broadcast(array((), [_number(argument)]), shape))
        computed = []
        is_condition = node.meta["val"].dtype == torch.bool
        for place in itertools.product(*map(range, shape)):
            arguments = [str(operand[place]) for operand in operands]
            expression = _expression(node, list(arguments))
            operation, arguments = _differentiated(node, arguments)
            computed.append(self._name(expression, is_condition, operation, arguments))
        return array(shape, computed)

    def _named(self, computed: Expressions, value: Tensor) -> Expressions:
        """Returns the names of expressions; each that computes becomes a statement."""
        is_condition = value.dtype == torch.bool
        names = [self._name(str(expression), is_condition) for expression in computed.flat]
        return array(computed.shape, names)

    def _name(
        self, expression: str, is_condition: bool, operation: str = "", operands: Sequence[str] = ()
    ) -> str:
        """Returns the name of an expression, which becomes a statement if it computes."""
        if not expression.startswith("("):
            return expression
        name = f"s{len(self._statements)}"
        statement = Assignment(name, expression, is_condition, operation, tuple(operands))
        self._statements.append(statement)
        return name


def _constant(graph: fx.Graph, node: fx.Node) -> Expressions:
    value: Any = graph.owning_module
    for name in str(node.target).split("."):
        value = getattr(value, name)
    if not isinstance(value, Tensor) or VEHICLES in value.shape or value.numel() > _MOST_COLUMNS:
        raise Unsupported("a constant that is no number")
    literals = [literal(number) for number in value.flatten().tolist()]
    return array(tuple(value.shape), literals)


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
    "nan_to_num": "(without_nan({0}))",
}
"""PyTorch's elementwise operations in C++; `smaller` and `greater` treat NaN as it does."""

_UNCHANGED = {"alias", "clone", "detach", "expand", "lift_fresh_copy", "scalar_tensor"}
"""Operations that return their argument in another shape."""

_OTHER_MEANINGS = {"rounding_mode", "nan", "posinf", "neginf"}
"""Arguments with which an operation computes something else."""

_WHOLE = {torch.int64, torch.int32}

_HUBER_ARGUMENTS = 4
"""Input, target, reduction and delta; PyTorch leaves a delta of 1 out."""

_FILLED = {"zeros_like": 0.0, "ones_like": 1.0}


def _expression(node: fx.Node, arguments: list[str]) -> str:
    """Returns what an operation computes, in parentheses, or the expression that it passes on."""
    operation = operation_of(node)
    if operation == "_to_copy":
        return _converted(node, arguments[0])
    if operation == "clamp":
        return _clamped(node, arguments)
    if operation == "huber_loss":
        return _huber(node, arguments)
    passed_on = _passed_on(operation, arguments)
    if passed_on:
        return passed_on
    if operation not in _TEMPLATES or node.kwargs.keys() & _OTHER_MEANINGS:
        raise Unsupported(f"the operation {operation}")
    if node.kwargs.get("alpha", 1) != 1:
        arguments[1] = f"({literal(float(str(node.kwargs['alpha'])))} * {arguments[1]})"
    if operation == "pow" and isinstance(node.args[1], int | float):
        return power(arguments[0], float(node.args[1]), arguments[1])
    if operation == "nan_to_num" and len(arguments) > 1:
        raise Unsupported("other numbers than PyTorch's for NaN")
    return _TEMPLATES[operation].format(*arguments)


def _differentiated(node: fx.Node, arguments: list[str]) -> tuple[str, list[str]]:
    """Returns an operation and its operands as `adjoint` knows them; "" where it cannot."""
    operation = operation_of(node)
    if node.kwargs.get("alpha", 1) != 1:
        return "", arguments
    if operation == "clamp":
        low, high = [*arguments[1:], "", ""][:2]
        low = low or _number(node.kwargs.get("min")) or literal(-math.inf)
        high = high or _number(node.kwargs.get("max")) or literal(math.inf)
        arguments = [arguments[0], low, high]
    if operation == "pow" and isinstance(node.args[1], int | float):
        return f"pow {float(node.args[1])!r}", arguments[:1]
    return operation, arguments


def _passed_on(operation: str, arguments: list[str]) -> str:
    """Returns the expression that an operation passes on; "" if it computes something."""
    if operation in {"full_like", "full"}:
        return arguments[1]
    if operation in _FILLED:
        return literal(_FILLED[operation])
    if operation in _UNCHANGED:
        return arguments[0]
    return ""


def _number(value: Any) -> str:
    """Returns a number of the graph as C++ writes it; "" for what is no number."""
    if isinstance(value, bool | int | float):
        return literal(value)
    return ""


def _converted(node: fx.Node, value: str) -> str:
    """Returns a value in another type, of which a kernel has two: numbers and conditions.

    Whole numbers are kept as floating-point numbers; indices of a memory are small.
    """
    source: Any = node.args[0]
    before, after = source.meta["val"].dtype, node.meta["val"].dtype
    if before == after or (before in _WHOLE and after != torch.bool):
        return value
    if before == torch.bool and after.is_floating_point:
        return f"({value} ? real(1) : real(0))"
    if before.is_floating_point and after in _WHOLE:
        return f"(std::trunc({value}))"
    raise Unsupported(f"a conversion from {before} to {after}")


def _clamped(node: fx.Node, arguments: list[str]) -> str:
    low, high = [*arguments[1:], "", ""][:2]
    for bound in node.kwargs.values():
        if isinstance(bound, fx.Node):
            raise Unsupported("bounds that are computed and given by name")
    if "min" in node.kwargs:
        low = _number(node.kwargs["min"])
    if "max" in node.kwargs:
        high = _number(node.kwargs["max"])
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


def power(base: str, exponent: float, exponent_text: str) -> str:
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
    return simple.get(exponent, f"(std::pow({base}, {exponent_text}))")
