"""A recorded step as a C++ loop: shards of work, then time, then candidates in vector registers.

A shard is one problem with a block of its candidates. All their states stay in the first-level
cache while the leader's frames pass by, and the compiler turns the loop over candidates into vector
instructions: nothing in it depends on another candidate.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence

import torch

from cfx.simulation.kernel.columns import memory_names
from cfx.simulation.kernel.graph import INPUTS, Assignment, StepProgram, parameter_names

BLOCK = 32
"""Candidates of a shard."""

_TYPES = {torch.float64: "double", torch.float32: "float"}

_HEAD = """\
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#ifdef VECTOR_MATH
// glibc computes these for a whole vector register; its headers say so under -ffast-math alone.
extern "C" {{
#define VECTOR __attribute__((simd("notinbranch")))
VECTOR double pow(double, double) noexcept; VECTOR float powf(float, float) noexcept;
VECTOR double exp(double) noexcept; VECTOR float expf(float) noexcept;
VECTOR double log(double) noexcept; VECTOR float logf(float) noexcept;
VECTOR double sin(double) noexcept; VECTOR float sinf(float) noexcept;
VECTOR double cos(double) noexcept; VECTOR float cosf(float) noexcept;
VECTOR double tanh(double) noexcept; VECTOR float tanhf(float) noexcept;
VECTOR double atan(double) noexcept; VECTOR float atanf(float) noexcept;
VECTOR double log1p(double) noexcept; VECTOR float log1pf(float) noexcept;
VECTOR double expm1(double) noexcept; VECTOR float expm1f(float) noexcept;
}}
#endif
using real = {type};
constexpr long BLOCK = {block};
// NaN goes on, as in PyTorch. Two selections and no `||`: a branch would end vector code.
static inline real smaller(real a, real b) {{
  const real least = a < b ? a : b;
  return a != a ? a : least;
}}
static inline real greater(real a, real b) {{
  const real most = a > b ? a : b;
  return a != a ? a : most;
}}
static inline real huber(real error, real delta) {{
  const real size = std::fabs(error);
  return size < delta ? real(0.5) * size * size : delta * (size - real(0.5) * delta);
}}
static inline real without_nan(real a) {{
  const real most = std::numeric_limits<real>::max();
  const real number = a != a ? real(0) : a;
  return smaller(greater(number, -most), most);
}}
// A column of the memory; a number that is none is the first one.
static inline int column(real number, int last) {{
  const real most = real(last), least = number > real(0) ? number : real(0);
  return int(least < most ? least : most);
}}
#define RECALLED(first, last, number) M[(first) + column(number, last)][j]
"""

_ACCUMULATE = """\
struct View { const real* data; long problem; long other; };
extern "C" void accumulate(
    const View* signals, const View* parameters, const View* counted, const long* ends,
    const View* memory, real* sums, long problems, long candidates, long rows, long every,
    const View* gain, long first, long last) {
  const long blocks = (candidates + BLOCK - 1) / BLOCK;
  for (long shard = first; shard < last; ++shard) {
    const long i = shard / blocks, begin = (shard % blocks) * BLOCK;
    const long width = std::min(BLOCK, candidates - begin);
    real X[BLOCK], V[BLOCK], A[BLOCK];
"""


def head(dtype: torch.dtype, block: int) -> str:
    """Returns what stands before every kernel: mathematics, and a few functions of numbers."""
    return _HEAD.format(type=_TYPES[dtype], block=block)


_SIGNALS = (
    "leader_position",
    "leader_speed",
    "leader_acceleration",
    "leader_rear",
    "measured_speed",
    "measured_gap",
)
"""Signals with a frame for each step, in the order of the kernel's views; then those without."""

_CONSTANT_SIGNALS = ("leader_length", "position", "speed", "acceleration")

SIGNALS = (*_SIGNALS, *_CONSTANT_SIGNALS)


def write(
    program: StepProgram,
    varied: Sequence[bool],
    dtype: torch.dtype,
    *,
    summed: bool = True,
    corrected: bool = False,
) -> str:
    """Returns the C++ source of a kernel.

    Args:
        program: the step.
        varied: for each parameter, whether candidates differ in it; the others are numbers.
        dtype: float64 or float32.
        summed: whether terms are summed up over frames; else those of single frames are written.
        corrected: whether states move towards the measured ones after each frame that is written.
    """
    lines = [head(dtype, BLOCK) + _ACCUMULATE]
    shift = _shift(program.memory)
    lines += _begin(varied, len(program.terms), len(program.memory), shift)
    constant = _constant_in_time(program, varied)
    lines += _before(constant, varied)
    lines += _loop(program, varied, shift, constant, summed=summed, corrected=corrected)
    if summed:
        for k in range(len(program.terms)):
            target = f"sums[({k} * problems + i) * candidates + begin + j]"
            lines.append(f"    for (long j = 0; j < width; ++j) {target} = S{k}[j];")
    lines += ["  }", "}"]
    lines.append(f'extern "C" long terms() {{ return {len(program.terms)}; }}')
    return "\n".join(lines) + "\n"


def _shift(memory: Sequence[str]) -> int:
    """Returns by how many columns the memory moves on in a step; 0 if it stays where it is.

    A memory of the last frames takes a frame in at its beginning and moves the others on. To move
    the memory's beginning instead writes one frame, not all.
    """
    names = memory_names(len(memory))
    most_moved, best = 0, 0
    for shift in range(len(memory)):
        # How many columns after the step are those of `shift` columns before.
        moved = sum(map(operator.eq, memory[shift:], names))
        if moved > most_moved:
            most_moved, best = moved, shift
    return best


def _room(width: int, shift: int) -> int:
    """Returns how many columns before a memory are free, before it must be copied to the end."""
    if shift == 0:
        return 0
    return width // shift * shift


def _begin(varied: Sequence[bool], terms: int, width: int, shift: int) -> list[str]:
    """Returns the declarations and first values of a shard's states, sums and parameters."""
    lines = []
    if width:
        room = _room(width, shift)
        lines.append(f"    real columns[{room + width}][BLOCK];")
        lines.append(f"    real (*M)[BLOCK] = columns + {room};")
    for k in range(terms):
        lines.append(f"    real S{k}[BLOCK];")
    for k, name in enumerate(parameter_names(len(varied))):
        if varied[k]:
            lines.append(f"    real {name}s[BLOCK];")
        else:
            lines.append(f"    const real {name} = parameters[{k}].data[0];")
    at = len(_SIGNALS)
    lines.append(f"    const real leader_length = {_at(at)};")
    lines.append("    for (long j = 0; j < BLOCK; ++j) {")
    lines.append("      const long c = begin + std::min(j, width - 1);")
    for array, place in (("X", at + 1), ("V", at + 2), ("A", at + 3)):
        lines.append(f"      {array}[j] = {_at(place)};")
    for k in range(width):
        column = f"i * memory->problem + {k} * memory->other"
        lines.append(f"      M[{k}][j] = memory->data[{column}];")
    for k in range(terms):
        lines.append(f"      S{k}[j] = real(0);")
    for k, name in enumerate(parameter_names(len(varied))):
        if varied[k]:
            view = f"parameters[{k}]"
            lines.append(f"      {name}s[j] = {view}.data[i * {view}.problem + c * {view}.other];")
    lines.append("    }")
    return lines


def _constant_in_time(program: StepProgram, varied: Sequence[bool]) -> list[Assignment]:
    """Returns the statements that depend on parameters alone, such as IDM's 2 sqrt(a b)."""
    constant = set(parameter_names(len(varied)))
    constant_statements = []
    for statement in program.statements:
        names = set()
        for operand in statement.operands:
            if not operand.startswith("real("):  # a number, which is constant anyway
                names.add(operand)
        if names and names <= constant and not statement.is_condition:
            constant.add(statement.name)
            constant_statements.append(statement)
    return constant_statements


def _before(constant: Sequence[Assignment], varied: Sequence[bool]) -> list[str]:
    """Returns the loop over candidates that computes these statements, before that over time."""
    if not constant:
        return []
    lines = [f"    real {statement.name}s[BLOCK];" for statement in constant]
    lines.append("    for (long j = 0; j < BLOCK; ++j) {")
    for k, name in enumerate(parameter_names(len(varied))):
        if varied[k]:
            lines.append(f"      const real {name} = {name}s[j];")
    for statement in constant:
        lines.append(f"      {statement.declaration}")
        lines.append(f"      {statement.name}s[j] = {statement.name};")
    lines.append("    }")
    return lines


def _loop(
    program: StepProgram,
    varied: Sequence[bool],
    shift: int,
    constant: Sequence[Assignment],
    *,
    summed: bool,
    corrected: bool,
) -> list[str]:
    """Returns the loop over time, with the loop over candidates inside."""
    lines = ["    for (long t = 0; t < ends[i]; ++t) {"]
    lines += _turned(len(program.memory), shift)
    for k, name in enumerate(_SIGNALS):
        lines.append(f"      const real {name} = {_at(k, time=True)};")
    lines.append(
        "      const real weight = counted->data[i * counted->problem + t * counted->other];"
    )
    lines.append("      #pragma GCC ivdep")
    lines.append("      for (long j = 0; j < BLOCK; ++j) {")
    lines.append("        const real position = X[j], speed = V[j], acceleration = A[j];")
    for k, name in enumerate(parameter_names(len(varied))):
        if varied[k]:
            lines.append(f"        const real {name} = {name}s[j];")
    names = memory_names(len(program.memory))
    for k, name in enumerate(names):
        lines.append(f"        const real {name} = M[{k}][j];")
    for statement in program.statements:
        line = statement.declaration
        if statement in constant:
            line = f"const real {statement.name} = {statement.name}s[j];"
        lines.append(f"        {line}")
    for k, term in enumerate(program.terms):
        lines.append(f"        const real added{k} = {term};")
    for array, value in zip(("next_x", "next_v", "next_a"), program.state, strict=True):
        lines.append(f"        const real {array} = {value};")
    lines.append("        X[j] = next_x; V[j] = next_v; A[j] = next_a;")
    lines += _added(len(program.terms), summed=summed)
    for k, value in enumerate(program.memory):
        if k < shift or value != names[k - shift]:
            lines.append(f"        N[{k}][j] = {value};")
    lines.append("      }")
    if not summed:
        lines += _written(len(program.terms), corrected=corrected)
    if program.memory:
        lines.append("      M = N;")
    lines.append("    }")
    return lines


def _added(terms: int, *, summed: bool) -> list[str]:
    """Returns the statements that add a frame's terms to their sums, or keep each frame's apart."""
    sign = "="
    if summed:
        sign = "+="
    return [f"        S{k}[j] {sign} added{k} * weight;" for k in range(terms)]


def _written(terms: int, *, corrected: bool) -> list[str]:
    """Returns the statements that write single frames' terms, and correct the states after them."""
    lines = ["      if ((t + 1) % every == 0) {"]
    for k in range(terms):
        row = f"{k} * rows + (t + 1) / every - 1"
        target = f"sums + (({row}) * problems + i) * candidates + begin"
        lines.append(f"        std::memcpy({target}, S{k}, sizeof(real) * width);")
    if corrected:
        gain = "gain->data[i * gain->problem + (begin + j) * gain->other]"
        lines.append("        for (long j = 0; j < width; ++j) {")
        lines.append(f"          const real steady = {gain};")
        lines.append(
            "          const real g = steady + (real(1) - steady) / real((t + 1) / every + 1);"
        )
        lines.append("          X[j] += g * (leader_rear - measured_gap - X[j]);")
        lines.append("          V[j] += g * (measured_speed - V[j]);")
        lines.append("        }")
    lines.append("      }")
    return lines


def _turned(width: int, shift: int) -> list[str]:
    """Returns the statements that set where a step reads the model's memory and writes it."""
    lines = []
    if shift:
        end = f"columns + {_room(width, shift)}"
        size = f"sizeof(real) * {width} * BLOCK"
        lines.append(f"      if (M == columns) {{ std::memmove({end}, M, {size}); M = {end}; }}")
    if width:
        lines.append(f"      real (*N)[BLOCK] = M - {shift};")
    return lines


def _at(view: int, *, time: bool = False) -> str:
    place = f"i * signals[{view}].problem"
    if time:
        place += f" + t * signals[{view}].other"
    return f"signals[{view}].data[{place}]"


assert set(SIGNALS) == set(INPUTS)
