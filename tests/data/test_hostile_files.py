"""Hostile but plausible files are read as they are meant, or refused with the reason."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.benchmarks.hostile_files import CASES, Outcome, drawn, recordings_of
from tests.checkout import needs

FEW, MANY = 8, 1000

pytestmark = [needs("cfx-recordings"), needs("cfx-sumo")]


def outcomes(numbers: range, data: Path | None, folder: Path) -> Iterator[Outcome]:
    recordings = recordings_of(data)
    for number in numbers:
        place = folder / str(number)
        place.mkdir()
        yield drawn(number, recordings, place)


def told(outcome: Outcome) -> str:
    names = ", ".join(case.name for case in outcome.cases)
    return f"file {outcome.number}, {outcome.layout}: {names}: {outcome.wrong} {outcome.said}"


def test_a_file_of_each_layout_is_answered(tmp_path: Path) -> None:
    for outcome in outcomes(range(FEW), None, tmp_path):
        assert outcome.answer in {"right", "unnamed"}, told(outcome)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_file_is_read_otherwise_without_a_word(tmp_path: Path, shared_data: Path) -> None:
    seen = set()
    for outcome in outcomes(range(MANY), shared_data, tmp_path):
        assert outcome.answer not in {"silent", "crash"}, told(outcome)
        seen |= set(outcome.cases)
    assert seen == set(CASES)
