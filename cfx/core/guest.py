"""Leaves a program that calls cfx as it was: what belongs to the process, not to cfx.

A script, a notebook or another Hydra application calls `cfx.run`. Hydra, MLflow, PyTorch, logging
and the rest keep much for the whole process. `guest` puts all of it back, however the call ends.
Libraries that nobody has imported have no state yet; none is imported here.
"""

from __future__ import annotations

import contextlib
import logging
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cfx.core.threads import cores_limit, limit_cores

_Part = tuple[Callable[[], Any], Callable[[Any], object]]
"""How a part of the state is read, and how it is put back."""


@contextlib.contextmanager
def guest() -> Iterator[None]:
    """Runs the block, or the function that it decorates, and puts the process's state back.

    That is: environment and working directory, `sys.argv`, logging, warnings' filters, signal
    handlers, the random state of Python, NumPy and PyTorch, PyTorch's threads, default dtype,
    gradient mode and deterministic flags, cfx's limit of cores, Hydra's singletons, MLflow's
    tracking URI. MLflow's autologging rests meanwhile: training is no run of the caller's.
    """
    before = [(put_back, read()) for read, put_back in _parts()]
    try:
        with warnings.catch_warnings(), _own_hydra(), _no_autologging():
            yield
    finally:
        for put_back, value in reversed(before):
            put_back(value)


@contextlib.contextmanager
def same_environment() -> Iterator[None]:
    """Puts the environment's variables back, and nothing else: for calls that take milliseconds.

    PyTorch's compiler names its cache in one.
    """
    before = dict(os.environ)
    try:
        yield
    finally:
        _put_environment(before)


@contextlib.contextmanager
def default_torch() -> Iterator[None]:
    """Gives the block what PyTorch starts with: float32, gradients, tensors on the CPU.

    So a job's numbers do not depend on what its caller has chosen. Use it in `guest`.
    """
    import torch

    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(torch.inference_mode(False))
            stack.enter_context(torch.enable_grad())
            if torch.get_default_device().type != "cpu":
                stack.enter_context(torch.device("cpu"))
            yield
    finally:
        torch.set_default_dtype(dtype)


@contextlib.contextmanager
def visit() -> Iterator[None]:
    """Runs a block that computes for a program: `guest` and `default_torch` together.

    Bars of progress are drawn in notebooks alone.
    """
    import torch  # noqa: F401 - a guest puts the state of what is there already back

    from cfx.core.progress import no_bars_on_terminals

    with guest(), default_torch(), no_bars_on_terminals():
        yield


def _parts() -> Iterator[_Part]:
    """Yields the parts of the state; later ones are put back first."""
    yield os.environ.copy, _put_environment
    yield Path.cwd, _put_directory
    yield lambda: (sys.argv, sys.argv[:]), _put_arguments
    yield random.getstate, random.setstate
    numpy = sys.modules.get("numpy")
    if numpy is not None:
        yield numpy.random.get_state, numpy.random.set_state
    yield cores_limit, limit_cores
    yield lambda: {one: signal.getsignal(one) for one in signal.valid_signals()}, _put_handlers
    yield _logging, _put_logging
    torch = sys.modules.get("torch")
    if torch is not None:
        yield from _torch_parts(torch)
    mlflow = sys.modules.get("mlflow")
    if mlflow is not None:  # after the environment, one of whose variables it is too
        yield _if_changed(
            lambda: mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else None,
            mlflow.set_tracking_uri,
        )


def _torch_parts(torch: Any) -> Iterator[_Part]:
    yield torch.get_num_threads, torch.set_num_threads
    yield torch.get_default_dtype, torch.set_default_dtype
    yield torch.is_grad_enabled, torch.set_grad_enabled
    yield torch.get_rng_state, torch.set_rng_state
    if torch.cuda.is_initialized():
        yield torch.cuda.get_rng_state_all, torch.cuda.set_rng_state_all
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


def _if_changed(read: Callable[[], Any], put_back: Callable[[Any], object]) -> _Part:
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
    for one in loggers:
        flags = (one.level, one.disabled, one.propagate)
        parts.append((one, one.handlers[:], one.filters[:], flags))
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
def _own_hydra() -> Iterator[None]:
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
    for one in (GlobalHydra, HydraConfig, VersionBase):
        if one in instances:
            shelved[one] = instances.pop(one)
    try:
        yield
    finally:
        for one in (GlobalHydra, HydraConfig, VersionBase):
            instances.pop(one, None)
        instances.update(shelved)


@contextlib.contextmanager
def _no_autologging() -> Iterator[None]:
    """Lets MLflow's autologging rest, where MLflow is there."""
    of_mlflow = sys.modules.get("mlflow.utils.autologging_utils")
    # MLflow's block ends with autologging on, also in a block of the caller's that has it off.
    if of_mlflow is None or of_mlflow._AUTOLOGGING_GLOBALLY_DISABLED:  # noqa: SLF001 - as above
        yield
        return
    with of_mlflow.disable_autologging():
        yield
