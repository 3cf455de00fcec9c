"""A worker with other code than the job computes something else, so it computes nothing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from cfx.errors import EngineError
from cfx_dask.engine.code import differing, installed_code
from cfx_dask.engine.engine import DaskEngine
from tests.checkout import ROOT
from tests.shard_work import slowly

from .clusters import Cluster


def test_code_is_known_of_cfx_and_of_every_plugin() -> None:
    code = installed_code()
    assert "cfx-driving" in code
    assert all(len(digest) == 64 for digest in code.values())


def test_what_one_alone_has_is_no_difference() -> None:
    here = {"cfx-driving": "a", "cfx-community": "b", "mine": "c"}
    assert differing(here, {"cfx-driving": "a", "cfx-community": "x", "theirs": "d"}) == [
        "cfx-community"
    ]
    assert differing(here, here) == []


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster()
    shutil.copytree(ROOT / "cfx", tmp_path / "cfx")
    shutil.copytree(ROOT / "tests", tmp_path / "tests")
    with (tmp_path / "cfx" / "models" / "krauss.py").open("a") as file:
        file.write("# of another version\n")
    made.start_worker(root=tmp_path)
    yield made
    made.stop()


@pytest.mark.slow
def test_a_worker_with_other_code_is_said_in_a_sentence(cluster: Cluster) -> None:
    engine = DaskEngine(address=cluster.address)
    with pytest.raises(EngineError, match=r"the worker tcp://.* another cfx-driving than this job"):
        list(engine.map(slowly, [(1, 0.0)], lambda _units: None))
    engine.close()
