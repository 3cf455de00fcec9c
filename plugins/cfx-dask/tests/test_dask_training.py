"""Training on a cluster whose workers are killed ends with the same networks as on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from cfx.core import threads
from cfx.core.engine import Engine
from cfx.core.local_engine import LocalEngine
from cfx.learners.base import TrainingResult
from cfx.learners.rollout import RolloutLearner, shard
from cfx.learners.workspace import Workspace
from cfx_dask.engine.engine import DaskEngine
from tests.learners.made import QUICK, gru, training_data

from .clusters import Cluster, running_cluster

SETTINGS = QUICK | {"epochs": 30, "steps": 10, "horizon": 12}


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    with running_cluster(workers=2) as made:
        yield made


def trained(engine: Engine, workspace: Workspace | None) -> TrainingResult:
    """Returns four networks, which train in two shards."""
    data = training_data(networks=4, frames=300, engine=engine, workspace=workspace)
    return RolloutLearner(**SETTINGS).fit(gru(), data)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_workers_that_are_killed_ten_times_change_nothing(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shard, "_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(threads, "_LIMIT", [1])
    expected = trained(LocalEngine(), None)
    seen: list[int] = []

    def an_epoch_has_ended() -> bool:
        """Says whether a checkpoint was written since the last kill."""
        times = sorted(file.stat().st_mtime_ns for file in tmp_path.rglob("[!.]*.ckpt"))
        is_new = times > seen
        seen[:] = times
        return is_new

    engine = DaskEngine(address=cluster.address)
    with cluster.kills(5, an_epoch_has_ended):
        found = trained(engine, Workspace(tmp_path))
    engine.close()
    weights = expected.network.state_dict()
    for name, value in found.network.state_dict().items():
        assert torch.equal(value, weights[name]), name
    assert found.curves.equals(expected.curves)
