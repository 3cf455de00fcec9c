"""Values with columns, such as a model's memory, in the recording of a step.

A tensor is an array of C++ expressions of its shape, in which all the vehicles have size 1: each
expression is computed for every vehicle. What moves columns about computes nothing, and works on
such arrays as NumPy does.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor, fx

VEHICLES = 1009
"""Vehicles in the recording: a number that no other dimension has by chance."""

Expressions = npt.NDArray[np.object_]
"""A tensor's values as C++ expressions, each for all vehicles."""

Recorded = Mapping[fx.Node, Any]
"""The expressions of what was recorded before; a sequence of arrays where it gives several."""


class Unsupported(Exception):  # noqa: N818 - no error: PyTorch simulates such a model
    """A step does something that has no place in a kernel."""


def memory_names(width: int) -> tuple[str, ...]:
    """Returns what expressions call the columns of the model's memory."""
    return tuple(f"memory{k}" for k in range(width))


def literal(value: float | bool) -> str:
    """Returns a number as C++ writes it, exactly."""
    if value is True:
        return "true"
    if value is False:
        return "false"
    number = float(value)
    if math.isnan(number):
        return "real(NAN)"
    if number == math.inf:
        return "real(INFINITY)"
    if number == -math.inf:
        return "real(-INFINITY)"
    # Hexadecimal: decimal digits would be rounded.
    return f"real({number.hex()})"


def array(shape: tuple[int, ...], expressions: Sequence[str]) -> Expressions:
    """Returns expressions in a shape."""
    flat = np.empty(len(expressions), dtype=object)
    flat[:] = expressions
    return flat.reshape(shape)


def shape_of(value: Tensor) -> tuple[int, ...]:
    """Returns a tensor's shape with one vehicle instead of all.

    Raises:
        Unsupported: it has a number for each vehicle and each other one.
    """
    if list(value.shape).count(VEHICLES) > 1:
        raise Unsupported("an operation that is not elementwise")
    sizes = list(value.shape)
    if VEHICLES in sizes:
        sizes[sizes.index(VEHICLES)] = 1
    return tuple(sizes)


def broadcast(expressions: Expressions, shape: tuple[int, ...]) -> Expressions:
    """Returns expressions in a shape that they broadcast to.

    Raises:
        Unsupported: they do not.
    """
    try:
        return np.broadcast_to(expressions, shape)
    except ValueError:
        raise Unsupported("an operation that is not elementwise") from None


def operation_of(node: fx.Node) -> str:
    """Returns the name of an operation without its namespace and variant."""
    if node.target is operator.getitem:
        return "getitem"
    return str(node.target).removeprefix("aten.").partition(".")[0]


def _given(node: fx.Node, place: int, name: str, default: Any) -> Any:
    """Returns an argument, given by its place or by its name."""
    if len(node.args) > place:
        return node.args[place]
    return node.kwargs.get(name, default)


def _columns(node: fx.Node, source: Any) -> int:
    """Returns the dimension that an operation works on.

    Raises:
        Unsupported: it is that of the vehicles, each of whom is simulated without the others.
    """
    dimension = int(_given(node, 1, "dim", 0))
    if source.meta["val"].shape[dimension] == VEHICLES:
        raise Unsupported("an operation that is not elementwise")
    return dimension


def _stack(node: fx.Node, expressions_of: Recorded) -> Expressions:
    nodes: Any = node.args[0]
    return np.stack([expressions_of[stacked] for stacked in nodes], int(_given(node, 1, "dim", 0)))


def _arange(node: fx.Node, _expressions_of: Recorded) -> Expressions:
    numbers: Any = node.args
    for number in numbers:
        if not isinstance(number, int):
            raise Unsupported("columns that are not counted by whole numbers")
    literals = [literal(number) for number in range(*numbers)]
    return array((len(literals),), literals)


def _cat(node: fx.Node, expressions_of: Recorded) -> Expressions:
    nodes: Any = node.args[0]
    dimension = _columns(node, nodes[0])
    return np.concatenate([expressions_of[joined] for joined in nodes], dimension)


def _select(node: fx.Node, expressions_of: Recorded) -> Expressions:
    source: Any = node.args[0]
    index = int(_given(node, 2, "index", 0))
    return np.asarray(np.take(expressions_of[source], index, axis=_columns(node, source)))


def _slice(node: fx.Node, expressions_of: Recorded) -> Expressions:
    source: Any = node.args[0]
    if node.meta["val"].shape == source.meta["val"].shape:
        return np.asarray(expressions_of[source])
    dimension = _columns(node, source)
    start, end = _given(node, 2, "start", None), _given(node, 3, "end", None)
    cut: list[slice] = [slice(None)] * expressions_of[source].ndim
    cut[dimension] = slice(start, end, _given(node, 4, "step", 1))
    return np.asarray(expressions_of[source][tuple(cut)])


def _split(node: fx.Node, expressions_of: Recorded) -> list[Expressions]:
    source: Any = node.args[0]
    size = node.args[1]
    if not isinstance(size, int):
        raise Unsupported("parts of several widths")
    dimension = int(_given(node, 2, "dim", 0))
    if source.meta["val"].shape[dimension] == VEHICLES:
        raise Unsupported("an operation that is not elementwise")
    cuts = range(size, expressions_of[source].shape[dimension], size)
    return np.split(expressions_of[source], list(cuts), axis=dimension)


def _unbind(node: fx.Node, expressions_of: Recorded) -> list[Expressions]:
    source: Any = node.args[0]
    return list(np.moveaxis(expressions_of[source], _columns(node, source), 0))


def _getitem(node: fx.Node, expressions_of: Recorded) -> Any:
    source: Any = node.args[0]
    return expressions_of[source][node.args[1]]


def _reshape(node: fx.Node, expressions_of: Recorded) -> Expressions:
    """Returns the same values in another shape, in which vehicles have kept their place."""
    source: Any = node.args[0]
    if _before_vehicles(source.meta["val"]) != _before_vehicles(node.meta["val"]):
        raise Unsupported("an operation that is not elementwise")
    return np.asarray(expressions_of[source]).reshape(shape_of(node.meta["val"]))


def _bmm(node: fx.Node, expressions_of: Recorded) -> Expressions:
    """Returns a product of small matrices of each vehicle, `(V, i, j)` by `(V, j, k)`.

    Sums go on from their first product, as PyTorch's of small matrices do.
    """
    nodes: Any = node.args
    left, right = (expressions_of[factor] for factor in nodes)
    shape = shape_of(node.meta["val"])
    if left.shape[0] != right.shape[0] or len(shape) != 3:
        raise Unsupported("a product of matrices that vehicles share")
    sums = []
    for _, row, column in itertools.product(*map(range, shape)):
        products = [f"{a} * {b}" for a, b in zip(left[0, row], right[0, :, column], strict=True)]
        sums.append(f"({' + '.join(products)})")
    return array(shape, sums)


def _before_vehicles(value: Tensor) -> int | None:
    """Returns how many values lie before the vehicles' dimension; None where there is none."""
    shape = list(value.shape)
    if VEHICLES not in shape:
        return None
    return math.prod(shape[: shape.index(VEHICLES)])


def _gather(node: fx.Node, expressions_of: Recorded) -> Expressions:
    """Returns columns of the model's memory whose numbers are computed.

    A number outside of the memory gives its first or last column; PyTorch would raise an error.

    Raises:
        Unsupported: other values than the memory, or neighbouring columns of it, are asked for.
    """
    source: Any = node.args[0]
    index: Any = node.args[2]
    dimension = _columns(node, source)
    values = expressions_of[source]
    if dimension % values.ndim != values.ndim - 1:
        raise Unsupported("a look-up along another dimension than the last")
    names = list(map(str, values.flat))
    if values.shape[-1] != values.size or not names[0].startswith("memory"):
        raise Unsupported("a look-up in values that are computed")
    first = int(names[0].removeprefix("memory"))
    last = len(names) - 1
    if names != list(memory_names(first + last + 1)[first:]):
        raise Unsupported("a look-up in columns that are not neighbours")
    columns = [f"(RECALLED({first}, {last}, {number}))" for number in expressions_of[index].flat]
    return array(expressions_of[index].shape, columns)


def _constant_columns(index: Any) -> list[int]:
    """Returns the numbers of columns that a constant of the graph lists.

    Raises:
        Unsupported: they are computed.
    """
    while index.op == "call_function" and operation_of(index) == "lift_fresh_copy":
        index = index.args[0]
    if index.op != "get_attr":
        raise Unsupported("a look-up in columns whose numbers are computed")
    numbers: Tensor = getattr(index.graph.owning_module, str(index.target))
    return [int(number) for number in numbers.flatten().tolist()]


def _index(node: fx.Node, expressions_of: Recorded) -> Expressions:
    """Returns some of the last dimension's columns, listed by a constant.

    Raises:
        Unsupported: something else is looked up.
    """
    source: Any = node.args[0]
    indices: Any = node.args[1]
    *before, last = indices
    values = expressions_of[source]
    if any(index is not None for index in before) or len(indices) != values.ndim or not before:
        raise Unsupported("a look-up along another dimension than the last")
    return np.asarray(values[..., _constant_columns(last)])


def _index_copy(node: fx.Node, expressions_of: Recorded) -> Expressions:
    """Returns values with other columns in the last dimension, listed by a constant."""
    arguments: Any = node.args
    source, _, index, written = arguments
    copied = np.array(expressions_of[source])
    if _columns(node, source) % copied.ndim != copied.ndim - 1:
        raise Unsupported("columns written along another dimension than the last")
    copied[..., _constant_columns(index)] = expressions_of[written]
    return copied


MOVES: dict[str, Callable[[fx.Node, Recorded], Any]] = {
    "_unsafe_view": _reshape,
    "arange": _arange,
    "bmm": _bmm,
    "cat": _cat,
    "gather": _gather,
    "getitem": _getitem,
    "index": _index,
    "index_copy": _index_copy,
    "select": _select,
    "slice": _slice,
    "split": _split,
    "squeeze": _reshape,
    "stack": _stack,
    "unbind": _unbind,
    "unsqueeze": _reshape,
    "view": _reshape,
}
"""Operations that move columns about, and what they give."""
