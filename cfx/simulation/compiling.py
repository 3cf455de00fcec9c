"""`torch.compile`, with a cache on disk for each kind of processor."""

from __future__ import annotations

import hashlib
import importlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import torch

from cfx.simulation.kernel.compiler import cache_folder, processor

F = TypeVar("F", bound=Callable[..., Any])

_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"


def torch_compiled(function: F, **options: Any) -> F:
    """Returns a function that `torch.compile` compiles at its first call.

    PyTorch keeps what it compiles on disk under a key that leaves out the processor's instruction
    sets: code with vectors of 512 bits, taken on a processor with 256, computes half of the numbers
    and leaves the others undefined. So each kind of processor has a folder of its own: below
    `TORCHINDUCTOR_CACHE_DIR` if that is set, else beside cfx's own kernels.

    Args:
        function: that is compiled.
        options: of `torch.compile`.
    """
    separate_cache()
    with warnings.catch_warnings():
        # torch warns of itself as it imports its compiler.
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("torch._inductor.compile_fx")
    return cast("F", torch.compile(function, **options))


def separate_cache() -> None:
    """Names a folder for this kind of processor as PyTorch's cache; again changes nothing."""
    sets = f"{processor()}\0{torch.backends.cpu.get_cpu_capability()}"
    name = f"cpu-{hashlib.sha256(sets.encode()).hexdigest()[:16]}"
    given = os.environ.get(_VARIABLE)
    base = Path(given) if given else cache_folder() / "torch"
    if base.name != name:
        os.environ[_VARIABLE] = str(base / name)
