"""Feeds a kernel with tensors and spreads its work over cores.

Shapes: P problems (segments of trajectories), q candidates of each, K steps of the longest segment.
"""

from __future__ import annotations

import ctypes
import inspect
import logging
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.core.memory import keep_freed_memory
from cfx.core.threads import share
from cfx.models.base import DrivingModel
from cfx.simulation import step
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.graph import record, record_terms
from cfx.simulation.kernel.source import BLOCK, SIGNALS, write
from cfx.simulation.trajectory import ComponentKey, Segments, Terms, common_shape

log = logging.getLogger(__name__)

_SHARDS_AT_ONCE = 64
"""Shards (a problem with a block of its candidates) that a thread takes at a time."""


class _TensorView(ctypes.Structure):
    """A tensor as the kernel sees it: where it lies, and its strides over problems and the rest."""

    _fields_ = (("data", ctypes.c_void_p), ("problem", ctypes.c_long), ("other", ctypes.c_long))


class KernelKey(NamedTuple):
    """Key of a kernel.

    Attributes:
        model: the driving model.
        temperature: of the model.
        terms: what the terms depend on; a name that only this process understands otherwise.
        dt: time step, s.
        parameters: names of the model's parameters, and whether candidates differ in each.
        dtype: of all values.
        summed: whether terms are summed up over frames.
        corrected: whether states are corrected by measured ones.
    """

    model: ComponentKey
    temperature: float
    terms: ComponentKey | str
    dt: float
    parameters: tuple[tuple[str, bool], ...]
    dtype: torch.dtype
    summed: bool = True
    corrected: bool = False

    def lasting(self) -> str | None:
        """Returns a key that other processes agree on; None if there is none.

        Classes made inside functions have none: what they do may depend on variables there.
        """
        if isinstance(self.terms, str):
            return None
        # The step itself, and how it is recorded and written.
        described: list[object] = [folder_hash(step.__file__), folder_hash(__file__)]
        for key in (self.model, self.terms):
            code = component_code(key.component)
            if code is None:
                return None
            described.append([code, key.settings])
        described += [self.temperature, self.dt, self.parameters, self.dtype, self.summed]
        described.append(self.corrected)
        described.append(torch.__version__)
        return content_key(described)


def component_code(component: type) -> list[str] | None:
    """Returns the name and the code of a class and all that it inherits from.

    It is None where no file has it.
    """
    if getattr(component, "process_code", ""):
        return None
    names_and_code = []
    for ancestor in component.__mro__:
        if ancestor.__module__ in {"abc", "builtins", "typing"}:
            continue
        if "<locals>" in ancestor.__qualname__:
            return None
        try:
            code = folder_hash(inspect.getfile(ancestor))
        except (OSError, TypeError):
            return None
        names_and_code.append(f"{ancestor.__module__}.{ancestor.__qualname__} {code}")
    return names_and_code


def step_key(model: DrivingModel) -> list[object] | None:
    """Returns what a step of a model depends on, as JSON knows it, for `row_function`.

    It is None where other processes could not know it, as of a class made inside a function.
    """
    code = component_code(type(model))
    if code is None:
        return None
    return [code, model.identity(), folder_hash(step.__file__)]


_KERNELS: dict[KernelKey, _Kernel | None] = {}
_MAKING = threading.Lock()


class _Kernel(NamedTuple):
    function: Any
    terms: int


def accumulate(
    model: DrivingModel,
    dt: float,
    segments: Segments,
    p: Mapping[str, Tensor],
    terms: Terms,
    every: int | None = None,
    gain: Tensor | None = None,
) -> tuple[Tensor, ...] | None:
    """Simulates segments in closed loop and computes the terms of their frames that count.

    The work is shared among threads; the result does not depend on their number.

    Args:
        model: the driving model.
        dt: time step, s.
        segments: P segments, on the CPU.
        p: one tensor per parameter, `()`, or broadcasting to `(P, q)`.
        terms: what a frame adds to each sum.
        every: the terms of each so many-th frame, instead of sums.
        gain: by which share g of the way position and speed move to the measured ones after each of
            these frames in the end, `(P, q)`, in the dtype of the segments: g + (1 - g) / (t + 1)
            after the t-th, as the state at the start was measured once. None: not at all.

    Returns:
        Each sum, `(P, q)`, or each term of frames `every`, `2 every` and so on, `(K // every, P,
        q)`, 0 where a frame does not count; None where no kernel can be made of this model.
    """
    kernel = _kernel(model, dt, p, terms, summed=every is None, corrected=gain is not None)
    if kernel is None:
        return None
    keep_freed_memory()
    shapes: list[tuple[int, ...]] = [(len(segments.speed), 1)]
    for value in p.values():
        shapes.append(value.shape)
    shape = common_shape(shapes)
    memory = model.initial_memory(segments.speed).contiguous()
    if every is None:
        sums = segments.speed.new_empty((kernel.terms, *shape))
        rows = ctypes.c_long(0), ctypes.c_long(1)
    else:
        # Not all segments last K steps.
        count = len(segments.counted) // every
        sums = segments.speed.new_zeros((kernel.terms, count, *shape))
        rows = ctypes.c_long(count), ctypes.c_long(every)
    corrections = gain if gain is None else _parameter(gain, *shape)
    _run(kernel, segments, list(p.values()), memory, sums, (*rows, corrections))
    return tuple(sums)


def exists(model: DrivingModel, dt: float, p: Mapping[str, Tensor], terms: Terms) -> bool:
    """Says whether `accumulate` has a kernel for these arguments; makes it at the first call."""
    return _kernel(model, dt, p, terms) is not None


def model_key(model: DrivingModel) -> ComponentKey:
    """Returns what a model's equations depend on; its parameters are inputs of them."""
    return ComponentKey(type(model), model.equations_key())


def _kernel(
    model: DrivingModel,
    dt: float,
    p: Mapping[str, Tensor],
    terms: Terms,
    *,
    summed: bool = True,
    corrected: bool = False,
) -> _Kernel | None:
    """Returns the kernel for a model and an objective, made at the first call."""
    varied = [(name, value.dim() > 0) for name, value in p.items()]
    key = KernelKey(
        model=model_key(model),
        temperature=float(model.temperature),
        terms=terms.key,
        dt=dt,
        parameters=tuple(varied),
        dtype=next(iter(p.values())).dtype,
        summed=summed,
        corrected=corrected,
    )
    with _MAKING:
        if key not in _KERNELS:
            _KERNELS[key] = _made(model, terms, key)
        return _KERNELS[key]


def _made(model: DrivingModel, terms: Terms, key: KernelKey) -> _Kernel | None:
    if compiler.find_compiler() is None:
        return None

    def source_of_kernel() -> str:
        return _source(model, terms, key)

    source = compiler.remembered(key.lasting(), source_of_kernel)
    if not source:
        return None
    library = compiler.build_library(source)
    if library is None:
        return None
    return _Kernel(library.accumulate, int(library.terms()))


def _source(model: DrivingModel, terms: Terms, key: KernelKey) -> str:
    """Returns the C++ source of a kernel; nothing where there can be none."""
    names, varied = [], []
    for name, varies in key.parameters:
        names.append(name)
        varied.append(varies)
    try:
        program = record(model, names, key.dt, terms, key.dtype)
    except Unsupported as reason:
        name = _without_kernel(model, terms, key.dtype)
        log.info("%s has no compiled kernel (%s); PyTorch simulates it", name, reason)
        return ""
    return write(program, varied, key.dtype, summed=key.summed, corrected=key.corrected)


def _without_kernel(model: DrivingModel, terms: Terms, dtype: torch.dtype) -> str:
    """Returns the name of the objective if it alone cannot be recorded, else that of the model."""
    try:
        record_terms(terms, dtype)
    except Unsupported:
        if isinstance(terms.key, ComponentKey):
            return terms.key.component.__name__
    return type(model).__name__


def _run(
    kernel: _Kernel,
    segments: Segments,
    parameters: Sequence[Tensor],
    memory: Tensor,
    sums: Tensor,
    frames: tuple[ctypes.c_long, ctypes.c_long, _TensorView | None],
) -> None:
    """Runs a kernel on all shards.

    Args:
        kernel: what is run.
        segments, parameters, memory: what it reads.
        sums: what it writes.
        frames: how many frames are written, how many steps apart they are, and the gain.
    """
    problems, candidates = sums.shape[-2:]
    ends = _ends(segments.counted)
    signals = [_signal(getattr(segments, name)) for name in SIGNALS]
    views = (_TensorView * len(signals))(*signals)
    values = [_parameter(value, problems, candidates) for value in parameters]
    parameter_views = (_TensorView * len(values))(*values)
    counted = _signal(segments.counted)
    remembered = _TensorView(memory.data_ptr(), memory.stride(0), memory.stride(1))
    shards = problems * -(-candidates // BLOCK)
    rows, every, gain = frames
    corrections = None if gain is None else ctypes.byref(gain)

    def take(first: int) -> None:
        kernel.function(
            views,
            parameter_views,
            ctypes.byref(counted),
            ctypes.c_void_p(ends.data_ptr()),
            ctypes.byref(remembered),
            ctypes.c_void_p(sums.data_ptr()),
            ctypes.c_long(problems),
            ctypes.c_long(candidates),
            rows,
            every,
            corrections,
            ctypes.c_long(first),
            ctypes.c_long(min(first + _SHARDS_AT_ONCE, shards)),
        )

    # A call of the kernel holds no lock of Python's.
    share(take, range(0, shards, _SHARDS_AT_ONCE), level="kernel")


def _ends(counted: Tensor) -> Tensor:
    """Returns the steps of each segment up to the last frame that counts, `(P,)` int64."""
    number = torch.arange(1, len(counted) + 1, device=counted.device)[:, None]
    return torch.where(counted > 0, number, 0).amax(0).contiguous()


def _signal(value: Tensor) -> _TensorView:
    """Returns a view of a signal `(K, P)`, or of values `(P,)`."""
    if value.dim() == 1:
        return _TensorView(value.data_ptr(), value.stride(0), 0)
    return _TensorView(value.data_ptr(), value.stride(1), value.stride(0))


def _parameter(value: Tensor, problems: int, candidates: int) -> _TensorView:
    # An expanded view: where problems or candidates share a value, its stride is 0.
    of_all = value.expand(problems, candidates)
    return _TensorView(of_all.data_ptr(), of_all.stride(0), of_all.stride(1))
