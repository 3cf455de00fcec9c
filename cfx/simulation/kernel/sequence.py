"""Calls of compiled code, repeated over the windows of a closed loop without Python in between.

A call reads and writes the slots of tensors that belong to a window: elementwise code, products
with a network's weights, and what bounds gradients. Networks are independent, so each thread takes
some of them through all windows.

Shapes: A networks, B and C trajectories or units, K inputs and G outputs of a product.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported

_COLUMNS = 16
"""Of a product, computed together for a few rows: two vector registers."""

_OPTIONS = ("-O3", "-ffp-contract=fast")
"""Sums of a product stay in registers, and are rounded once for a product and a sum."""

_SOURCE = """\
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>
struct Array { float* data; long a, b, c, column; };
struct Operand { Array first; long step, offset, ring; };
struct Call { long kind; void (*function)(const Array*, long, long, long, long);
              long operand, count, B, C, inner, outer, adds, but; };
enum { ELEMENTWISE, PRODUCT, BOUND, ADD };
typedef float Lane __attribute__((vector_size(32), aligned(4), may_alias));

// R rows of 16 columns of x w.
template <int R> static inline void tile(const float* x, long xs, const float* w, long inner,
                                         float* out, long os, long width, bool adds) {
  Lane low[R] = {}, high[R] = {};
  for (long k = 0; k < inner; ++k, w += 16) {
    const Lane l = *(const Lane*)w, h = *(const Lane*)(w + 8);
    for (int r = 0; r < R; ++r) {
      const float one = x[r * xs + k];
      low[r] += one * l;
      high[r] += one * h;
    }
  }
  for (int r = 0; r < R; ++r, out += os) {
    if (width == 16) {
      Lane* to = (Lane*)out;
      to[0] = adds ? to[0] + low[r] : low[r];
      to[1] = adds ? to[1] + high[r] : high[r];
    } else for (long j = 0; j < width; ++j) {
      const float one = j < 8 ? low[r][j] : high[r][j - 8];
      out[j] = adds ? out[j] + one : one;
    }
  }
}
static void product(const Array& x, const Array& to, const Array& w, long n, const Call& call) {
  const long rows = call.C, inner = call.inner, outer = call.outer;
  for (long g = 0; g < outer; g += 16) {
    const float* panel = w.data + n * w.a + g * inner;
    const long width = std::min(16L, outer - g);
    long r = 0;
    const auto at = [&] { return x.data + n * x.a + r * x.c; };
    const auto out = [&] { return to.data + n * to.a + r * to.c + g; };
    for (; r + 6 <= rows; r += 6) tile<6>(at(), x.c, panel, inner, out(), to.c, width, call.adds);
    for (; r + 2 <= rows; r += 2) tile<2>(at(), x.c, panel, inner, out(), to.c, width, call.adds);
    for (; r < rows; ++r) tile<1>(at(), x.c, panel, inner, out(), to.c, width, call.adds);
  }
}
// Without NaN and infinity, scaled and clipped; or one added to another.
static void each(const Array* of, long begin, long end, const Call& call) {
  for (long n = begin; n < end; ++n) for (long b = 0; b < call.B; ++b)
  for (long k = 0; k < call.outer; ++k) {
    float* to = of[0].data + n * of[0].a + b * of[0].b + k * of[0].column;
    const float* by = of[1].data + n * of[1].a + b * of[1].b + k * of[1].column;
    if (call.kind == ADD) {
      for (long c = 0; c < call.C; ++c) to[c * of[0].c] += by[c * of[1].c];
      continue;
    }
    const float scale = of[1].data[0], most = of[1].data[1];
    for (long c = 0; c < call.C; ++c) {
      float one = to[c * of[0].c];
      one = (one - one == 0 ? one : 0) * scale;
      to[c * of[0].c] = std::min(std::max(one, -most), most);
    }
  }
}
extern "C" void run(const Call* calls, long count, const Operand* operands, long first, long last,
                    long way, long begin, long end) {
  std::vector<Array> arrays;
  for (long window = first; window != last; window += way)
  for (const Call* call = calls; call < calls + count; ++call) {
    if (call->but == window) continue;
    arrays.clear();
    for (const Operand* one = operands + call->operand; long(arrays.size()) < call->count; ++one) {
      arrays.push_back(one->first);
      if (one->step) arrays.back().data += (window + one->offset) % one->ring * one->step;
    }
    if (call->kind == ELEMENTWISE) call->function(arrays.data(), begin, end, call->B, call->C);
    else if (call->kind == PRODUCT)
      for (long n = begin; n < end; ++n) product(arrays[0], arrays[1], arrays[2], n, *call);
    else each(arrays.data(), begin, end, *call);
  }
}
"""

_ELEMENTWISE, _PRODUCT, _BOUND, _ADD = range(4)


class Operand(NamedTuple):
    """A tensor that calls find in the slot of a window.

    Attributes:
        first: what stands in its first slot, `(A, B, C, width)`, of any strides.
        step: elements from slot to slot; 0: the same in all windows.
        offset: the slot of window 0.
        ring: slots, the first of which follows upon the last.
    """

    first: Tensor
    step: int = 0
    offset: int = 0
    ring: int = 1

    @classmethod
    def over(cls, slots: Tensor, offset: int = 0) -> Operand:
        """Returns the operand of slots `(slots, A, B, C, width)`."""
        return cls(slots[0], slots.stride(0), offset, len(slots))

    def only(self, columns: slice) -> Operand:
        """Returns some of the columns."""
        return self._replace(first=self.first[..., columns])


class Calls:
    """Calls of one window, in order.

    Raises:
        Unsupported: there is no C++ compiler.
    """

    def __init__(self) -> None:
        library = compiler.build_library(_SOURCE, *_OPTIONS)
        if library is None:
            raise Unsupported("there is no C++ compiler")
        self._run = library.run
        self._calls: list[int] = []
        self._operands: list[int] = []
        self._kept: list[Tensor] = []

    def elementwise(self, function: Any, operands: Sequence[Operand | None]) -> None:
        """Adds elementwise code, a function of `cfx.simulation.kernel.elementwise`.

        Args:
            function: what is called.
            operands: its arguments and results, `(A, B, C, width)` each; None: zeros. A, B and C
                are those of the first.
        """
        address = ctypes.cast(function, ctypes.c_void_p).value
        self._add(_ELEMENTWISE, operands, function=address or 0)

    def product(self, given: Operand, weights: Tensor, to: Operand, *, adds: bool = False) -> None:
        """Adds a product of rows with each network's weights.

        Args:
            given: `(A, 1, C, K)`, columns side by side.
            weights: `(A, K, G)`.
            to: `(A, 1, C, G)`, columns side by side.
            adds: whether the product is added to what stands there.
        """
        inner, outer = weights.shape[1:]
        padded = pad(weights, (0, -outer % _COLUMNS))
        panels = torch.unflatten(padded, -1, (-1, _COLUMNS)).transpose(1, 2).contiguous()
        packed = Operand(panels.flatten(1)[:, None, None])
        self._add(_PRODUCT, (given, to, packed), inner=inner, outer=outer, adds=adds)

    def bound(self, gradient: Operand, scale: float, most: float, *, but: int) -> None:
        """Adds what scales a gradient and clips it; NaN and infinity become 0.

        Args:
            gradient: changed in place.
            scale: factor.
            most: largest absolute value.
            but: a window without it.
        """
        limits = Operand(gradient.first.new_tensor([scale, most]).expand(1, 1, 1, 2))
        self._add(_BOUND, (gradient, limits), outer=gradient.first.shape[-1], but=but)

    def add(self, to: Operand, what: Operand) -> None:
        """Adds what adds one operand to another."""
        self._add(_ADD, (to, what), outer=to.first.shape[-1])

    def run(self, windows: range, networks: slice) -> None:
        """Makes all calls for some networks, window by window.

        It holds no lock of Python's.
        """
        if len(windows) == 0 or not self._calls:
            return
        calls = (ctypes.c_long * len(self._calls))(*self._calls)
        operands = (ctypes.c_long * len(self._operands))(*self._operands)
        last = windows.start + len(windows) * windows.step
        numbers = (windows.start, last, windows.step, networks.start, networks.stop)
        count = ctypes.c_long(len(self._calls) // _CALL)
        self._run(calls, count, operands, *(ctypes.c_long(number) for number in numbers))

    def _add(
        self,
        kind: int,
        operands: Sequence[Operand | None],
        *,
        function: int = 0,
        inner: int = 0,
        outer: int = 0,
        adds: bool = False,
        but: int = -1,
    ) -> None:
        first = operands[0]
        assert first is not None
        sizes = first.first.shape[1:3]
        at = len(self._operands) // _OPERAND
        self._calls += (kind, function, at, len(operands), *sizes, inner, outer, int(adds), but)
        for one in operands:
            if one is None:
                self._operands += (0,) * _OPERAND
                continue
            tensor = one.first
            self._operands += (tensor.data_ptr(), *tensor.stride(), one.step, one.offset, one.ring)
            self._kept.append(tensor)


_CALL, _OPERAND = 10, 8
"""Numbers of a `Call` and of an `Operand`."""
