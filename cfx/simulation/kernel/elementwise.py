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
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported, literal
from cfx.simulation.kernel.graph import Program, Statement, power, record_function
from cfx.simulation.kernel.source import head

_BLOCK = 64
"""Elements that are loaded, computed and stored together, at most."""

_VECTOR = 16
"""Elements of the longest vector registers."""

_LOOPS = """\
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


class Elementwise:
    """An elementwise function of tensors in single precision, with its adjoint if that is wanted.

    Args:
        function: as for `cfx.simulation.kernel.graph.record_function`.
        inputs: widths of its arguments.
        wanted: numbers of the arguments by which it is differentiated; empty: none.
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
        wanted: Collection[int] = (),
        key: object = None,
        together: int = _BLOCK,
    ) -> None:
        block = min(_BLOCK, -(-together // _VECTOR) * _VECTOR)
        lasting = None
        if key is not None:
            described = [key, list(inputs), sorted(wanted), block, folder_hash(__file__)]
            lasting = content_key([*described, torch.__version__])

        def source() -> str:
            return _written(record_function(function, inputs, torch.float32), wanted, block)

        if compiler.find_compiler() is None:
            raise Unsupported("there is no C++ compiler")
        self.source = compiler.remembered(lasting, source)

    @functools.cached_property
    def compiled(self) -> ctypes.CDLL:
        """Functions `forward` and `backward`, as `cfx.simulation.kernel.sequence` calls them.

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
        """Computes the gradient by the wanted arguments.

        Args:
            inputs: the arguments, as for `forward`.
            gradients: by each result; None: 0.
            to: where the gradients by the wanted arguments are written.
        """
        self.compiled.backward(_arrays((*inputs, *gradients, *to)), *_sizes(inputs[0]))


def _sizes(like: Tensor) -> list[ctypes.c_long]:
    return [ctypes.c_long(size) for size in (0, *like.shape[:3])]


def _arrays(tensors: Sequence[Tensor | None]) -> Any:
    """Returns where tensors lie, and their strides, as the kernel's `Array`s."""
    numbers: list[int] = []
    for tensor in tensors:
        if tensor is None:
            numbers += (0, 0, 0, 0, 0)
        else:
            numbers += (tensor.data_ptr(), *tensor.stride())
    return (ctypes.c_long * len(numbers))(*numbers)


def _written(program: Program, wanted: Collection[int], block: int) -> str:
    """Returns the C++ source of `forward` and `backward`."""
    lines = [head(torch.float32, block), _LOOPS]
    inputs = _columns(program.inputs)
    outputs = _columns(program.outputs)
    body = []
    for one in program.statements:
        kind = "bool" if one.is_condition else "real"
        body.append(f"const {kind} {one.name} = {one.expression};")
    stored = [(f"out{k}", place) for k, (_, place) in enumerate(outputs)]
    results = [f"out{k}_[j] = {value};" for k, (value, _) in enumerate(outputs)]
    count = len(program.inputs)
    lines += _function("forward", inputs, [*body, *results], stored, count)
    gradients: dict[str, list[str]] = {}
    loaded = []
    for k, (value, (number, column)) in enumerate(outputs):
        gradients.setdefault(value, []).append(f"g{k}")
        loaded.append((f"g{k}", (count + number, column)))
    names = [name for number in sorted(wanted) for name in program.inputs[number]]
    more, found = adjoint(program.statements, names, gradients)
    first = count + len(program.outputs)
    stored = []
    for number, own in enumerate(sorted(wanted)):
        for column, name in enumerate(program.inputs[own]):
            more.append(f"to_{name}_[j] = {found[name]};")
            stored.append((f"to_{name}", (first + number, column)))
    lines += _function("backward", [*inputs, *loaded], [*body, *more], stored, 0)
    return "\n".join(lines) + "\n"


_Places = list[tuple[str, tuple[int, int]]]
"""Names, and of which array and column each is."""


def _columns(arrays: Sequence[Sequence[str]]) -> _Places:
    found = []
    for number, names in enumerate(arrays):
        found += [(name, (number, column)) for column, name in enumerate(names)]
    return found


def _function(
    name: str, loaded: _Places, body: Sequence[str], stored: _Places, first: int
) -> list[str]:
    """Returns a function that loads, computes and stores; stored arrays begin at `first`."""
    lines = [
        f'extern "C" void {name}(const Array* arrays, long first, long last, long B, long C) {{'
    ]
    lines += [f"  real {one}_[BLOCK];" for one, _ in itertools.chain(loaded, stored)]
    lines.append("  for (long a = first; a < last; ++a) for (long b = 0; b < B; ++b)")
    lines.append("  for (long c = 0; c < C; c += BLOCK) {")
    lines.append("    const long count = std::min(BLOCK, C - c);")
    lines.append(
        "    #define AT(k, n) a * arrays[k].a + b * arrays[k].b"
        " + c * arrays[k].c + n * arrays[k].column"
    )
    lines += [f"    load({one}_, arrays[{k}], AT({k}, {n}), count);" for one, (k, n) in loaded]
    lines.append("    #pragma GCC ivdep")
    lines.append("    for (long j = 0; j < BLOCK; ++j) {")
    lines += [f"      const real {one} = {one}_[j];" for one, _ in loaded]
    lines += [f"      {line}" for line in body]
    lines.append("    }")
    for one, (k, n) in stored:
        lines.append(f"    store({one}_, arrays[{first + k}], AT({first + k}, {n}), count);")
    lines += ["  }", "}"]
    return lines


_RULES: dict[str, tuple[str, ...]] = {
    "add": ("{g}", "{g}"),
    "sub": ("{g}", "(-{g})"),
    "rsub": ("(-{g})", "{g}"),
    "mul": ("({g} * {1})", "({g} * {0})"),
    "div": ("({g} / {1})", "(-{g} * {r} / {1})"),
    "neg": ("(-{g})",),
    "abs": ("({0} > real(0) ? {g} : {0} < real(0) ? -{g} : real(0))",),
    "sqrt": ("({g} / (real(2) * {r}))",),
    "rsqrt": ("(real(-0.5) * {g} * ({r} * {r} * {r}))",),
    "reciprocal": ("(-{g} * {r} * {r})",),
    "square": ("({g} * (real(2) * {0}))",),
    "exp": ("({g} * {r})",),
    "log": ("({g} / {0})",),
    "log1p": ("({g} / ({0} + real(1)))",),
    "expm1": ("({g} * ({r} + real(1)))",),
    "tanh": ("({g} * (real(1) - {r} * {r}))",),
    "sin": ("({g} * std::cos({0}))",),
    "cos": ("(-{g} * std::sin({0}))",),
    "atan": ("({g} / ({0} * {0} + real(1)))",),
    "_to_copy": ("",),
    "floor": ("",),
    "ceil": ("",),
    "sigmoid": ("({g} * ((real(1) - {r}) * {r}))",),
    "relu": ("({r} > real(0) ? {g} : real(0))",),
    "minimum": (
        "({0} < {1} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
        "({1} < {0} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
    ),
    "maximum": (
        "({0} > {1} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
        "({1} > {0} ? {g} : {0} == {1} ? {g} * real(0.5) : real(0))",
    ),
    "clamp_min": ("({0} >= {1} ? {g} : real(0))", "({0} < {1} ? {g} : real(0))"),
    "clamp_max": ("({0} <= {1} ? {g} : real(0))", "({0} > {1} ? {g} : real(0))"),
    "clamp": (
        "(({0} >= {1}) & ({0} <= {2}) ? {g} : real(0))",
        "(({0} < {1}) & ({1} < {2}) ? {g} : real(0))",
        "(({0} > {2}) | ({1} > {2}) ? {g} : real(0))",
    ),
    "pow": (
        "({1} == real(0) ? real(0) : {g} * ({1} * std::pow({0}, {1} - real(1))))",
        "(({0} == real(0)) & ({1} >= real(0)) ? real(0) : {g} * ({r} * std::log({0})))",
    ),
    "where": ("", "({0} ? {g} : real(0))", "({0} ? real(0) : {g})"),
    "nan_to_num": ("({0} - {0} == real(0) ? {g} : real(0))",),
}
"""What an operation of result {r} adds to the derivative by each operand, {g} being its own.

Each rule is that of PyTorch, also where a function has a kink: `clamp` passes the gradient on at
its bounds, equal operands of `minimum` and `maximum` share it.
"""


def adjoint(
    statements: Sequence[Statement], wanted: Collection[str], gradients: Mapping[str, list[str]]
) -> tuple[list[str], dict[str, str]]:
    """Returns C++ statements behind those of the function, and the derivatives by its inputs.

    Args:
        statements: of the function.
        wanted: the inputs by which it is differentiated.
        gradients: of a number by each result that the function returns; what to add up.

    Returns:
        Declarations in order, and an expression for each wanted input.

    Raises:
        Unsupported: an operation has no rule here.
    """
    active = set(wanted)
    for statement in statements:
        if not statement.is_condition and active.intersection(statement.operands):
            active.add(statement.name)
    parts = {name: list(added) for name, added in gradients.items()}
    lines = []
    for statement in reversed(statements):
        if statement.name not in active or statement.name not in parts:
            continue
        own = f"d_{statement.name}"
        lines.append(f"const real {own} = {' + '.join(parts[statement.name])};")
        for operand, rule in zip(statement.operands, _rules(statement), strict=False):
            if operand in active and rule:
                added = rule.format(*statement.operands, g=own, r=statement.name)
                parts.setdefault(operand, []).append(added)
    return lines, {name: " + ".join(parts.get(name, ["real(0)"])) for name in wanted}


def _rules(statement: Statement) -> tuple[str, ...]:
    operation, _, exponent = statement.operation.partition(" ")
    if exponent:
        value = float(exponent)
        factor = power("{0}", value - 1.0, literal(value - 1.0))
        return (f"({{g}} * ({literal(value)} * {factor}))",)
    if operation not in _RULES:
        raise Unsupported(f"the derivative of {operation or statement.expression}")
    return _RULES[operation]
