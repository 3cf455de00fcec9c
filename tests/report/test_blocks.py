"""A section of the page is a list of blocks; the template draws every kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from cfx.core import registry
from cfx.core.registry import Installed, installed
from cfx.report import blocks, page
from cfx.report.blocks import (
    Block,
    Facts,
    Figure,
    Fold,
    Grid,
    Group,
    Heading,
    Items,
    Listing,
    Table,
    Text,
    View,
)
from cfx.report.job import Runs
from cfx.report.runs import read_runs
from cfx.report.section import Section
from cfx.report.tables import Column, Sheet, text
from tests.report.folders import write_job
from tests.report.test_page import Page

SHEET = Sheet((Column("a heading", "explained so"),), ((text("a cell"),),))
SVG = '<svg viewBox="0 0 1 1"></svg>'
EVERY: tuple[Block, ...] = (
    Text("a remark", "note"),
    Heading("a title", "fine print"),
    Items(("an item",)),
    Facts((("a name", "a value"),)),
    Listing("a: listing"),
    Table(SHEET, compact=True, explain=True),
    Figure({"one": View(SVG, "a note"), "another": View(SVG, "no note")}, "a figure", "Show"),
    Grid((Group((Text("in a card"),), "card"),)),
    Fold("a fold", (Fold("a fold inside", (Text("far inside"),)),), unfolded=True),
)


class Further(Section):
    """A section of a third party."""

    title = "A further section"
    entry = "Further"

    def blocks(self, runs: Runs) -> Sequence[Block]:
        """Return every kind of block."""
        return EVERY


class Empty(Further):
    """A section that has nothing to show."""

    def blocks(self, runs: Runs) -> Sequence[Block]:
        """Return nothing."""
        return ()


class Broken(Further):
    """A section that fails."""

    def blocks(self, runs: Runs) -> Sequence[Block]:
        """Fail."""
        raise ValueError("no luck")


@pytest.mark.usefixtures("blank_figures")
def test_a_further_section_needs_nothing_but_its_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kinds = {block.kind for block in EVERY} | {"group"}
    assert kinds == {one.__name__.lower() for one in blocks.Block.__subclasses__()}
    added = []
    for name, section in (("mine", Further()), ("empty", Empty()), ("broken", Broken())):
        added.append(Installed("section", name, section, "somebody-else"))
    known = {"section": (*installed("section")[-2:], *added), "figure": ()}
    write_job(tmp_path / "job", pairs=3)
    runs = read_runs([str(tmp_path)])
    monkeypatch.setattr(registry, "installed", known.__getitem__)
    found = Page(page.render(runs))
    for words in (
        "a remark",
        "a title",
        "fine print",
        "an item",
        "a value",
        "a: listing",
        "a heading",
        "explained so",
        "a cell",
        "a note",
        "another",
        "in a card",
        "a fold",
        "far inside",
        "A further section",
    ):
        assert words in found.words
    assert "a figure" in found.having("aria-label")
    assert "mine" in found.having("id")
    assert "#mine" in found.having("href")
    assert {"empty", "broken"}.isdisjoint(found.having("id"))
    assert "section broken of the distribution somebody-else is left out: ValueError" in caplog.text
