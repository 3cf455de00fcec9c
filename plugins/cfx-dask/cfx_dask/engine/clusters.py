"""Clusters of a job's own: processes on this machine, jobs in a queue, pods."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import logging
import multiprocessing
import sys
import uuid
from pathlib import Path
from typing import Any, NamedTuple

from cfx.errors import EngineError, NotInstalledError
from cfx.plugin import distributions, threads
from cfx_dask.engine.settings import DaskSettings

_WORKERS_ELSEWHERE = 4


_DASK = "cfx-dask"


class _Package(NamedTuple):
    """Where a cluster's class comes from."""

    module: str
    name: str
    distribution: str


_PACKAGES = {
    "slurm": _Package("dask_jobqueue", "SLURMCluster", _DASK),
    "pbs": _Package("dask_jobqueue", "PBSCluster", _DASK),
    "lsf": _Package("dask_jobqueue", "LSFCluster", _DASK),
    "kubernetes": _Package("dask_kubernetes.operator", "KubeCluster", "dask-kubernetes"),
}


def require_installed(settings: DaskSettings) -> None:
    """Checks that what the settings need is installed. Imports none of it.

    Raises:
        NotInstalledError: it is not; says what to type.
    """
    _require("distributed", "engine=dask", _DASK)
    if settings.cluster in _PACKAGES:
        package = _PACKAGES[settings.cluster]
        module = package.module.partition(".")[0]
        _require(module, f"engine.cluster={settings.cluster}", package.distribution)


def _require(module: str, what: str, distribution: str) -> None:
    if importlib.util.find_spec(module) is None:
        line = distributions.install_line(distribution)
        raise NotInstalledError(f"{what} needs the package {module}: {line}")


def workers_of(settings: DaskSettings) -> int:
    """Returns how many workers a cluster of the job's own has."""
    if settings.workers is not None:
        return settings.workers
    if settings.cluster in _PACKAGES:
        return _WORKERS_ELSEWHERE
    return threads.cores()


def start(settings: DaskSettings) -> Any:
    """Starts a cluster of the job's own; its workers come later.

    Raises:
        EngineError: it cannot be started.
    """
    make = _local
    if settings.is_queue:
        make = _in_queue
    elif settings.cluster == "kubernetes":
        make = _pods
    elif getattr(multiprocessing.current_process(), "_inheriting", False):
        # The job that started this worker says what is to be done.
        raise SystemExit("a worker was started by a script, and must not run it again")
    try:
        return make(settings)
    except Exception as error:  # these packages raise whatever their programs end in
        first = next(iter(str(error).splitlines()), "")
        advice = f"engine.options={settings.options} goes to it as it is"
        if make is _local and _script():
            advice = (
                f"workers import {_script()}: put what it runs below `if __name__ =="
                ' "__main__":`, or it runs again in each of them'
            )
        raise EngineError(
            f"engine.cluster={settings.cluster or 'local'} cannot be started"
            f" ({type(error).__name__}: {first}); {advice}"
        ) from error


def _script() -> str:
    """Returns the name of the Python script that runs; "" for a module and in a notebook."""
    main = sys.modules["__main__"]
    if getattr(main, "__spec__", None) is not None:
        return ""
    return Path(getattr(main, "__file__", None) or "").name


def _local(settings: DaskSettings) -> Any:
    from distributed import LocalCluster

    arguments = {
        "n_workers": workers_of(settings),
        "threads_per_worker": 1,
        "memory_limit": settings.memory,
        "host": "127.0.0.1",
        # Without an address its page would listen on all interfaces, at a port of its own choice.
        "dashboard_address": "127.0.0.1:0",
        "scheduler_kwargs": {"dashboard": False},
        "silence_logs": logging.CRITICAL,
        "security": _security(settings),
    }
    return LocalCluster(**{**arguments, **settings.options})


def _in_queue(settings: DaskSettings) -> Any:
    from dask.utils import format_bytes, parse_bytes

    package = _PACKAGES[str(settings.cluster)]
    together = settings.workers_per_job
    arguments = {
        "cores": together,
        "processes": together,
        "memory": format_bytes(together * parse_bytes(settings.memory)),
        "scheduler_options": {"dashboard": False, "dashboard_address": "127.0.0.1:0"},
        "silence_logs": logging.CRITICAL,
        "security": _security(settings),
        # Where the workers' keys lie while the job runs: nodes see the job's own folder.
        "shared_temp_directory": str(Path.cwd()),
    }
    cluster = _class(package)(**{**arguments, **settings.options})
    # Unlike `scale`, this replaces jobs that the queue has ended.
    wanted = workers_of(settings)
    cluster.adapt(minimum=wanted, maximum=wanted)
    return cluster


def _pods(settings: DaskSettings) -> Any:
    from dask.utils import parse_bytes

    operator = importlib.import_module(_PACKAGES["kubernetes"].module)
    limits = {"cpu": "1", "memory": str(parse_bytes(settings.memory))}
    arguments = {
        "name": f"cfx-{uuid.uuid4().hex[:10]}",
        "n_workers": workers_of(settings),
        "resources": {"limits": limits, "requests": limits},
        "worker_command": ["dask", "worker", "--nthreads", "1"],
        "quiet": True,
        **settings.options,
    }
    if "custom_cluster_spec" not in arguments:
        spec = {}
        for name in inspect.signature(operator.make_cluster_spec).parameters:
            if name in arguments:
                spec[name] = arguments.pop(name)
        pods = operator.make_cluster_spec(**spec)
        # As pods are made elsewhere it is `dask-scheduler`, which Dask has no more.
        container = pods["spec"]["scheduler"]["spec"]["containers"][0]
        container["args"] = ["dask", "scheduler", *container["args"][1:]]
        arguments["custom_cluster_spec"] = pods
    return operator.KubeCluster(**arguments)


def _class(package: _Package) -> Any:
    return getattr(importlib.import_module(package.module), package.name)


def _security(settings: DaskSettings) -> Any:
    """Returns credentials that this cluster alone knows."""
    from distributed.security import Security

    if settings.tls:
        return Security.temporary()
    return None
