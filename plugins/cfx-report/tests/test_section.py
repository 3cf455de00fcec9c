"""A section of the page is a template and what it shows; the page has the functions it is drawn by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from cfx.core import registry
from cfx.core.registry import Installed, installed
from cfx.figures.canvas import blank
from cfx_report import page
from cfx_report.jobs import Runs
from cfx_report.runs import read_runs
from cfx_report.section import Column, Section, Sheet, View, number
from tests.job_folders import write_job
from tests.pages import HOSTILE, Page


class Further(Section):
    """A section of a third party that uses all that templates have."""

    title = "A further section"
    entry = "Further"
    template = """
<p>{{ words }}</p>
{{ table(sheet, compact=true, explain=true) }}
{{ figure(views, "a figure", "Show") }}
{{ cards("drives", [("in a card", "fine print", runs.jobs[0])]) }}
{{ cards("platoon", [("no card", "", runs.jobs[0])]) }}
{% call fold("a fold", true) %}{% call fold("a fold inside") %}far inside{% endcall %}{% endcall %}
{{ drawn_folds("drives", runs.jobs) }}
{{ missing("curves.parquet", "what was learned") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return something for each."""
        columns = (
            Column[float]("a heading", lambda row: f"row {row:g}", "explained so", "above"),
            Column("half", lambda row: number(row / 2, "+.1f", "second line")),
        )
        views = {"one": View(blank(1.0), "a note"), "another": View(blank(1.0))}
        return {"words": HOSTILE, "sheet": Sheet.of(columns, [1.0, float("nan")]), "views": views}


class Empty(Further):
    """A section that has nothing to show."""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return nothing."""
        return None


class Silent(Section):
    """A section whose figures no job has."""

    title = "Silent"
    entry = "Silent"
    figures = ("platoon",)


class Broken(Further):
    """A section that fails."""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Fail."""
        raise ValueError("no luck")


class Misspelt(Section):
    """A section whose template asks for what is not there."""

    title = "Misspelt"
    entry = "Misspelt"
    template = "{{ wrods }}"


@pytest.mark.usefixtures("blank_figures")
def test_a_further_section_needs_nothing_but_a_template_and_its_context(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write_job(tmp_path / "job", pairs=3)
    (tmp_path / "job" / "curves.parquet").unlink()
    runs = read_runs([str(tmp_path)])
    added = []
    for section in (Further(), Empty(), Silent(), Broken(), Misspelt()):
        name = type(section).__name__.lower()
        added.append(Installed("section", name, section, "somebody-else"))
    known = {"section": (*installed("section")[-2:], *added), "figure": installed("figure")}
    monkeypatch.setattr(registry, "installed", known.__getitem__)
    found = Page(page.render(runs))
    for words in (
        "A further section",
        HOSTILE,
        "above",
        "a heading",
        "explained so",
        "row 1",
        "+0.5",
        "second line",
        "a note",
        "another",
        "in a card",
        "fine print",
        "a fold",
        "far inside",
        "what was learned; this job has no curves.parquet",
    ):
        assert words in found.words
    assert "no card" not in found.words
    assert found.having("aria-label").count("a figure") == 1
    title = "Speed and gap of the best, the median and the worst pair"
    assert found.having("aria-label").count(title) == 2
    assert found.having("data-sort") == ["0.5", ""]
    assert "img" not in {tag for tag, _ in found.elements}
    assert "further" in found.having("id")
    assert "#further" in found.having("href")
    assert {"empty", "silent", "broken", "misspelt"}.isdisjoint(found.having("id"))
    assert "section broken of the distribution somebody-else is left out: ValueError" in caplog.text
    assert "section misspelt of the distribution somebody-else is left out" in caplog.text
    assert "'wrods' is undefined" in caplog.text
