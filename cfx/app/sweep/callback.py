"""What Hydra calls when a multirun starts.

Hydra knows a sweep's folder in two ways: the master configuration, and the overrides from which
each job is composed again, also in worker processes. `SweepFolder` sets both.
"""

from __future__ import annotations

from typing import Any, ClassVar

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from cfx.app.sweep.running import Sweep


class Refused(BaseException):
    """A sweep cannot start; the cause says why.

    It is no `Exception`, because Hydra swallows those in a callback.
    """


class SweepFolder(Callback):
    """Chooses the folder when Hydra starts a multirun; `conf/config.yaml` names this class."""

    _current: ClassVar[Sweep | None] = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            SweepFolder._current = Sweep.open(config)
            SweepFolder._current.lead(config)
        except Exception as error:
            raise Refused from error

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Lets go of a job's configurations, which Hydra would keep until the sweep ends.

        They take half a megabyte for each job; what a sweeper asks for is the returned value.
        """
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            job_return.cfg = None
            job_return.hydra_cfg = None

    @classmethod
    def take(cls) -> Sweep | None:
        """Returns the sweep that was started, if one was, and forgets it."""
        sweep = cls._current
        cls._current = None
        return sweep
