"""Mutants change what runs, and verdicts belong to what was changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import mutants
from tests.mutants import Mutant, Verdict

SOURCE = '''"""A module."""

from __future__ import annotations


def longer(a: int | None, b: int) -> bool:
    return a is not None and a > b


def pairs(a: list[int], b: list[int]) -> object:
    return zip(a, b, strict=True)
'''


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a file of a checkout of its own."""
    pytest.importorskip("cosmic_ray", reason="make mutants installs it")
    path = tmp_path / "cfx" / "models" / "made.py"
    path.parent.mkdir(parents=True)
    path.write_text(SOURCE, encoding="utf-8")
    monkeypatch.setattr(mutants, "TREE", tmp_path)
    monkeypatch.setattr(mutants, "FOLDER", tmp_path)
    return path


def test_the_same_seed_draws_the_same_changes_of_what_runs(module: Path) -> None:
    first = list(mutants.drawn(["models"], 9, seed=3))
    assert first == list(mutants.drawn(["models"], 9, seed=3))
    assert len(first) >= 2
    for mutant in first:
        changed = mutants.mutated(mutant)
        assert changed is not None
        assert changed != SOURCE
        assert "a: int | None, b: int) -> bool" in changed, "annotations do not run"
        assert "strict=True" in changed, "lists of one length are as long either way"


def test_a_verdict_is_kept_until_its_file_changes_and_of_survivors_until_a_test_does(
    module: Path,
) -> None:
    killed, survivor = mutants.drawn(["models"], 2, seed=0)
    file = mutants.FOLDER / "verdicts.jsonl"
    verdicts = mutants.Verdicts(file)
    verdicts.keep(killed, Verdict("killed", "a > b", "a < b"))
    verdicts.keep(survivor, Verdict("survived", "a > b", "a >= b"))
    assert_outcomes(file, {killed: "killed", survivor: "survived"})

    test = mutants.TREE / "tests" / "models" / "test_made.py"
    test.parent.mkdir(parents=True)
    test.write_text("def test_nothing() -> None: ...\n", encoding="utf-8")
    assert_outcomes(file, {killed: "killed", survivor: None})

    module.write_text(SOURCE + "\n\nMORE = 1\n", encoding="utf-8")
    assert_outcomes(file, {killed: None, survivor: None})


def assert_outcomes(file: Path, outcomes: dict[Mutant, str | None]) -> None:
    """Checks what is read again of mutants."""
    verdicts = mutants.Verdicts(file)
    read = {}
    for mutant in outcomes:
        verdict = verdicts.of(mutant)
        read[mutant] = verdict.outcome if verdict else None
    assert read == outcomes


def test_survivors_stand_in_the_table() -> None:
    killed = Mutant("cfx/models/idm.py", "core/AddNot", 0, 3)
    survivor = Mutant("cfx/models/w99.py", "core/AddNot", 1, 7)
    text = mutants.table(
        [(killed, Verdict("killed", "a", "b")), (survivor, Verdict("survived", "x | y", "x & y"))]
    )
    assert "| models | 2 | 1 |" in text
    assert "| cfx/models/w99.py:7 | `x \\| y` | `x & y` |" in text
    assert "idm.py" not in text


def test_a_mutant_meets_the_tests_that_run_its_statement(module: Path) -> None:
    module.write_text("X = [\n    1,\n    2,\n]\nif X:\n    Y = 3\n", encoding="utf-8")
    name = "cfx/models/made.py"
    ran = {1: ["tests/a.py::slow", "tests/b.py::quick"], 5: ["tests/b.py::quick"], 6: []}
    seconds = {"tests/a.py::slow": 2.0, "tests/b.py::quick": 0.1, "tests/b.py::other": 1.0}
    covered = mutants.Covered({name: ran}, seconds)
    within = Mutant(name, "core/NumberReplacer", 0, 3)
    assert covered.of(within, 60.0) == ["tests/b.py::quick", "tests/a.py::slow"]
    assert covered.of(within, 1.0) == ["tests/b.py::quick"]
    assert covered.of(within, 0.0) == ["tests/b.py::quick"]
    assert covered.of(within._replace(line=5), 60.0) == ["tests/b.py::quick"]
    anywhere = ["tests/b.py::other", "tests/b.py::quick", "tests/a.py::slow"]
    assert covered.of(within._replace(line=6), 60.0) == anywhere
