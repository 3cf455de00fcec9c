"""Figures of other distributions that no section shows."""

from __future__ import annotations

from cfx.core import registry
from cfx.report.blocks import Block, Heading, Text
from cfx.report.figure_blocks import figure_folds
from cfx.report.job import Runs
from cfx.report.section import Section


class FurtherSection(Section):
    """Figures of other distributions that no section shows."""

    title = "Further figures"
    entry = "Further figures"
    order = 1900

    def blocks(self, runs: Runs) -> list[Block]:
        """Return each such figure, of each job that has its data."""
        shown: set[str] = set()
        for section in registry.installed("section"):
            shown |= set(section.part.figures)
        found: list[Block] = []
        for one in registry.installed("figure"):
            if one.distribution == registry.OWN or one.name in shown:
                continue
            folds = figure_folds(one.name, runs)
            if folds:
                found += [Heading(one.part.title), Text(one.part.caption), *folds]
        return found
