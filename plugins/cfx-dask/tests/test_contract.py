"""The engine keeps the contract of engines."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from cfx_contracts import check_contract
from cfx_dask.engine.engine import DaskEngine

from .clusters import running_cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """One cluster for all statements: starting it takes seconds."""
    with running_cluster(workers=1) as made:
        yield made.address


def test_contract_on_a_running_cluster(cluster: str) -> None:
    check_contract(DaskEngine(address=cluster))
