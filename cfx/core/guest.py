"""Leaves a program that calls cfx as it was: what belongs to the process, not to cfx.

A script, a notebook or another Hydra application calls cfx, perhaps from several threads. Calls
that compute wait for one another: each uses all cores by itself. `visit` is for functions on data
frames, which change next to nothing that belongs to the process. `guest` is for a whole job
(`cfx.run`, `in_turn` too), which has its log and its tracking: Hydra, MLflow, PyTorch and logging
keep much for the whole process, and all of it is put back, however the job ends.

Random numbers are not put back, because nothing here draws from the process's generators: another
thread that draws from them would get its numbers again. What a plugin draws from them is its own
affair; contracts of optimizers and learners check that it does not.

Libraries that nobody has imported have no state yet; none is imported here.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cfx.core.threads import cores_limit, limit_cores

_TURN = [threading.RLock()]
"""What a call that computes holds; in a list, so that a forked process can have a new one."""

if hasattr(os, "register_at_fork"):
    # The thread that holds the parent's is not there.
    os.register_at_fork(after_in_child=lambda: _TURN.__setitem__(0, threading.RLock()))

_SET_BY_LIBRARIES = (
    "KMP_DUPLICATE_LIB_OK",
    "PYTORCH_NVML_BASED_CUDA_CHECK",
    "TORCHINDUCTOR_CACHE_DIR",
    "TRITON_CACHE_DIR",
)
"""Variables of the environment that libraries set as they are imported, and PyTorch's compiler."""

_Restorable = tuple[Callable[[], Any], Callable[[Any], object]]
"""How a part of the state is read, and how it is put back."""


@contextlib.contextmanager
def guest() -> Iterator[None]:
    """Runs the block, or the function that it decorates, and puts the process's state back.

    That is: environment and working directory, `sys.argv`, logging, warnings' filters, signal
    handlers, PyTorch's threads, default dtype, gradient mode and deterministic flags, cfx's limit
    of cores, MLflow's tracking URI. MLflow's autologging rests meanwhile: training is no run of the
    caller's.
    """
    with _put_back(_restorables()), warnings.catch_warnings(), no_autologging():
        yield


@contextlib.contextmanager
def in_turn() -> Iterator[None]:
    """Waits until no other thread is in such a block; a thread may enter one within another.

    A program calls it, never work of ours: a thread that shares a call's work would wait forever.
    """
    with _TURN[0]:
        yield


@contextlib.contextmanager
def _put_back(parts: Iterator[_Restorable]) -> Iterator[None]:
    """Puts parts of the state back after the block, the last one first."""
    before = [(put_back, read()) for read, put_back in parts]
    try:
        yield
    finally:
        for put_back, value in reversed(before):
            put_back(value)


@contextlib.contextmanager
def same_environment() -> Iterator[None]:
    """Puts back the environment's variables that libraries set, and no others.

    What another thread has set meanwhile stays as it is.
    """
    before = {name: os.environ.get(name) for name in _SET_BY_LIBRARIES}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            elif os.environ.get(name) != value:
                os.environ[name] = value


@contextlib.contextmanager
def default_torch() -> Iterator[None]:
    """Gives the block what PyTorch starts with: float32, gradients, tensors on the CPU.

    So a job's numbers do not depend on what its caller has chosen. All of it is the thread's own
    but the default dtype, which is touched only where the caller has chosen another.
    """
    import torch

    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        torch.set_default_dtype(torch.float32)
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.enable_grad())
            if torch.get_default_device().type != "cpu":
                stack.enter_context(torch.device("cpu"))
            yield
    finally:
        if torch.get_default_dtype() != dtype:
            torch.set_default_dtype(dtype)


@contextlib.contextmanager
def visit() -> Iterator[None]:
    """Runs a block that computes for a program, which may have other threads.

    Only PyTorch's threads, the limit of cores and what libraries set as they are imported belong to
    the process, and are put back. Bars of progress are drawn in notebooks alone.
    """
    import torch

    from cfx.core.progress import no_bars_on_terminals

    parts: list[_Restorable] = [
        (cores_limit, limit_cores),
        _if_changed(torch.get_num_threads, torch.set_num_threads),
    ]
    with (
        in_turn(),
        same_environment(),
        _put_back(iter(parts)),
        default_torch(),
        no_bars_on_terminals(),
    ):
        yield


def _restorables() -> Iterator[_Restorable]:
    """Yields the parts of the state; later ones are put back first."""
    yield os.environ.copy, _put_environment
    yield Path.cwd, _put_directory
    yield lambda: (sys.argv, sys.argv[:]), _put_arguments
    yield cores_limit, limit_cores
    yield (
        lambda: {number: signal.getsignal(number) for number in signal.valid_signals()},
        _put_handlers,
    )
    yield _logging, _put_logging
    torch = sys.modules.get("torch")
    if torch is not None:
        yield from _torch_restorables(torch)
    mlflow = sys.modules.get("mlflow")
    if mlflow is not None:  # after the environment, one of whose variables it is too
        yield _if_changed(
            lambda: mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else None,
            mlflow.set_tracking_uri,
        )


def _torch_restorables(torch: Any) -> Iterator[_Restorable]:
    yield torch.get_num_threads, torch.set_num_threads
    yield torch.get_default_dtype, torch.set_default_dtype
    yield torch.is_grad_enabled, torch.set_grad_enabled
    yield _if_changed(  # setting it imports PyTorch's compiler: seconds
        lambda: (
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
        ),
        lambda flags: torch.use_deterministic_algorithms(flags[0], warn_only=flags[1]),
    )
    yield _if_changed(torch.get_float32_matmul_precision, torch.set_float32_matmul_precision)
    for flag in ("benchmark", "deterministic"):
        cudnn = torch.backends.cudnn
        yield partial(getattr, cudnn, flag), partial(setattr, cudnn, flag)


def _if_changed(read: Callable[[], Any], put_back: Callable[[Any], object]) -> _Restorable:
    """Returns a part that is put back only where it has changed."""

    def put(value: Any) -> None:
        if read() != value:
            put_back(value)

    return read, put


def _put_environment(before: Mapping[str, str]) -> None:
    for name in set(os.environ) - set(before):
        del os.environ[name]
    for name, value in before.items():
        if os.environ.get(name) != value:
            os.environ[name] = value


def _put_directory(before: Path) -> None:
    with contextlib.suppress(OSError):  # the caller's folder may have gone meanwhile
        os.chdir(before)


def _put_arguments(before: tuple[list[str], list[str]]) -> None:
    sys.argv, values = before
    sys.argv[:] = values


def _put_handlers(before: Mapping[int, Any]) -> None:
    if threading.current_thread() is not threading.main_thread():
        return  # no other thread can change a handler either
    for number, handler in before.items():
        # None: C code has set it, and Python cannot put it back.
        if handler is not None and signal.getsignal(number) != handler:
            signal.signal(number, handler)


def _logging() -> Any:
    """Returns the level below which all is off, and each logger with what it consists of."""
    loggers = [logging.getLogger()]
    for logger in logging.getLogger().manager.loggerDict.values():
        if isinstance(logger, logging.Logger):
            loggers.append(logger)
    parts = []
    for logger in loggers:
        flags = (logger.level, logger.disabled, logger.propagate)
        parts.append((logger, logger.handlers[:], logger.filters[:], flags))
    return logging.getLogger().manager.disable, parts


def _put_logging(before: Any) -> None:
    """Puts every logger back that there was; handlers that the block has added are closed."""
    disabled_below, parts = before
    if logging.getLogger().manager.disable != disabled_below:
        logging.disable(disabled_below)
    for logger, handlers, filters, (level, disabled, propagate) in parts:
        added = [handler for handler in logger.handlers if handler not in handlers]
        logger.handlers[:], logger.filters[:] = handlers, filters
        logger.disabled, logger.propagate = disabled, propagate
        if logger.level != level:
            logger.setLevel(level)
        for handler in added:
            handler.close()


@contextlib.contextmanager
def own_hydra() -> Iterator[None]:
    """Lets the block have a Hydra of its own, whose singletons know nothing of the caller's."""
    if "hydra" not in sys.modules:
        yield
        return
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.singleton import Singleton
    from hydra.version import VersionBase

    instances: dict[Any, Any] = Singleton._instances  # noqa: SLF001 - Hydra's own copy is a deep one
    shelved: dict[Any, Any] = {}
    for singleton in (GlobalHydra, HydraConfig, VersionBase):
        if singleton in instances:
            shelved[singleton] = instances.pop(singleton)
    try:
        yield
    finally:
        for singleton in (GlobalHydra, HydraConfig, VersionBase):
            instances.pop(singleton, None)
        instances.update(shelved)


@contextlib.contextmanager
def no_autologging() -> Iterator[None]:
    """Lets MLflow's autologging rest, where MLflow is there."""
    of_mlflow = sys.modules.get("mlflow.utils.autologging_utils")
    # MLflow's block ends with autologging on, also in a block of the caller's that has it off.
    if of_mlflow is None or of_mlflow._AUTOLOGGING_GLOBALLY_DISABLED:  # noqa: SLF001 - as above
        yield
        return
    with of_mlflow.disable_autologging():
        yield
