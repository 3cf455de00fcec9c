"""Functions of rows: compiled code and PyTorch write the same into tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.rows import CompiledRows, EagerRows, Rows, row_function

COUNT, TABLE = 150, 200
"""Rows of a call, more than two blocks of them; rows of a table."""


def blended(weight: Tensor, table: Tensor, nothing: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Reads a number for all, a table with columns, one without, and one that it writes again."""
    turned = torch.matmul(moved.view(-1, 1, 2), table[:, :4].view(-1, 2, 2)).squeeze(-2)
    chosen = table[:, torch.tensor([4, 0])].index_copy(-1, torch.tensor([1]), weight)
    last = torch.cat([nothing, turned[:, :1].exp()], -1)
    return turned + chosen, torch.where(weight > 0.5, last, table[:, :1])


def tables() -> tuple[list[Rows], list[Rows]]:
    """Returns what is read and what is written; rows of the middle of tables in another order."""
    generator = torch.Generator().manual_seed(4)
    table = torch.rand((TABLE, 5), generator=generator, dtype=torch.float64)
    moved = torch.rand((2, TABLE), generator=generator, dtype=torch.float64).T
    rows = torch.randperm(TABLE, generator=generator)[:COUNT]
    weight = torch.tensor(0.7, dtype=torch.float64)
    inputs = [Rows(weight), Rows(table, rows), Rows(table[:, :0], rows), Rows(moved, rows)]
    return inputs, [Rows(moved, rows), Rows(torch.full((TABLE,), -1.0, dtype=torch.float64))]


@pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")
def test_compiled_rows_are_those_of_pytorch() -> None:
    written = []
    for function in (CompiledRows(blended, [1, 5, 0, 2]), EagerRows(blended)):
        inputs, outputs = tables()
        function(COUNT, inputs, outputs)
        written.append([output.table.clone() for output in outputs])
    for compiled, eager in zip(*written, strict=True):
        torch.testing.assert_close(compiled, eager, rtol=1e-14, atol=0.0)
    moved, plain = written[0]
    assert bool((plain[COUNT:] == -1.0).all()), "other rows stay"
    untouched, (inputs, _) = tables()[0][3].table, tables()
    others = torch.ones(TABLE, dtype=torch.bool)
    assert inputs[1].rows is not None
    others[inputs[1].rows] = False
    assert torch.equal(moved[others], untouched[others])
    assert not torch.equal(moved, untouched)


def summed(values: Tensor) -> tuple[Tensor]:
    """Is not elementwise: rows depend on one another."""
    return (values - values.mean(0),)


def looked_up(values: Tensor) -> tuple[Tensor]:
    """Looks up columns whose numbers are computed."""
    return (values[:, values[0].long()],)


def along_rows(values: Tensor) -> tuple[Tensor]:
    """Writes rows, not columns."""
    return (values.index_copy(0, torch.tensor([1]), values[:1]),)


@pytest.mark.parametrize("function", [summed, looked_up, along_rows])
def test_pytorch_computes_what_has_no_compiled_code(
    function: Callable[[Tensor], Sequence[Tensor]],
) -> None:
    if compiler.find_compiler() is not None:
        with pytest.raises(Unsupported):
            CompiledRows(function, [2])
    values = torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    expected, to = function(values)[0], torch.zeros((2, 2), dtype=torch.float64)
    row_function(function, [2])(2, [Rows(values)], [Rows(to)])
    assert torch.equal(to, expected)


def test_without_a_compiler_pytorch_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "find_compiler", lambda: None)
    assert isinstance(row_function(blended, [1, 5, 0, 2]), EagerRows)
