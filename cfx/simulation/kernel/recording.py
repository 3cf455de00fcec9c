"""An elementwise function of tensors with columns, recorded as C++ expressions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.simulation.kernel.columns import Unsupported, operation_of
from cfx.simulation.kernel.graph import Assignment, Recording, traced


class Program(NamedTuple):
    """An elementwise function, as C++ expressions over the columns of its inputs.

    Attributes:
        inputs: names of the columns of each input.
        statements: in order.
        outputs: expressions of the columns of each output.
    """

    inputs: tuple[tuple[str, ...], ...]
    statements: tuple[Assignment, ...]
    outputs: tuple[tuple[str, ...], ...]


def record_function(
    function: Callable[..., Sequence[Tensor]], widths: Sequence[int], dtype: torch.dtype
) -> Program:
    """Records an elementwise function of tensors `(V, width)`.

    Args:
        function: pure; returns such tensors.
        widths: of its arguments, at least 1 each.
        dtype: of all values.

    Raises:
        Unsupported: as `record`.
    """
    # Imported here: PyTorch's decompositions take seconds.
    from torch._decomp import get_decompositions

    names: list[tuple[str, ...]] = []
    for number, width in enumerate(widths):
        names.append(tuple(f"in{number}_{column}" for column in range(width)))

    def of_columns(*values: Tensor) -> Sequence[Tensor]:
        """Calls the function on tables put together from columns, each an input of its own."""
        arguments, first = [], 0
        for width in widths:
            arguments.append(torch.stack(values[first : first + width], -1))
            first += width
        return function(*arguments)

    # These are not elementwise operations of their own, but made of some.
    composed = (torch.ops.aten.logit, torch.ops.aten.lerp, torch.ops.aten.std)
    decompositions: Any = get_decompositions(composed)
    columns = list(itertools.chain(*names))
    graph = traced(of_columns, len(columns), dtype, decompositions)
    for node in graph.nodes:
        if operation_of(node) == "detach":
            raise Unsupported("a gradient that is cut")
    statements, outputs = Recording(columns).function(graph)
    return Program(tuple(names), statements, outputs)
