"""What is sent to queues and to Kubernetes: the jobs and pods that start workers."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from cfx_dask.engine import clusters
from cfx_dask.engine.settings import DaskSettings

pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")

HEADS = {
    "slurm": (
        {"queue": "compute", "account": "traffic", "walltime": "04:00:00"},
        [
            "#SBATCH -J dask-worker",
            "#SBATCH -p compute",
            "#SBATCH -A traffic",
            "#SBATCH -n 1",
            "#SBATCH --cpus-per-task=10",
            "#SBATCH --mem=38G",
            "#SBATCH -t 04:00:00",
        ],
    ),
    "pbs": (
        {"queue": "compute", "account": "traffic", "walltime": "04:00:00"},
        [
            "#PBS -N dask-worker",
            "#PBS -q compute",
            "#PBS -A traffic",
            "#PBS -l select=1:ncpus=10:mem=38GB",
            "#PBS -l walltime=04:00:00",
        ],
    ),
    "lsf": (
        {"queue": "compute", "project": "traffic", "walltime": "04:00"},
        [
            "#BSUB -J dask-worker",
            "#BSUB -q compute",
            '#BSUB -P "traffic"',
            "#BSUB -n 10",
            '#BSUB -R "span[hosts=1]"',
            "#BSUB -M 39996883",
            "#BSUB -W 04:00",
        ],
    ),
}


@contextmanager
def started(settings: DaskSettings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Starts a queue's cluster, of which no job is submitted."""
    from dask_jobqueue.core import JobQueueCluster

    monkeypatch.setattr(JobQueueCluster, "adapt", lambda self, **limits: limits)
    cluster = clusters.start(settings)
    try:
        yield cluster
    finally:
        cluster.close()
        # dask-jobqueue leaves this to the collector of garbage.
        for name in ("ca_file", "cert", "key"):
            getattr(cluster, f"_job_{name}").close()


@pytest.mark.parametrize("queue", HEADS)
def test_a_queue_is_asked_for_so_many_cores_and_so_much_memory(
    queue: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """40 GB for ten workers: 37.25 GiB, which the queues' units round up."""
    monkeypatch.chdir(tmp_path)
    options, head = HEADS[queue]
    settings = DaskSettings(
        cluster=queue, workers=50, workers_per_job=10, memory="4GB", options=options
    )
    with started(settings, monkeypatch) as cluster:
        lines = [line for line in cluster.job_script().splitlines() if line]
        keys = {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert lines[0].startswith("#!")
    assert lines[1:-1] == head
    command = lines[-1]
    assert command.startswith(f"{sys.executable} -m distributed.cli.dask_worker tls://")
    assert "--nthreads 1 --memory-limit 3.73GiB --nworkers 10 --nanny" in command
    assert f"--tls-key {tmp_path}/" in command
    assert keys == {0o600}, "others can read the workers' keys"
    assert not list(tmp_path.iterdir()), "the workers' keys are left over"


def as_the_operator(worker_command: list[str], **given: Any) -> dict[str, Any]:
    """Returns pods as `dask_kubernetes.operator.make_cluster_spec` (2026.3.0) describes them."""

    def containers(*arguments: str) -> dict[str, Any]:
        common = {"image": given["image"], "resources": given["resources"]}
        return {"containers": [{**common, "args": list(arguments)}]}

    return {
        "metadata": {"name": given["name"]},
        "spec": {
            "worker": {
                "replicas": given["n_workers"],
                "spec": containers(*worker_command, "--name", "$(DASK_WORKER_NAME)"),
            },
            "scheduler": {"spec": containers("dask-scheduler", "--host", "HOST")},
        },
    }


def described(
    name: str,
    image: str = "",
    n_workers: int = 0,
    resources: dict[str, Any] | None = None,
    worker_command: tuple[str, ...] = (),
) -> dict[str, Any]:
    return as_the_operator(
        list(worker_command), name=name, image=image, n_workers=n_workers, resources=resources
    )


@pytest.fixture(params=["made up", "installed"])
def operator(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Returns dask-kubernetes' operator, whose clusters keep what they are made with."""
    if request.param == "installed":
        pytest.importorskip("dask_kubernetes", reason="dask-kubernetes is not installed")
        module = importlib.import_module("dask_kubernetes.operator")
    else:
        module = ModuleType("dask_kubernetes.operator")
        monkeypatch.setattr(module, "make_cluster_spec", described, raising=False)
        monkeypatch.setitem(sys.modules, "dask_kubernetes", ModuleType("dask_kubernetes"))
        monkeypatch.setitem(sys.modules, "dask_kubernetes.operator", module)
    monkeypatch.setattr(module, "KubeCluster", dict, raising=False)
    return module


def test_pods_have_memory_in_bytes_and_commands_that_there_are(operator: ModuleType) -> None:
    """Kubernetes does not know the unit GB, and Dask has dropped dask-worker."""
    options = {"image": "registry.example.org/cfx:1", "namespace": "traffic"}
    settings = DaskSettings(cluster="kubernetes", workers=20, memory="4GB", options=options)
    made = clusters.start(settings)
    pods = made.pop("custom_cluster_spec")
    assert made == {"quiet": True, "namespace": "traffic"}
    assert pods["metadata"]["name"].startswith("cfx-")
    assert clusters.start(settings)["custom_cluster_spec"]["metadata"] != pods["metadata"]
    worker, scheduler = pods["spec"]["worker"], pods["spec"]["scheduler"]["spec"]["containers"][0]
    assert worker["replicas"] == 20
    (container,) = worker["spec"]["containers"]
    assert container["args"][:4] == ["dask", "worker", "--nthreads", "1"]
    assert scheduler["args"][:3] == ["dask", "scheduler", "--host"]
    for one in (container, scheduler):
        assert one["image"] == "registry.example.org/cfx:1"
        for limits in one["resources"].values():
            assert limits == {"cpu": "1", "memory": "4000000000"}


def test_pods_of_ones_own_are_taken_as_they_are(operator: ModuleType) -> None:
    pods = {"metadata": {"name": "mine"}}
    settings = DaskSettings(cluster="kubernetes", options={"custom_cluster_spec": pods})
    assert clusters.start(settings)["custom_cluster_spec"] is pods
