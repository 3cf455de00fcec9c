"""How many cores a process shares its work among."""

from __future__ import annotations

import os

import pytest

from cfx.core import threads
from cfx.core.threads import cores, limit_cores, own_cores


@pytest.fixture(autouse=True)
def _eight_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_LIMIT", [])
    monkeypatch.setattr(threads, "_OWN", [])
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: set(range(8)), raising=False)


def test_a_process_has_all_cores_or_what_a_job_asks_for() -> None:
    assert cores() == 8
    limit_cores(3)
    assert cores() == 3
    limit_cores(20)
    assert cores() == 8
    limit_cores(None)
    assert cores() == 8


def test_a_worker_has_its_own_cores_unless_a_job_asks_for_a_number() -> None:
    own_cores(1)
    assert cores() == 1
    limit_cores(None)
    assert cores() == 1, "a job of a sweep that asks for nothing gets what its worker has"
    limit_cores(4)
    assert cores() == 4
