"""cfx's own engines keep the contract; a job chooses one by name."""

from __future__ import annotations

import cfx
from cfx.core import registry, threads
from cfx.core.local_engine import LocalEngine
from cfx_contracts import check_contract


def test_contract_on_one_core() -> None:
    with threads.one_core():
        check_contract(LocalEngine())


def test_it_is_chosen_by_name() -> None:
    assert cfx.get("engine", "local") is LocalEngine
    assert isinstance(registry.create("engine", {"name": "local"}), LocalEngine)
