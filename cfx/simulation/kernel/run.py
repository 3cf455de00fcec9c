"""Feeds a kernel with tensors and spreads its work over cores.

Shapes: P problems (segments of trajectories), q candidates of each, K steps of the longest segment.
"""

from __future__ import annotations

import ctypes
import logging
import os
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.models.base import DrivingModel
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.graph import Unsupported, record
from cfx.simulation.kernel.source import BLOCK, SIGNALS, write
from cfx.simulation.trajectory import Segments, Terms

log = logging.getLogger(__name__)

_UNITS_AT_ONCE = 64
"""Units of work that a thread takes at a time."""


class _View(ctypes.Structure):
    """A tensor as the kernel sees it: where it lies, and its strides over problems and the rest."""

    _fields_ = (("data", ctypes.c_void_p), ("problem", ctypes.c_long), ("other", ctypes.c_long))


_KERNELS: dict[Hashable, _Kernel | None] = {}


class _Kernel(NamedTuple):
    function: Any
    terms: int


def accumulate(
    model: DrivingModel,
    dt: float,
    segments: Segments,
    p: Mapping[str, Tensor],
    terms: Terms,
    *,
    key: Hashable,
    cores: int | None = None,
) -> tuple[Tensor, ...] | None:
    """Simulates segments in closed loop and sums up the terms of their frames that count.

    Args:
        model: the driving model.
        dt: time step, s.
        segments: P segments, on the CPU.
        p: one tensor per parameter, `()`, or broadcasting to `(P, q)`.
        terms: what a frame adds to each sum.
        key: names model, settings and terms; equal keys share a kernel.
        cores: threads at most; None: one for each core. The result does not depend on it.

    Returns:
        Each sum, `(P, q)`; None where no kernel can be made of this model.
    """
    kernel = _kernel(model, dt, p, terms, key)
    if kernel is None:
        return None
    shape = torch.broadcast_shapes(  # type: ignore[no-untyped-call]  # torch leaves it untyped
        (len(segments.speed), 1), *[value.shape for value in p.values()]
    )
    sums = segments.speed.new_empty((kernel.terms, *shape))
    _run(kernel, segments, list(p.values()), sums, cores or _available())
    return tuple(sums)


def exists(
    model: DrivingModel, dt: float, p: Mapping[str, Tensor], terms: Terms, *, key: Hashable
) -> bool:
    """Says whether `accumulate` has a kernel for these arguments; makes it at the first call."""
    return _kernel(model, dt, p, terms, key) is not None


def _kernel(
    model: DrivingModel, dt: float, p: Mapping[str, Tensor], terms: Terms, key: Hashable
) -> _Kernel | None:
    """Returns the kernel for a model and an objective, made at the first call."""
    names, varied = tuple(p), tuple(value.dim() > 0 for value in p.values())
    dtype = next(iter(p.values())).dtype
    full_key = (key, dt, names, varied, dtype)
    if full_key not in _KERNELS:
        _KERNELS[full_key] = _made(model, dt, names, varied, terms, dtype)
    return _KERNELS[full_key]


def _made(
    model: DrivingModel,
    dt: float,
    names: Sequence[str],
    varied: Sequence[bool],
    terms: Terms,
    dtype: torch.dtype,
) -> _Kernel | None:
    if compiler.find_compiler() is None:
        return None
    try:
        program = record(model, names, dt, terms, dtype)
    except Unsupported as reason:
        log.info(
            "%s has no compiled kernel (%s); PyTorch simulates it", type(model).__name__, reason
        )
        return None
    library = compiler.build(write(program, varied, dtype))
    if library is None:
        return None
    return _Kernel(library.accumulate, len(program.terms))


def _run(
    kernel: _Kernel, segments: Segments, parameters: Sequence[Tensor], sums: Tensor, cores: int
) -> None:
    _, problems, candidates = sums.shape
    ends = _ends(segments.counted)
    signals = []
    for name in SIGNALS:
        signals.append(_signal(getattr(segments, name)))
    views = (_View * len(signals))(*signals)
    values = [_parameter(value, problems, candidates) for value in parameters]
    parameter_views = (_View * len(values))(*values)
    counted = _signal(segments.counted)
    units = problems * -(-candidates // BLOCK)

    def take(first: int) -> None:
        kernel.function(
            views,
            parameter_views,
            ctypes.byref(counted),
            ctypes.c_void_p(ends.data_ptr()),
            ctypes.c_void_p(sums.data_ptr()),
            ctypes.c_long(problems),
            ctypes.c_long(candidates),
            ctypes.c_long(first),
            ctypes.c_long(min(first + _UNITS_AT_ONCE, units)),
        )

    firsts = range(0, units, _UNITS_AT_ONCE)
    if cores == 1 or len(firsts) == 1:
        for first in firsts:
            take(first)
        return
    # A call of the kernel holds no lock of Python's; threads that have nothing to do sleep.
    with ThreadPoolExecutor(min(cores, len(firsts))) as pool:
        for _ in pool.map(take, firsts):
            pass


def _ends(counted: Tensor) -> Tensor:
    """Returns the steps of each segment up to the last frame that counts, `(P,)` int64."""
    number = torch.arange(1, len(counted) + 1, device=counted.device)[:, None]
    return torch.where(counted > 0, number, 0).amax(0).contiguous()


def _signal(value: Tensor) -> _View:
    """Returns a view of a signal `(K, P)`, or of values `(P,)`."""
    if value.dim() == 1:
        return _View(value.data_ptr(), value.stride(0), 0)
    return _View(value.data_ptr(), value.stride(1), value.stride(0))


def _parameter(value: Tensor, problems: int, candidates: int) -> _View:
    if value.dim() == 0:
        return _View(value.data_ptr(), 0, 0)
    whole = value.expand(problems, candidates)
    return _View(whole.data_ptr(), whole.stride(0), whole.stride(1))


def _available() -> int:
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
