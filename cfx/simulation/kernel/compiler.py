"""Builds C++ source once and keeps the library, for this process and for later ones.

Libraries lie in the user's own cache folder, which nobody else may write to: what is loaded from
there runs. `CFX_KERNEL_CACHE` names another folder. `torch_compiled` is `torch.compile` with a
cache for each kind of processor.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import torch

from cfx.core.files import atomic_write

log = logging.getLogger(__name__)

FLAGS = (
    "-std=c++17",
    "-O1",
    "-ftree-vectorize",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=off",
    "-shared",
    "-fPIC",
)
"""None of them changes a result: operations are rounded as PyTorch rounds them, one by one. What
-O3 does with conditions takes longer, and keeps long functions from vector registers."""

_VECTOR_MATH = ("-DVECTOR_MATH", "-lmvec", "-lm", "-Wl,-z,defs")
"""Exponentials, logarithms and powers of a whole vector register by glibc, to 4 units in the last
place; tried first. Where it has none of them, linking fails, and they are computed one by one."""

_TIMEOUT_S = 120
"""A compiler that takes longer hangs, s."""


@functools.cache
def find_compiler() -> str | None:
    """Returns the C++ compiler of this machine; None where there is none."""
    for name in ("g++", "c++", "clang++"):
        path = shutil.which(name)
        if path is not None:
            return path
    return None


@functools.lru_cache(maxsize=64)
def build_library(source: str, *options: str) -> ctypes.CDLL | None:
    """Returns the library built from C++ source; None where it cannot be built.

    Args:
        source: the source.
        options: of the compiler, behind `FLAGS`.
    """
    compiler = find_compiler()
    if compiler is None:
        return None
    flags = (*FLAGS, *options)
    path = cache_folder() / f"{_key(source, compiler, flags)}.so"
    try:
        if not path.is_file():
            _tell()
            _compile([compiler, *flags], source, path)
        return ctypes.CDLL(str(path))
    except (OSError, subprocess.SubprocessError) as error:
        log.info("The C++ compiler made no kernel (%s); PyTorch simulates instead", error)
        return None


def remembered(key: str | None, make: Callable[[], str]) -> str:
    """Returns the text that `make` gives, kept for later processes under a key; None: not kept.

    Recording a step takes seconds, most of them in importing PyTorch's tracer. No text, where a
    step cannot be recorded, is not kept: `make` says why in each process.
    """
    if key is None:
        return make()
    path = cache_folder() / f"{key}.cpp"
    try:
        if path.is_file() and path.stat().st_size:
            return path.read_text(encoding="utf-8")
        text = make()
        if text:
            with atomic_write(path) as temporary:
                temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        log.info("The cache of kernels cannot be used (%s)", error)
        return make()
    return text


@functools.cache
def _tell() -> None:
    """Logs, once in a process, that code is compiled, which takes seconds the first time."""
    log.info("Compiling for this processor; what is compiled is kept in %s", cache_folder())


def _compile(compiler: list[str], source: str, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder, atomic_write(path) as temporary:
        text = Path(folder, "kernel.cpp")
        text.write_text(source, encoding="utf-8")
        command = [*compiler, "-o", str(temporary), str(text)]
        try:
            _run([*command, *_VECTOR_MATH])
        except subprocess.CalledProcessError:
            _run(command)


def _run(command: list[str]) -> None:
    # The user's own compiler, and source that we wrote.
    subprocess.run(command, capture_output=True, check=True, timeout=_TIMEOUT_S)  # noqa: S603


def _key(source: str, compiler: str, flags: tuple[str, ...]) -> str:
    """Returns what the library depends on, as a hash: source, compiler and processor."""
    real = Path(compiler).resolve()
    version = f"{real}:{real.stat().st_mtime_ns}"
    options = " ".join((*flags, *_VECTOR_MATH))
    described = (source, options, version, platform.machine(), processor())
    return hashlib.sha256("\0".join(described).encode()).hexdigest()


@functools.cache
def processor() -> str:
    """Returns the processor's instruction sets, for which `-march=native` compiles."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    for line in text.splitlines():
        if line.startswith(("flags", "Features")):
            return line
    return platform.processor()


@functools.cache
def cache_folder() -> Path:
    """Returns a folder that this user alone can write to."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = Path(base) / "cfx" / "kernels"
    chosen = os.environ.get("CFX_KERNEL_CACHE")
    if chosen:
        folder = Path(chosen)
    folder = folder.expanduser()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        if (
            status.st_uid == os.getuid()
            and not status.st_mode & 0o022
            and os.access(folder, os.W_OK)
        ):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="cfx-kernels-"))


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
    chosen = os.environ.get(_VARIABLE)
    base = Path(chosen) if chosen else cache_folder() / "torch"
    if base.name != name:
        os.environ[_VARIABLE] = str(base / name)
