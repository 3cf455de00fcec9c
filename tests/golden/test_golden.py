"""Results of small jobs stay the same to the last bit: `make golden`, and `make golden-write`.

Bits depend on the processor and on versions of libraries. Elsewhere metrics alone are compared,
within a tolerance.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.golden import record
from tests.golden.jobs import JOBS, run, run_sweep

WRITES = os.environ.get("CFX_GOLDEN") == "write"


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_results_are_those_that_were_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folders = {name: run(name, tmp_path) for name in JOBS} | run_sweep(tmp_path)
    found = {name: record.record(folder) for name, folder in folders.items()}
    if WRITES:
        record.write(found)
        return
    recorded = json.loads(record.FILE.read_text())
    here, there = record.machine(), recorded["machine"]
    if here == there:
        changes = list(record.differences(recorded["jobs"], found))
    else:
        changes = list(record.beyond_tolerance(recorded["jobs"], found))
    assert not changes, f"{len(changes)} changes:\n" + "\n".join(changes)
    if here != there:
        pytest.skip(
            f"bits were recorded with {there}, here is {here};"
            f" metrics agree within {record.TOLERANCE:g}"
        )


def test_a_change_of_the_last_bit_is_found_and_its_size_is_said() -> None:
    column = {"sha256": "a", "mean": 0.5}
    before = {"job": {"metrics.json": {"rmse": 1.0, "p": None}, "pairs.csv": {"gap": column}}}
    other = {"sha256": "b", "mean": 0.5}
    after = {"job": {"metrics.json": {"rmse": 1.0 + 2**-52}, "pairs.csv": {"gap": other}}}
    assert list(record.differences(before, before)) == []
    assert list(record.differences(before, after)) == [
        "job metrics.json p: None became 'missing'",
        "job metrics.json rmse: 1.0 became 1.0000000000000002 (+2.2e-16 of it)",
        "job pairs.csv gap: other values of the same mean, 0.5",
    ]
    assert list(record.beyond_tolerance(before, after)) == [
        "job metrics.json p: None became 'missing'"
    ]
