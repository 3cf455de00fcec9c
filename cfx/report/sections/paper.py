"""The published numbers beside a job's, where the job ran one of the paper's experiments.

Z. Yang, S. Masuda and M. Tatsubori (2021), Online Adaptation of Parameters using GRU-based Neural
Network with BO for Accurate Driving Model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cfx.data.style.result import CLUSTERS
from cfx.report.blocks import Block, Heading, Items, Table, Text
from cfx.report.figures.words import MINUS, percent
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, number, share, text

PAPER_PAIRS = 94
PAIR_11 = {"default": 3.393, "fixed": 1.033, "policy": 0.666}
"""RMSE of speed, m/s: follower 11 behind leader 1, Krauss model."""

_CITATION = (
    "Yang, Masuda and Tatsubori (2021), Online Adaptation of Parameters using GRU-based Neural"
    " Network with BO for Accurate Driving Model."
)
_NO_NUMBER = Cell("", number=True)


@dataclass(frozen=True)
class Comparison:
    """A published result beside the jobs'.

    Attributes:
        heading: what is compared.
        sheet: the numbers.
        verdicts: what follows from them, in sentences.
        explanation: what differs between the paper's set-up and the jobs', in a sentence.
    """

    heading: str
    sheet: Sheet
    verdicts: tuple[str, ...]
    explanation: str


class PaperSection(Section):
    """The published numbers beside a job's, where the job ran one of the paper's experiments."""

    title = "The paper's numbers beside these"
    entry = "The paper's numbers"
    order = 1100

    def blocks(self, runs: Runs) -> list[Block]:
        """Return the comparisons; nothing if no job ran an experiment of the paper."""
        found: list[Block] = []
        for one in comparisons(runs.jobs):
            found += [
                Heading(one.heading),
                Table(one.sheet, sortable=False),
                Items(one.verdicts),
                Text(one.explanation),
            ]
        return [Text(_CITATION), *found] if found else []


def comparisons(jobs: Sequence[Job]) -> list[Comparison]:
    """Returns a comparison for each of the paper's experiments among the jobs' `experiment`."""
    experiments = {"pair": _pair, "pairs": _pairs, "clusters": _clusters, "grid": _grid}
    made = []
    for experiment, compare in experiments.items():
        chosen = [job for job in jobs if job.experiment == f"paper/{experiment}"]
        if chosen:
            made.append(compare(chosen))
    return made


def _pair(jobs: Sequence[Job]) -> Comparison:
    columns = [Column("", number=False)]
    published = [text("paper: pair 11/1, Krauss")]
    for method, value in PAIR_11.items():
        columns.append(Column(f"RMSE of speed, {method} (m/s)"))
        published.append(number(value, f"{value:.3f}"))
    columns.append(Column("Improvement over fixed", f"(fixed {MINUS} policy) / fixed."))
    gain_there = (PAIR_11["fixed"] - PAIR_11["policy"]) / PAIR_11["fixed"]
    rows = [(*published, share(gain_there))]
    verdicts = []
    for job in jobs:
        cells = [text(f"here: {job.name}")]
        for method in PAIR_11:
            value = job.metric("rmse_speed", method)
            cells.append(number(value, f"{value:.3f}"))
        gain = job.improvement("mean")
        rows.append((*cells, share(gain)))
        there = f"in the paper it is closer by {100 * gain_there:.1f} %"
        verdicts.append(f"{job.name}: {_which_pair(job)}; {_side(gain)}, {there}.")
    return Comparison(
        "One pair: follower 11 behind leader 1",
        Sheet(tuple(columns), tuple(rows)),
        tuple(verdicts),
        _explanation(jobs, 1),
    )


def _which_pair(job: Job) -> str:
    table = job.pairs.drop_duplicates("pair_id")
    if len(table) == 1 and {"leader_id", "follower_id"} <= set(table.columns):
        follower, leader = str(table["follower_id"].iloc[0]), str(table["leader_id"].iloc[0])
        if (follower, leader) == ("11", "1"):
            return "the pair has the paper's numbers, follower 11 and leader 1"
        return f"this is another pair, follower {follower} and leader {leader}"
    return f"these are means over {len(table)} pairs, not the paper's one"


def _side(gain: float) -> str:
    if not math.isfinite(gain):
        return "the improvement is not defined"
    closer = "closer" if gain > 0 else "not closer"
    than = f"than driver-specific calibration ({percent(gain, 1)})"
    return f"the policy is {closer} to the driver {than}"


def _pairs(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", number=False),
        Column("Driving model", number=False),
        Column("Pairs"),
        Column("Mean improvement", "Over driver-specific calibration."),
        Column(
            "Trimmed mean",
            "Without the top and the bottom tenth, which the paper leaves out as outliers.",
        ),
    )
    rows = []
    for model in ("Krauss", "Wiedemann 99"):
        count = number(PAPER_PAIRS, str(PAPER_PAIRS))
        below = Cell("below 0 %", number=True)
        rows.append((text("paper"), text(model), count, below, _NO_NUMBER))
    verdicts = []
    for job in jobs:
        mean, trimmed = job.improvement("mean"), job.improvement("trimmed_mean")
        count = _count(job)
        about = (text(f"here: {job.name}"), text(job.component("model")), count)
        rows.append((*about, share(mean), share(trimmed)))
        if math.isfinite(mean):
            verdicts.append(f"{job.name}: the average improvement is {_below(mean, trimmed)}.")
    return Comparison(
        "A network for each pair",
        Sheet(columns, tuple(rows)),
        tuple(verdicts),
        _explanation(jobs, PAPER_PAIRS),
    )


def _below(mean: float, trimmed: float) -> str:
    if mean < 0 and trimmed < 0:
        return "below 0 %, as in the paper"
    if mean < 0 or trimmed < 0:
        return "below 0 % by one of the two means, and not by the other"
    return "not below 0 %, unlike the paper's"


def _clusters(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", number=False),
        Column("Driving model", number=False),
        Column("Cluster", number=False),
        Column("Pairs"),
        Column(
            "Mean improvement over pooled calibration",
            "One set of parameters, calibrated jointly on the training drivers: the paper's"
            " baseline.",
        ),
        Column(
            "Mean improvement over driver-specific calibration",
            "A set calibrated on the driver's own first part: a harder baseline, which the paper"
            " has not.",
        ),
    )
    rows = []
    for model, said in (("Krauss", "above 0 %"), ("Wiedemann 99", "above 0 %, up to +26 %")):
        about = (text("paper"), text(model), text("each"), _NO_NUMBER)
        rows.append((*about, Cell(said, number=True), _NO_NUMBER))
    gains: dict[tuple[str, str], float] = {}
    for job in jobs:
        model, cluster = job.component("model"), str(job.setting("style.cluster") or "all")
        gains[model, cluster] = job.improvement("mean", "population")
        about = (text(f"here: {job.name}"), text(model), text(cluster), _count(job))
        rows.append((*about, share(gains[model, cluster]), share(job.improvement("mean"))))
    return Comparison(
        "A network for each cluster, tested on unseen drivers",
        Sheet(columns, tuple(rows)),
        tuple(_cluster_verdicts(gains)),
        _explanation(jobs, PAPER_PAIRS),
    )


def _cluster_verdicts(gains: Mapping[tuple[str, str], float]) -> list[str]:
    known = {key: gain for key, gain in gains.items() if math.isfinite(gain)}
    verdicts = []
    if known:
        above = sum(gain > 0 for gain in known.values())
        there = "in all clusters in the paper"
        verdicts.append(f"Above 0 % in {above} of {len(known)} jobs here; {there}.")
    for model in dict.fromkeys(model for model, _ in known):
        low, high = known.get((model, CLUSTERS[0])), known.get((model, CLUSTERS[2]))
        if low is not None and high is not None:
            verdicts.append(
                f"{model}: the policy {_fares(high, low)} with aggressive than conservative drivers"
                " here; better in the paper."
            )
    for cluster in dict.fromkeys(cluster for _, cluster in known):
        krauss, w99 = known.get(("krauss", cluster)), known.get(("w99", cluster))
        if krauss is not None and w99 is not None:
            verdicts.append(
                f"{cluster}: the policy {_fares(w99, krauss)} with Wiedemann 99 than with Krauss"
                " here; better in the paper."
            )
    return verdicts


def _fares(gain: float, other: float) -> str:
    return "fares better" if gain > other else "fares no better"


def _grid(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", number=False),
        Column("Epochs"),
        Column("Batch size"),
        Column("Hidden size"),
        Column(
            "Best validation loss",
            "Mean over the networks of each one's lowest. The training is chosen by it, never by"
            " the test part.",
        ),
    )
    published = (number(500, "500"), number(1, "1"), _NO_NUMBER, _NO_NUMBER)
    rows: list[tuple[Cell, ...]] = [(text("paper: the best found"), *published)]
    losses = {job.name: job.metrics.get("validation_loss/best", math.nan) for job in jobs}
    ranked = sorted(jobs, key=lambda job: (not math.isfinite(losses[job.name]), losses[job.name]))
    for job in ranked:
        cells = [text(f"here: {job.name}")]
        for path in ("learner.epochs", "learner.batch_size", "policy.hidden_size"):
            setting = str(job.setting(path))
            cells.append(Cell(setting, setting, number=True))
        loss = losses[job.name]
        rows.append((*cells, number(loss, f"{loss:.4g}")))
    verdicts: tuple[str, ...] = ()
    if math.isfinite(losses[ranked[0].name]):
        verdicts = (f"The smallest validation loss here: {ranked[0].name}.",)
    sheet = Sheet(columns, tuple(rows))
    return Comparison("Grid search of the training", sheet, verdicts, _explanation(jobs, 1))


def _count(job: Job) -> Cell:
    count = job.pairs["pair_id"].nunique()
    return number(count, str(count))


def _explanation(jobs: Sequence[Job], pairs: int) -> str:
    """Says what of the jobs' set-up is not the paper's; only what can be read off the jobs."""
    sources, counts = set(), set()
    optimizers, learners, epochs, batches = set(), set(), set(), set()
    for job in jobs:
        sources.add(without_folders(str(job.data.get("source", ""))))
        counts.add(job.pairs["pair_id"].nunique())
        optimizers.add(job.component("optimizer"))
        learners.add(job.component("learner"))
        epochs.add(str(job.setting("learner.epochs")))
        batches.add(str(job.setting("learner.batch_size")))
    sources -= {""}
    parts = []
    if sources:
        there = "NGSIM I-80, 13 April 2005, 4:00 to 4:15 p.m."
        parts.append(f"the recordings (here {', '.join(sorted(sources))}; there {there})")
    if counts != {pairs} and pairs > 1:
        here = " or ".join(map(str, sorted(counts)))
        parts.append(f"the number of pairs (here {here} in a job; there {pairs} in all)")
    if optimizers != {"botorch"}:
        here = ", ".join(sorted(optimizers))
        parts.append(f"the search (here {here}; there Bayesian optimization)")
    if learners != {"imitation"}:
        here = ", ".join(sorted(learners))
        parts.append(
            f"how the policy learns (here {here}; there from the windows' best parameters)"
        )
    if epochs != {"500"} or batches != {"1"}:
        here = f"{' or '.join(sorted(epochs))} epochs, batch size {' or '.join(sorted(batches))}"
        parts.append(f"the training (here {here}; there 500, 1)")
    parts.append(
        "what the paper does not print, such as the parameters' bounds and the number of"
        " evaluations of its search"
    )
    listed = "; ".join(parts)
    return f"The numbers need not agree, because these things differ, or may: {listed}."
