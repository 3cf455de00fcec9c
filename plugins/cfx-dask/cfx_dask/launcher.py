"""A launcher of Hydra that hands the jobs of a sweep to an engine of cfx."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, configure_log, filter_overrides, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

log = logging.getLogger(__name__)


class EngineLauncher(Launcher):
    """Runs each job of a sweep as one shard of the engine `dask`.

    Args:
        settings: of the engine.
    """

    def __init__(self, **settings: Any) -> None:
        self.settings: dict[str, Any] = {}
        for name, value in settings.items():
            plain = value
            if OmegaConf.is_config(value):
                plain = OmegaConf.to_container(value, resolve=True)
            self.settings[name] = plain
        self.config: DictConfig | None = None
        self.hydra_context: HydraContext | None = None
        self.task_function: TaskFunction | None = None

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Takes what Hydra runs jobs with."""
        self.config = config
        self.hydra_context = hydra_context
        self.task_function = task_function

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Runs the jobs and returns how each ended, in order.

        Raises:
            ConfigError: a setting is wrong.
            EngineError: there is no cluster, or it was lost for good.
        """
        import cfx

        config = self.config
        assert config is not None
        setup_globals()
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        Path(str(config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        engine: Any = cfx.get("engine", "dask")(**self.settings)
        jobs = list(self._jobs(job_overrides, initial_job_idx))
        log.info("Launching %d jobs on a Dask cluster", len(jobs))
        ended: dict[int, JobReturn] = {}
        with closing(engine):
            from cfx_dask.job import run_one

            with closing(engine.map(run_one, jobs, _count)) as results:
                ended.update(results)
        return [ended[number] for number in range(len(jobs))]

    def _jobs(self, job_overrides: Sequence[Sequence[str]], first: int) -> Iterator[Any]:
        """Yields what a worker needs to run each job."""
        from cfx_dask.job import SweepJob

        assert self.config is not None
        assert self.hydra_context is not None
        assert self.task_function is not None
        singletons = Singleton.get_state()
        for number, overrides in enumerate(job_overrides, first):
            log.info("\t#%d : %s", number, " ".join(filter_overrides(overrides)))
            yield SweepJob(
                number,
                tuple(overrides),
                self.hydra_context,
                self.config,
                self.task_function,
                singletons,
            )


def _count(_jobs: int) -> None:
    """Progress of a sweep: each job says itself what it does, in its log."""
