"""What Hydra calls when a multirun starts.

Hydra knows a sweep's folder in two ways: the master configuration, and the overrides from which
each job is composed again, also in worker processes. `SweepFolder` sets both.
"""

from __future__ import annotations

from typing import Any, ClassVar

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from cfx.sweep.running import Sweep


class Refused(BaseException):
    """A sweep cannot start; the cause says why. Hydra swallows a callback's `Exception`, so this is none."""


class SweepFolder(Callback):
    """Chooses the folder when Hydra starts a multirun; `conf/config.yaml` names it as a callback."""

    _current: ClassVar[Sweep | None] = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            SweepFolder._current = Sweep.open(config)
            SweepFolder._current.lead(config)
        except Exception as error:
            raise Refused from error

    @classmethod
    def take(cls) -> Sweep | None:
        """Returns the sweep that was started, if one was, and forgets it."""
        sweep, cls._current = cls._current, None
        return sweep
