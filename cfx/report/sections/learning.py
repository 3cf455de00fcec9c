"""Learning curves."""

from __future__ import annotations

from cfx.plots.choice.learning import learning_curves
from cfx.plots.plotly.learning import learning_plot
from cfx.plots.words import plural
from cfx.report.blocks import (
    MOST,
    Block,
    Figure,
    Group,
    Heading,
    Section,
    Text,
    cards,
    missing_file,
)
from cfx.report.job import Runs

_INTRODUCTION = (
    "Loss by epoch as the learner defines it: the median over the networks and, where there are"
    " several, the band between the quartiles. A network that stopped early keeps its last loss."
)


def blocks(runs: Runs) -> list[Block]:
    """Returns a plot for each job that learned something."""
    groups, without = [], []
    for job in runs.jobs:
        if job.curves is None:
            continue
        if not len(job.curves):
            without.append(job.name)
            continue
        chosen = learning_curves(job.curves)
        heading = Heading(job.name, f"({plural(chosen.networks, 'network')})")
        groups.append(Group((heading, Figure(learning_plot(chosen))), "card"))
    found: list[Block] = [Text(_INTRODUCTION), *cards(groups)]
    if len(without) > MOST:
        found.append(Text(f"Nothing was learned in {len(without)} jobs.", "fine"))
    elif without:
        found.append(Text(f"Nothing was learned in {', '.join(without)}.", "fine"))
    return [*found, *missing_file(runs, "curves.parquet", "the learning curves")]


SECTION = Section("learning", "Learning curves", "Learning curves", blocks)
