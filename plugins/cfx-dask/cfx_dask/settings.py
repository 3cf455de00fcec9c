"""What `hydra.launcher` holds: the settings of the engine `dask`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class DaskLauncherSettings:
    """As those of `engine=dask`, which says what each is; `waiting` is 0: jobs are long."""

    _target_: str = "hydra_plugins.cfx_dask_launcher.DaskLauncher"
    address: str | None = None
    cluster: str | None = None
    workers: int | None = None
    memory: str = "2GB"
    workers_per_job: int = 1
    options: dict[str, Any] = field(default_factory=dict)
    tls: bool = True
    waiting: int = 0
    retries: int = 20
    patience_s: float | None = None
