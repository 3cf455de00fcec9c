"""The contract of an engine."""

import cfx
from cfx_contracts import check_contract

from cfx_example.engine import ThreadPool


def test_contract():
    check_contract(ThreadPool())


def test_cfx_finds_it():
    found = cfx.get("engine", "thread_pool")
    assert found is ThreadPool, "install it first: pip install --editable ."
