"""One job of a sweep, on a worker."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

_ONE_AT_A_TIME = threading.Lock()
"""Hydra's configuration and the log belong to the process: a worker with several threads runs its
jobs one after the other."""


@dataclass(frozen=True)
class SweepJob:
    """A job, as Hydra describes it to its launchers.

    Attributes:
        number: of the job in its sweep.
        overrides: of the job.
        context, config, function, singletons: what Hydra composes and runs it with.
    """

    number: int
    overrides: tuple[str, ...]
    context: HydraContext
    config: DictConfig
    function: TaskFunction
    singletons: Mapping[type, Singleton]


def run_one(job: SweepJob, report: Callable[[int], None]) -> JobReturn:
    """Runs a job as Hydra's own launchers do."""
    with _ONE_AT_A_TIME:
        setup_globals()
        Singleton.set_state(dict(job.singletons))
        config = job.context.config_loader.load_sweep_config(job.config, list(job.overrides))
        with open_dict(config):
            config.hydra.job.id = f"{config.hydra.job.name}_{job.number}"
            config.hydra.job.num = job.number
        HydraConfig.instance().set_config(config)
        ended: JobReturn = run_job(
            hydra_context=job.context,
            task_function=job.function,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    report(1)
    return ended
