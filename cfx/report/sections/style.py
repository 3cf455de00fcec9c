"""Driving style of all drivers."""

from __future__ import annotations

import hashlib

from cfx.report.blocks import Block, Grid, Group, Heading, Text, missing_file
from cfx.report.figure_blocks import caption, figure_of
from cfx.report.job import Job, Runs
from cfx.report.section import Section

_NAME = "style_distribution"


class StyleSection(Section):
    """Driving style of all drivers."""

    title = "Driving style"
    entry = "Driving style"
    order = 1500

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a figure for each scoring of the drivers, with the jobs it holds for."""
        jobs: dict[str, list[Job]] = {}
        for job in runs.jobs:
            if len(job.tables.get("style", ())):
                jobs.setdefault(_scoring(job), []).append(job)
        cards = []
        for together in jobs.values():
            figure = figure_of(_NAME, together[0])
            parts: list[Block] = [] if figure is None else [figure]
            if len(jobs) > 1:
                parts.insert(0, Heading(", ".join(job.name for job in together)))
            cards.append(Group(tuple(parts), "card"))
        lacking = missing_file(runs, "style.csv", "the distribution of the style scores")
        return [Text(caption(_NAME)), Grid(tuple(cards)), *lacking]


def _scoring(job: Job) -> str:
    table = job.tables["style"][["driver", "score", "cluster"]].to_csv()
    return hashlib.sha256(table.encode()).hexdigest()
