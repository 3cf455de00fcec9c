"""A process that stands by: its work is done, in order, whatever becomes of it."""

from __future__ import annotations

import os
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from cfx.engine.processes import Standby
from cfx.errors import DataError

_ITEMS = list(range(6))


def _whose(seconds: float, item: int) -> tuple[int, int]:
    time.sleep(seconds)
    return item, os.getpid()


def _fail_at(wanted: int, item: int) -> int:
    if item == wanted:
        raise DataError(f"item {item} is wrong")
    return item


def _die_elsewhere(job: int, item: int) -> int:
    if os.getpid() != job:
        os._exit(1)
    time.sleep(0.1)
    return item


def test_both_processes_work_and_results_are_in_order() -> None:
    with Standby("json") as second:
        second.wait()
        done = second.share(partial(_whose, 0.05), _ITEMS)
    assert [item for item, _ in done] == _ITEMS
    assert len({process for _, process in done}) == 2


def test_a_process_that_has_not_imported_everything_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "slow_module.py").write_text("import time; time.sleep(60)")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path))
        with Standby("slow_module") as second:
            done = second.share(partial(_whose, 0.0), _ITEMS)
    assert {process for _, process in done} == {os.getpid()}


def test_a_module_that_cannot_be_imported_there_costs_nothing() -> None:
    with Standby("no_such_module") as second:
        second.wait()
        done = second.share(partial(_whose, 0.0), _ITEMS)
    assert {process for _, process in done} == {os.getpid()}


@pytest.mark.parametrize("wanted", [_ITEMS[0], _ITEMS[-1]], ids=["here", "there"])
def test_an_error_is_raised_wherever_it_was(wanted: int) -> None:
    with Standby("json") as second:
        second.wait()
        with pytest.raises(DataError, match=f"item {wanted} is wrong"):
            second.share(partial(_fail_at, wanted), _ITEMS)


def test_what_cannot_be_sent_is_done_here() -> None:
    items = [threading.Lock() for _ in range(4)]
    with Standby("json") as second:
        second.wait()
        assert second.share(type, items) == [type(items[0])] * 4


def test_the_work_of_a_killed_process_is_done_here() -> None:
    with Standby("json") as second:
        second.wait()
        assert second.share(partial(_die_elsewhere, os.getpid()), _ITEMS) == _ITEMS
