"""cfx's own engines keep the contract; a job chooses one by name."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import cfx
from cfx.contracts import EngineContract
from cfx.core import registry, threads
from cfx.core.engine.base import Engine
from cfx.core.engine.local import LocalEngine
from cfx_dask.engine.engine import DaskEngine
from tests.core.engine.clusters import running_cluster


class TestLocalOnOneCore(EngineContract):
    @pytest.fixture
    def engine(self, monkeypatch: pytest.MonkeyPatch) -> Engine:
        monkeypatch.setattr(threads, "_LIMIT", [1])
        return LocalEngine()


@pytest.mark.slow
class TestLocal(EngineContract):
    """In processes of its own, each of which imports PyTorch."""

    @pytest.fixture
    def engine(self) -> Engine:
        return LocalEngine()


def test_it_is_chosen_by_name() -> None:
    assert cfx.get("engine", "local") is LocalEngine
    assert isinstance(registry.create("engine", {"name": "local"}), LocalEngine)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """One cluster for all statements: starting it takes seconds."""
    with running_cluster(workers=1) as made:
        yield made.address


class TestDask(EngineContract):
    @pytest.fixture
    def engine(self, cluster: str) -> Engine:
        return DaskEngine(address=cluster)
