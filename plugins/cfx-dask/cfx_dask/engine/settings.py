"""Which cluster, and how much of it."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from cfx.plugin import Settings

Cluster = Literal["local", "slurm", "pbs", "lsf", "kubernetes"]


class DaskSettings(Settings):
    """Settings of `DaskEngine`."""

    address: str | None = Field(
        None,
        description="tcp://HOST:PORT or tls://HOST:PORT of a scheduler that runs already; null: a"
        " cluster of the job's own",
    )
    cluster: Cluster | None = Field(
        None,
        description="what a cluster of the job's own is made of: local (processes on this machine;"
        " null), slurm, pbs, lsf (jobs in a queue) or kubernetes (pods)",
    )
    workers: int | None = Field(
        None,
        ge=1,
        description="workers of the job's own cluster, of one core each; null: one for each core"
        " here, 4 elsewhere",
    )
    memory: str = Field(
        "2GB", description="memory of each worker of the job's own cluster; it is restarted above"
    )
    workers_per_job: int = Field(
        1, ge=1, description="workers that one job of a queue runs, with so many times the memory"
    )
    options: dict[str, Any] = Field(
        {},
        description="further keywords of the cluster's class, such as queue, account and walltime"
        " of dask_jobqueue.SLURMCluster, or image of dask_kubernetes.operator.KubeCluster",
    )
    tls: bool = Field(
        True,
        description="workers of the job's own cluster prove who they are, and what is sent is"
        " encrypted: without it, whoever reaches the scheduler can run code as you",
    )
    waiting: int = Field(
        1, ge=0, description="shards that wait at each worker, besides the one that it works on"
    )
    retries: int = Field(
        20, ge=0, description="how often a shard is done again whose worker was lost"
    )
    patience_s: float | None = Field(
        None,
        gt=0,
        description="how long the job waits while there is no scheduler or no worker, s; null: 60,"
        " and for ever in a queue",
    )

    @field_validator("address")
    @classmethod
    def _has_a_port(cls, address: str | None) -> str | None:
        if address is None:
            return None
        protocol, _, place = address.partition("://")
        port = place.rpartition(":")[2]
        if protocol not in {"tcp", "tls", "ucx", "ws", "wss"} or not port.isdecimal():
            raise ValueError("write tcp://HOST:PORT, as `dask scheduler` prints it")
        return address

    @model_validator(mode="after")
    def _one_cluster(self) -> DaskSettings:
        if self.address is not None and self.cluster is not None:
            raise ValueError(
                "engine.address names a cluster that runs, engine.cluster asks for a new one; give"
                " one of them"
            )
        return self

    @property
    def is_queue(self) -> bool:
        """Whether workers wait in a queue until the machine has room for them."""
        return self.cluster in {"slurm", "pbs", "lsf"}

    @property
    def patience(self) -> float | None:
        """Seconds; None: for ever."""
        if self.patience_s is None and not self.is_queue:
            return 60.0
        return self.patience_s
