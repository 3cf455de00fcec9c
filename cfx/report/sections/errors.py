"""How errors grow from the measured state on."""

from __future__ import annotations

from cfx.report.blocks import Block, Text
from cfx.report.figure_blocks import caption, figure_folds
from cfx.report.job import Runs
from cfx.report.section import Section


class ErrorsSection(Section):
    """How errors grow from the measured state on."""

    title = "Errors over time"
    entry = "Errors over time"
    order = 1700

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a figure for each job that kept its trajectories."""
        folds = figure_folds("error_over_time", runs)
        return [Text(caption("error_over_time")), *folds] if folds else []
