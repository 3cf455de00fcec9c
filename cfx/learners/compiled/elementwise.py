"""Any elementwise function as compiled code, with its adjoint.

What `torch.compile` would make of such a function takes ten times as long here: closed loops keep
frames and columns in the last dimension, which its vector code does not reach.

Shapes: a function of tensors `(V, width)` runs on tensors `(A, B, C, width)` of any strides; those
of 0 broadcast. Vector registers hold neighbours along C.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
from collections.abc import Callable, Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.learners.compiled.adjoint import adjoint
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.recording import Program, record_function
from cfx.simulation.kernel.source import head

_BLOCK = 64
"""Elements that are loaded, computed and stored together, at most."""

_VECTOR = 16
"""Elements of the longest vector registers: 512 bits of single precision."""

_LOADS_AND_STORES = """\
// Of arrays, for networks from the first to the last: A, B and C as in Python.
struct Array { real* data; long a, b, c, column; };
#define CALLED static __attribute__((noinline)) void
CALLED load(real* to, const Array& from, long at, long count) {
  if (!from.data) { std::fill(to, to + BLOCK, real(0)); return; }
  const real* data = from.data + at;
  if (from.c == 1) std::memcpy(to, data, sizeof(real) * count);
  else if (from.c == 0) { std::fill(to, to + BLOCK, *data); return; }
  else for (long j = 0; j < count; ++j) to[j] = data[j * from.c];
  for (long j = count; j < BLOCK; ++j) to[j] = to[0];
}
CALLED store(const real* from, const Array& to, long at, long count) {
  if (!to.data) return;
  real* data = to.data + at;
  if (to.c == 1) std::memcpy(data, from, sizeof(real) * count);
  else for (long j = 0; j < count; ++j) data[j * to.c] = from[j];
}
"""
"""A block is copied into registers' order, computed and copied back. The rest of a last block that
is not full repeats its first element, so that the loop has one length."""

_AT = "a * arrays[k].a + b * arrays[k].b + c * arrays[k].c + n * arrays[k].column"
"""Where column n of array k begins, for the elements from c on."""


class Elementwise:
    """An elementwise function of tensors in single precision, with its adjoint if that is needed.

    Args:
        function: as for `cfx.simulation.kernel.recording.record_function`.
        inputs: widths of its arguments.
        differentiated: numbers of the arguments by which it is differentiated; empty: none.
        key: what the function depends on besides how it is compiled; None: it is recorded anew in
            each process.
        together: elements that are neighbours along C, if there are never more.

    Attributes:
        source: C++.

    Raises:
        Unsupported: it is not elementwise, or no compiler is found.
    """

    def __init__(
        self,
        function: Callable[..., Sequence[Tensor]],
        inputs: Sequence[int],
        differentiated: Collection[int] = (),
        key: object = None,
        together: int = _BLOCK,
    ) -> None:
        vectors = -(-together // _VECTOR)
        block = min(_BLOCK, vectors * _VECTOR)
        lasting = None
        if key is not None:
            code = [folder_hash(__file__), folder_hash(compiler.__file__), torch.__version__]
            lasting = content_key([key, list(inputs), sorted(differentiated), block, *code])

        def source() -> str:
            program = record_function(function, inputs, torch.float32)
            return _source(program, differentiated, block)

        if compiler.find_compiler() is None:
            raise Unsupported("there is no C++ compiler")
        self.source = compiler.remembered(lasting, source)

    @functools.cached_property
    def compiled(self) -> ctypes.CDLL:
        """Functions `forward` and `backward`, as `cfx.learners.compiled.calls` calls them.

        Compiled at the first use; several can be at the same time.

        Raises:
            Unsupported: the compiler fails.
        """
        library = compiler.build_library(self.source)
        if library is None:
            raise Unsupported("the C++ compiler fails")
        return library

    def forward(self, inputs: Sequence[Tensor], *to: Tensor) -> None:
        """Computes the function.

        Args:
            inputs: its arguments, `(A, B, C, width)` each; A, B and C are those of the first.
            to: where its results are written, of the same form.
        """
        self.compiled.forward(_arrays((*inputs, *to)), *_sizes(inputs[0]))

    def backward(
        self, inputs: Sequence[Tensor], gradients: Sequence[Tensor | None], *to: Tensor
    ) -> None:
        """Computes the gradient by the arguments that it is differentiated by.

        Args:
            inputs: the arguments, as for `forward`.
            gradients: by each result; None: 0.
            to: where the gradients by these arguments are written.
        """
        self.compiled.backward(_arrays((*inputs, *gradients, *to)), *_sizes(inputs[0]))


def _sizes(first: Tensor) -> list[ctypes.c_long]:
    """Returns the networks from 0 to A, then B and C, of the first argument."""
    return [ctypes.c_long(size) for size in (0, *first.shape[:3])]


def _arrays(tensors: Sequence[Tensor | None]) -> Any:
    """Returns where tensors lie, and their strides, as the kernel's `Array`s."""
    numbers: list[int] = []
    for tensor in tensors:
        if tensor is None:
            numbers += (0, 0, 0, 0, 0)
        else:
            numbers += (tensor.data_ptr(), *tensor.stride())
    return (ctypes.c_long * len(numbers))(*numbers)


_Places = list[tuple[str, tuple[int, int]]]
"""Names in the C++ source, and the array and the column in which the values of each lie."""


def _source(program: Program, differentiated: Collection[int], block: int) -> str:
    """Returns the C++ source of `forward` and `backward`.

    Arrays stand one behind the other: inputs, results (of which `backward` reads gradients), then
    in `backward` the gradients that it writes.
    """
    inputs = _columns(program.inputs)
    outputs = _columns(program.outputs)
    statements = [statement.declaration for statement in program.statements]

    count = len(program.inputs)
    results, stored = [], []
    gradients: dict[str, list[str]] = {}
    read: _Places = []  # the gradients of the outputs
    for k, (value, (number, column)) in enumerate(outputs):
        results.append(f"out{k}_[j] = {value};")
        stored.append((f"out{k}", (count + number, column)))
        gradients.setdefault(value, []).append(f"g{k}")
        read.append((f"g{k}", (count + number, column)))
    forward = _function("forward", inputs, [*statements, *results], stored)

    names: list[str] = []
    for number in sorted(differentiated):
        names += program.inputs[number]
    declarations, derivatives = adjoint(program.statements, names, gradients)
    first = count + len(program.outputs)
    results, stored = [], []
    for place, number in enumerate(sorted(differentiated)):
        for column, name in enumerate(program.inputs[number]):
            results.append(f"to_{name}_[j] = {derivatives[name]};")
            stored.append((f"to_{name}", (first + place, column)))
    body = [*statements, *declarations, *results]
    backward = _function("backward", [*inputs, *read], body, stored)
    lines = [head(torch.float32, block), _LOADS_AND_STORES, *forward, *backward]
    return "\n".join(lines) + "\n"


def _columns(arrays: Sequence[Sequence[str]]) -> _Places:
    """Returns names with the array and the column in which each stands."""
    places = []
    for number, names in enumerate(arrays):
        for column, name in enumerate(names):
            places.append((name, (number, column)))
    return places


def _function(name: str, loaded: _Places, body: Sequence[str], stored: _Places) -> list[str]:
    """Returns a function that loads, computes and stores."""
    lines = [
        f'extern "C" void {name}(const Array* arrays, long first, long last, long B, long C) {{'
    ]
    for value, _ in itertools.chain(loaded, stored):
        lines.append(f"  real {value}_[BLOCK];")
    lines.append("  for (long a = first; a < last; ++a) for (long b = 0; b < B; ++b)")
    lines.append("  for (long c = 0; c < C; c += BLOCK) {")
    lines.append("    const long count = std::min(BLOCK, C - c);")
    lines.append(f"    #define AT(k, n) {_AT}")
    for value, (k, n) in loaded:
        lines.append(f"    load({value}_, arrays[{k}], AT({k}, {n}), count);")
    lines.append("    #pragma GCC ivdep")
    lines.append("    for (long j = 0; j < BLOCK; ++j) {")
    for value, _ in loaded:
        lines.append(f"      const real {value} = {value}_[j];")
    for line in body:
        lines.append(f"      {line}")
    lines.append("    }")
    for value, (k, n) in stored:
        lines.append(f"    store({value}_, arrays[{k}], AT({k}, {n}), count);")
    lines += ["  }", "}"]
    return lines
