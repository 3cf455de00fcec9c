"""Elementwise functions of rows of tables, as compiled code: what is computed of many vehicles.

Drivers that live in other programs keep their state in tables, a row for each vehicle. A step of
them is some hundred elementwise operations; for a hundred vehicles PyTorch takes longer to begin an
operation than to compute it. Here the operations of a step are one loop over the vehicles, recorded
from the same function of tensors.

Shapes: a function of tensors `(D, width)` runs on D rows of tables `(C, width)`.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.recording import Program, record_function
from cfx.simulation.kernel.source import head

log = logging.getLogger(__name__)

_BLOCK = 64
"""Rows that are loaded, computed and stored together."""

_TABLES = """\
// A table (C, width): where it lies, and its strides. Row j of a call is row rows[j] of the table,
// or row j where there are none.
struct Table { real* data; long row; long column; const long* rows; };
#define CALLED static __attribute__((noinline)) void
CALLED load(real* to, const Table& table, long n, long first, long count) {
  const real* data = table.data + n * table.column;
  const long* rows = table.rows + first;
  if (table.rows) for (long j = 0; j < count; ++j) to[j] = data[rows[j] * table.row];
  else for (long j = 0; j < count; ++j) to[j] = data[(first + j) * table.row];
  for (long j = count; j < BLOCK; ++j) to[j] = to[0];
}
CALLED store(const real* from, const Table& table, long n, long first, long count) {
  real* data = table.data + n * table.column;
  const long* rows = table.rows + first;
  if (table.rows) for (long j = 0; j < count; ++j) data[rows[j] * table.row] = from[j];
  else for (long j = 0; j < count; ++j) data[(first + j) * table.row] = from[j];
}
"""
"""A block is gathered column by column, so that the loop that computes has vector registers full of
rows. The rest of a last block that is not full repeats its first row: the loop has one length."""


class Rows(NamedTuple):
    """D rows of a table.

    Attributes:
        table: `(C, width)`, or `(C,)` of one column, of any strides; `()`: the same in all rows.
            Double precision.
        rows: which of them, `(D,)` int64, each once where they are written; None: the first D.
    """

    table: Tensor
    rows: Tensor | None = None

    def values(self, count: int) -> Tensor:
        """Returns the rows, `(D, width)`."""
        if self.table.dim() == 0:
            return self.table.expand(count, 1)
        chosen = self.table[:count] if self.rows is None else self.table[self.rows]
        return chosen.reshape(count, -1)


class RowFunction(Protocol):
    """An elementwise function of rows of tables, in double precision."""

    def __call__(self, count: int, inputs: Sequence[Rows], outputs: Sequence[Rows]) -> None:
        """Computes the function of some rows.

        Args:
            count: D.
            inputs: its arguments.
            outputs: where its results are written; also tables that inputs are.
        """


class CompiledRows:
    """A function of rows as compiled code.

    Args:
        function, widths, key: as for `row_function`.

    Raises:
        Unsupported: it is not elementwise, or there is no C++ compiler.
    """

    def __init__(
        self, function: Callable[..., Sequence[Tensor]], widths: Sequence[int], key: object = None
    ) -> None:
        self._used, used_widths = [], []
        for number, width in enumerate(widths):
            if width > 0:  # an empty table has no memory that C++ could read
                self._used.append(number)
                used_widths.append(width)
        lasting = None
        if key is not None:
            lasting = content_key([key, list(widths), folder_hash(__file__), torch.__version__])

        def of_used(*values: Tensor) -> Sequence[Tensor]:
            arguments = [values[0][..., :0]] * len(widths)
            for number, value in zip(self._used, values, strict=True):
                arguments[number] = value
            return function(*arguments)

        def source() -> str:
            return _source(record_function(of_used, used_widths, torch.float64))

        if compiler.find_compiler() is None:
            raise Unsupported("there is no C++ compiler")
        library = compiler.build_library(compiler.remembered(lasting, source))
        if library is None:
            raise Unsupported("the C++ compiler fails")
        self._run = library.run

    def __call__(self, count: int, inputs: Sequence[Rows], outputs: Sequence[Rows]) -> None:
        used_inputs = [inputs[number] for number in self._used]
        numbers: list[int] = []  # of each table its address, its strides and its rows' address
        for table, rows in (*used_inputs, *outputs):
            assert table.dtype == torch.float64
            numbers += (table.data_ptr(), *_strides(table), 0 if rows is None else rows.data_ptr())
        self._run((ctypes.c_long * len(numbers))(*numbers), ctypes.c_long(count))


class EagerRows:
    """A function of rows that PyTorch computes, operation by operation: the twin of compiled code.

    Args:
        function: as for `row_function`.
    """

    def __init__(self, function: Callable[..., Sequence[Tensor]]) -> None:
        self._function = function

    def __call__(self, count: int, inputs: Sequence[Rows], outputs: Sequence[Rows]) -> None:
        results = self._function(*(argument.values(count) for argument in inputs))
        for (table, rows), result in zip(outputs, results, strict=True):
            where = slice(count) if rows is None else rows
            table[where] = result.reshape(count, *table.shape[1:])


def row_function(
    function: Callable[..., Sequence[Tensor]], widths: Sequence[int], key: object = None
) -> RowFunction:
    """Returns an elementwise function of rows: compiled, or by PyTorch where it cannot be.

    Both round each operation alike, but exponentials, logarithms and powers are not the same in
    their last bits.

    Args:
        function: pure, of tensors `(D, width)` in double precision; returns such tensors.
        widths: of its arguments; a table with no column is given as `(D, 0)`.
        key: what the function depends on, as JSON knows it, so that other processes find its code;
            None: it is recorded anew, which takes seconds.
    """
    try:
        return CompiledRows(function, widths, key)
    except Unsupported as reason:
        log.info("A step has no compiled code (%s); PyTorch takes it", reason)
        return EagerRows(function)


def _strides(table: Tensor) -> tuple[int, int]:
    """Returns a table's strides over rows and columns."""
    if table.dim() == 0:
        return 0, 0
    if table.dim() == 1:
        return table.stride(0), 0
    return table.stride(0), table.stride(1)


def _source(program: Program) -> str:
    """Returns the C++ source; tables stand one behind the other, inputs and then outputs."""
    loaded, stored = [], []
    lines = []
    for number, names in enumerate(program.inputs):
        for column, name in enumerate(names):
            lines.append(f"  real {name}_[BLOCK];")
            loaded.append(f"    load({name}_, tables[{number}], {column}, first, count);")
    body = [f"      const real {name} = {name}_[j];" for name in itertools.chain(*program.inputs)]
    body += [f"      {statement.declaration}" for statement in program.statements]
    for number, expressions in enumerate(program.outputs):
        for column, expression in enumerate(expressions):
            name = f"out{number}_{column}_"
            place = len(program.inputs) + number
            lines.append(f"  real {name}[BLOCK];")
            body.append(f"      {name}[j] = {expression};")
            stored.append(f"    store({name}, tables[{place}], {column}, first, count);")
    begin = [
        'extern "C" void run(const Table* tables, long rows) {',
        *lines,
        "  for (long first = 0; first < rows; first += BLOCK) {",
        "    const long count = std::min(BLOCK, rows - first);",
    ]
    loop = ["    #pragma GCC ivdep", "    for (long j = 0; j < BLOCK; ++j) {", *body, "    }"]
    text = [head(torch.float64, _BLOCK), _TABLES, *begin, *loaded, *loop, *stored, "  }", "}"]
    return "\n".join(text) + "\n"
