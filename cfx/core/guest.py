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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cfx.core.threads import cores_limit, limit_cores

_Undo = Callable[[], None]


@contextlib.contextmanager
def guest() -> Iterator[None]:
    """Runs the block, or the function that it decorates, and puts the process's state back.

    That is: environment and working directory, `sys.argv`, logging, warnings' filters, signal
    handlers, the random state of Python, NumPy and PyTorch, PyTorch's threads, default dtype,
    gradient mode and deterministic flags, cfx's limit of cores, Hydra's singletons, MLflow's
    tracking URI. MLflow's autologging rests meanwhile: training is no run of the caller's.
    """
    undo = [kept() for kept in _KEPT]
    try:
        with warnings.catch_warnings(), _own_hydra(), _no_autologging():
            yield
    finally:
        for put_back in reversed(undo):
            put_back()


@contextlib.contextmanager
def same_environment() -> Iterator[None]:
    """Puts the environment's variables back, and nothing else: for calls that take milliseconds.

    PyTorch's compiler names its cache in one.
    """
    put_back = _environment()
    try:
        yield
    finally:
        put_back()


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


def _environment() -> _Undo:
    before = dict(os.environ)

    def put_back() -> None:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        for name, value in before.items():
            if os.environ.get(name) != value:
                os.environ[name] = value

    return put_back


def _working_directory() -> _Undo:
    before = Path.cwd()

    def put_back() -> None:
        with contextlib.suppress(OSError):  # the caller's folder may have gone meanwhile
            if Path.cwd() == before:
                return
        with contextlib.suppress(OSError):
            os.chdir(before)

    return put_back


def _arguments() -> _Undo:
    before, values = sys.argv, list(sys.argv)

    def put_back() -> None:
        sys.argv = before
        sys.argv[:] = values

    return put_back


def _random_state() -> _Undo:
    before = random.getstate()
    numpy = sys.modules.get("numpy")
    of_numpy = None if numpy is None else numpy.random.get_state()

    def put_back() -> None:
        random.setstate(before)
        if numpy is not None:
            numpy.random.set_state(of_numpy)

    return put_back


def _cores() -> _Undo:
    before = cores_limit()
    return lambda: limit_cores(before)


def _signal_handlers() -> _Undo:
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}

    def put_back() -> None:
        if threading.current_thread() is not threading.main_thread():
            return  # no other thread can change a handler either
        for number, handler in before.items():
            # None: C code has set it, and Python cannot put it back.
            if handler is not None and signal.getsignal(number) != handler:
                signal.signal(number, handler)

    return put_back


def _logging() -> _Undo:
    """Keeps every logger that there is; handlers that the block adds to one are closed."""
    loggers = [logging.getLogger()]
    for logger in logging.getLogger().manager.loggerDict.values():
        if isinstance(logger, logging.Logger):
            loggers.append(logger)
    lists = [(logger.handlers[:], logger.filters[:]) for logger in loggers]
    flags = [(logger.level, logger.disabled, logger.propagate) for logger in loggers]
    disabled_below = logging.getLogger().manager.disable

    def put_back() -> None:
        if logging.getLogger().manager.disable != disabled_below:
            logging.disable(disabled_below)
        for logger, (handlers, filters), flag in zip(loggers, lists, flags, strict=True):
            added = [handler for handler in logger.handlers if handler not in handlers]
            logger.handlers[:] = handlers
            logger.filters[:] = filters
            level, logger.disabled, logger.propagate = flag
            if logger.level != level:
                logger.setLevel(level)
            for handler in added:
                handler.close()

    return put_back


def _torch() -> _Undo:
    torch = sys.modules.get("torch")
    if torch is None:
        return lambda: None
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    gradients, state = torch.is_grad_enabled(), torch.get_rng_state()
    of_gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else None
    deterministic = _deterministic(torch)
    cudnn = torch.backends.cudnn
    flags = (cudnn.benchmark, cudnn.deterministic)
    precision = torch.get_float32_matmul_precision()

    def put_back() -> None:
        torch.set_num_threads(threads)
        torch.set_default_dtype(dtype)
        torch.set_grad_enabled(gradients)
        torch.set_rng_state(state)
        if of_gpus is not None:
            torch.cuda.set_rng_state_all(of_gpus)
        if _deterministic(torch) != deterministic:  # setting it imports PyTorch's compiler: seconds
            torch.use_deterministic_algorithms(deterministic[0], warn_only=deterministic[1])
        cudnn.benchmark, cudnn.deterministic = flags
        if torch.get_float32_matmul_precision() != precision:
            torch.set_float32_matmul_precision(precision)

    return put_back


def _deterministic(torch: Any) -> tuple[bool, bool]:
    """Returns whether PyTorch keeps to deterministic algorithms, and whether it only warns."""
    is_on: bool = torch.are_deterministic_algorithms_enabled()
    only_warns: bool = torch.is_deterministic_algorithms_warn_only_enabled()
    return is_on, only_warns


def _mlflow() -> _Undo:
    """Keeps the tracking URI; in the environment it is put back with the environment."""
    mlflow = sys.modules.get("mlflow")
    if mlflow is None:
        return lambda: None

    def uri() -> str | None:
        if mlflow.is_tracking_uri_set():
            return str(mlflow.get_tracking_uri())
        return None

    before = uri()

    def put_back() -> None:
        if uri() != before:
            mlflow.set_tracking_uri(before)

    return put_back


# Later ones are put back first: MLflow's URI is one of the environment's variables too.
_KEPT: tuple[Callable[[], _Undo], ...] = (
    _environment,
    _working_directory,
    _arguments,
    _random_state,
    _cores,
    _signal_handlers,
    _logging,
    _torch,
    _mlflow,
)


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
