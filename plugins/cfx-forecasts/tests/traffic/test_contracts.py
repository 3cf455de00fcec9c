"""The protocol and its tables hold their contracts; a finished job's policy drives too."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from cfx_contracts import check_contract
from cfx_forecasts.traffic.protocol import TrafficProtocol
from tests.evaluation.protocols.test_transfer import HERE

from ..test_finished import drawn, job

__all__ = ["drawn"]  # pytest finds it here

FINISHED = [
    *HERE,
    "protocol=traffic",
    "protocol.histories=[]",
    "protocol.densities=[30]",
    "protocol.vehicles=5",
    "protocol.repetitions=1",
    "protocol.demands=[]",
    "protocol.leader_speeds=[8]",
    "protocol.platoon=3",
    "protocol.duration=40",
    "protocol.settle=10",
]


@pytest.fixture(scope="module")
def traffic(drawn: Path) -> TrafficProtocol:
    return TrafficProtocol(
        run=drawn,
        histories=(),
        densities=(30.0,),
        vehicles=5,
        demands=(900.0,),
        leader_speeds=(8.0,),
        platoon=3,
        duration=10.0,
        settle=5.0,
    )


@pytest.mark.slow
def test_contract_with_a_finished_policy(traffic: TrafficProtocol) -> None:
    check_contract(traffic)


def test_the_finished_policy_is_set_on_roads(drawn: Path, tmp_path: Path) -> None:
    result = job(FINISHED, drawn, tmp_path / "job")
    roads = pd.read_parquet(result.folder / "traffic.parquet")
    assert {"pooled", "driver_specific", "policy", "policy_sampled"} <= set(roads["method"])
    assert result.metrics["traffic/capacity/policy"] > 0
