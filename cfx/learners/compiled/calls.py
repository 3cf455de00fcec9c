"""Calls of compiled code, repeated over the windows of a closed loop without Python in between.

A call reads and writes the slots of tensors that belong to a window: elementwise code, products
with a network's weights, and what bounds gradients (`calls.cpp`). Networks are independent, so each
thread takes some of them through all windows.

Shapes: A networks, B and C trajectories or units, K inputs and G outputs of a product.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported

_COLUMNS = 16
"""Of a product, computed together for a few rows: two vector registers (`tile` in `calls.cpp`)."""

_OPTIONS = ("-O3", "-ffp-contract=fast")
"""Sums of a product stay in registers, and are rounded once for a product and a sum."""

_SOURCE = Path(__file__).with_suffix(".cpp").read_text(encoding="utf-8")

_ELEMENTWISE, _PRODUCT, _BOUND, _ADD = range(4)
"""Kinds of a call, as `calls.cpp` numbers them."""

_CALL, _OPERAND = 10, 8
"""Numbers of a `Call` and of an `Operand` in `calls.cpp`, all of them as long as a pointer."""


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
        self._tensors: list[Tensor] = []
        """Whose memory the calls read and write: it must not be freed before `run`."""

    def elementwise(self, function: Any, operands: Sequence[Operand | None]) -> None:
        """Adds elementwise code, a function of `cfx.learners.compiled.elementwise`.

        Args:
            function: what is called.
            operands: its arguments and results, `(A, B, C, width)` each; None: zeros. A, B and C
                are those of the first.
        """
        address = ctypes.cast(function, ctypes.c_void_p).value
        self._add(_ELEMENTWISE, operands, function=address or 0)

    def product(
        self, rows: Operand, weights: Tensor, to: Operand, *, accumulates: bool = False
    ) -> None:
        """Adds a product of rows with each network's weights.

        Args:
            rows: `(A, 1, C, K)`, columns side by side.
            weights: `(A, K, G)`.
            to: `(A, 1, C, G)`, columns side by side.
            accumulates: whether the product is added to what stands there.
        """
        inner, outer = weights.shape[1:]
        # Panels of 16 columns, (A, K, G) -> (A, G / 16, K, 16): a product reads a panel row by row,
        # so that its weights lie side by side in memory.
        padded = pad(weights, (0, -outer % _COLUMNS))
        panels = torch.unflatten(padded, -1, (-1, _COLUMNS)).transpose(1, 2).contiguous()
        packed = Operand(panels.flatten(1)[:, None, None])
        operands = (rows, to, packed)
        self._add(_PRODUCT, operands, inner=inner, outer=outer, accumulates=accumulates)

    def bound(self, gradient: Operand, scale: float, largest: float, *, except_window: int) -> None:
        """Adds a call that scales and clips a gradient; NaN and infinity become 0.

        Args:
            gradient: changed in place.
            scale: factor.
            largest: absolute value.
            except_window: a window without it.
        """
        limits = Operand(gradient.first.new_tensor([scale, largest]).expand(1, 1, 1, 2))
        outer = gradient.first.shape[-1]
        self._add(_BOUND, (gradient, limits), outer=outer, except_window=except_window)

    def add(self, to: Operand, added: Operand) -> None:
        """Adds a call that adds one operand to another."""
        self._add(_ADD, (to, added), outer=to.first.shape[-1])

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
        accumulates: bool = False,
        except_window: int = -1,
    ) -> None:
        """Writes a `Call` and its `Operand`s, number by number as their fields stand in C++."""
        first = operands[0]
        assert first is not None
        sizes = first.first.shape[1:3]
        at = len(self._operands) // _OPERAND
        self._calls += (kind, function, at, len(operands))
        self._calls += (*sizes, inner, outer, int(accumulates), except_window)
        for operand in operands:
            if operand is None:
                self._operands += (0,) * _OPERAND
                continue
            tensor = operand.first
            self._operands += (tensor.data_ptr(), *tensor.stride())
            self._operands += (operand.step, operand.offset, operand.ring)
            self._tensors.append(tensor)
