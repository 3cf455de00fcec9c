"""cfx's own engines keep the contract; a job chooses one by name."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import cfx
from cfx.core import registry, threads
from cfx.core.local_engine import LocalEngine
from cfx_contracts import check_contract
from cfx_dask.engine.engine import DaskEngine
from tests.core.engine.clusters import running_cluster


def test_contract_on_one_core() -> None:
    with threads.one_core():
        check_contract(LocalEngine())


def test_it_is_chosen_by_name() -> None:
    assert cfx.get("engine", "local") is LocalEngine
    assert isinstance(registry.create("engine", {"name": "local"}), LocalEngine)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """One cluster for all statements: starting it takes seconds."""
    with running_cluster(workers=1) as made:
        yield made.address


def test_contract_on_a_running_cluster(cluster: str) -> None:
    check_contract(DaskEngine(address=cluster))
