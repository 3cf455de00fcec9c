"""Each statement of the contract fails for a demonstration that breaks it, and says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cfx.core.contract import Check, NotApplicable
from cfx.data.pairs import PairSet
from cfx.errors import DataError
from cfx.evaluation.demo import DEMO_PAGE, Demo
from cfx_contracts import check_contract
from cfx_contracts import demos as checks


class Page(Demo):
    def write(self, folder: Path, *results: Any) -> list[Path]:
        assert (folder.with_name("policy") / "policy.json").is_file()
        (folder / DEMO_PAGE).write_text("a page")
        return [folder / DEMO_PAGE]


def test_one_that_writes_a_page_holds_it() -> None:
    check_contract(Page())


class Talkative(Page):
    def check(self, pairs: PairSet) -> None:
        raise DataError("no\nroad")


class Silent(Page):
    def write(self, folder: Path, *results: Any) -> list[Path]:
        super().write(folder, *results)
        return []


class Elsewhere(Page):
    def write(self, folder: Path, *results: Any) -> list[Path]:
        (folder.parent / "pairs.csv").write_text("not its own")
        return super().write(folder, *results)


@pytest.mark.parametrize(
    ("demo", "check", "sentence"),
    [
        (Talkative(), checks.check_refuses_in_one_sentence, "says in one sentence"),
        (Silent(), checks.write_returns_the_files_in_its_folder, r"\['demo.html'\]"),
        (Elsewhere(), checks.write_returns_the_files_in_its_folder, r"not \['pairs.csv'\]"),
    ],
)
def test_what_breaks_the_contract_is_found(demo: Demo, check: Check, sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check(demo)


def test_a_demonstration_that_refuses_the_job_has_nothing_to_write() -> None:
    with pytest.raises(NotApplicable, match="cannot show the job"):
        checks.write_returns_the_files_in_its_folder(Talkative())
