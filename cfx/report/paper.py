"""The published figures beside a job's, where the job ran one of the paper's experiments.

Z. Yang, S. Masuda and M. Tatsubori (2021), Online Adaptation of Parameters using GRU-based Neural Network with BO for Accurate
Driving Model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cfx.figures.look import percent
from cfx.report.read import Job, improvement_of
from cfx.report.tables import Cell, Column, Sheet, number, share, text
from cfx.style.result import CLUSTERS

PAPER_PAIRS = 94
PAIR_11 = {"default": 3.393, "fixed": 1.033, "policy": 0.666}
"""RMSE of speed, m/s: follower 11 behind leader 1, Krauss model."""


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


def comparisons(jobs: Sequence[Job]) -> list[Comparison]:
    """Returns a comparison for each of the paper's experiments among the jobs' `experiment`."""
    made = []
    for experiment, compare in {
        "pair": _pair,
        "pairs": _pairs,
        "clusters": _clusters,
        "grid": _grid,
    }.items():
        chosen = [job for job in jobs if job.experiment == f"paper/{experiment}"]
        if chosen:
            made.append(compare(chosen))
    return made


def _pair(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", "", number=False),
        *(Column(f"RMSE of speed, {method} (m/s)", "") for method in PAIR_11),
        Column("Improvement over fixed", "(fixed \N{MINUS SIGN} policy) / fixed."),
    )
    published = (PAIR_11["fixed"] - PAIR_11["policy"]) / PAIR_11["fixed"]
    rows = [
        (
            text("paper: pair 11/1, Krauss"),
            *(number(v, f"{v:.3f}") for v in PAIR_11.values()),
            share(published),
        )
    ]
    verdicts = []
    for job in jobs:
        values = [job.metrics.get(f"rmse_speed/{method}", math.nan) for method in PAIR_11]
        gain = job.metrics.get("rmse_improvement/mean", math.nan)
        rows.append(
            (text(f"here: {job.name}"), *(number(v, f"{v:.3f}") for v in values), share(gain))
        )
        verdicts.append(
            f"{job.name}: {_which_pair(job)}; {_side(gain)}, in the paper it is closer by {100 * published:.1f} %."
        )
    return Comparison(
        "One pair: follower 11 behind leader 1",
        Sheet(columns, tuple(rows)),
        tuple(verdicts),
        _explanation(jobs, 1),
    )


def _which_pair(job: Job) -> str:
    table = job.pairs.drop_duplicates("pair_id")
    if len(table) == 1 and {"leader_id", "follower_id"} <= set(table.columns):
        pair = (str(table["follower_id"].iloc[0]), str(table["leader_id"].iloc[0]))
        if pair == ("11", "1"):
            return "the pair has the paper's numbers, follower 11 and leader 1"
        return f"this is another pair, follower {pair[0]} and leader {pair[1]}"
    return f"these are means over {len(table)} pairs, not the paper's one"


def _side(gain: float) -> str:
    if not math.isfinite(gain):
        return "the improvement is not defined"
    return f"the policy is {'closer' if gain > 0 else 'not closer'} to the driver than the fixed parameters ({percent(gain, 1)})"


def _pairs(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", "", number=False),
        Column("Driving model", "", number=False),
        Column("Pairs", ""),
        Column("Mean improvement", "Over the driver's own fixed parameters."),
        Column(
            "Trimmed mean",
            "Without the top and the bottom tenth, which the paper leaves out as outliers.",
        ),
    )
    rows = [
        (
            text("paper"),
            text(model),
            number(PAPER_PAIRS, str(PAPER_PAIRS)),
            Cell("below 0 %", number=True),
            Cell("", number=True),
        )
        for model in ("Krauss", "Wiedemann 99")
    ]
    verdicts = []
    for job in jobs:
        mean, trimmed = (
            job.metrics.get(f"rmse_improvement/{name}", math.nan)
            for name in ("mean", "trimmed_mean")
        )
        count = job.pairs["pair_id"].nunique()
        rows.append(
            (
                text(f"here: {job.name}"),
                text(job.component("model")),
                number(count, str(count)),
                share(mean),
                share(trimmed),
            )
        )
        below = sum(value < 0 for value in (mean, trimmed))
        agrees = {2: "below 0 %, as in the paper", 0: "not below 0 %, unlike the paper's"}.get(
            below, "below 0 % by one of the two means, and not by the other"
        )
        if math.isfinite(mean):
            verdicts.append(f"{job.name}: the average improvement is {agrees}.")
    return Comparison(
        "A network for each pair",
        Sheet(columns, tuple(rows)),
        tuple(verdicts),
        _explanation(jobs, PAPER_PAIRS),
    )


def _clusters(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", "", number=False),
        Column("Driving model", "", number=False),
        Column("Cluster", "", number=False),
        Column("Pairs", ""),
        Column(
            "Mean improvement over the population's",
            "One set of parameters, calibrated jointly on the training drivers: the paper's baseline.",
        ),
        Column(
            "Mean improvement over the driver's own",
            "A set calibrated on the driver's own first part: a harder baseline, which the paper has not.",
        ),
    )
    rows = [
        (
            text("paper"),
            text("Krauss"),
            text("each"),
            Cell("", number=True),
            Cell("above 0 %", number=True),
            Cell("", number=True),
        ),
        (
            text("paper"),
            text("Wiedemann 99"),
            text("each"),
            Cell("", number=True),
            Cell("above 0 %, up to +26 %", number=True),
            Cell("", number=True),
        ),
    ]
    gains: dict[tuple[str, str], float] = {}
    for job in jobs:
        cluster, count = str(job.setting("style.cluster") or "all"), job.pairs["pair_id"].nunique()
        gain, own = (
            job.metrics.get(f"{improvement_of(name)}/mean", math.nan)
            for name in ("population", "fixed")
        )
        rows.append(
            (
                text(f"here: {job.name}"),
                text(job.component("model")),
                text(cluster),
                number(count, str(count)),
                share(gain),
                share(own),
            )
        )
        gains[job.component("model"), cluster] = gain
    return Comparison(
        "A network for each cluster, tested on drivers it has not seen",
        Sheet(columns, tuple(rows)),
        tuple(_cluster_verdicts(gains)),
        _explanation(jobs, PAPER_PAIRS),
    )


def _cluster_verdicts(gains: Mapping[tuple[str, str], float]) -> list[str]:
    known = {key: gain for key, gain in gains.items() if math.isfinite(gain)}
    verdicts = []
    if known:
        above = sum(gain > 0 for gain in known.values())
        verdicts.append(
            f"Above 0 % in {above} of {len(known)} jobs here; in all clusters in the paper."
        )
    for model in dict.fromkeys(model for model, _ in known):
        low, high = known.get((model, CLUSTERS[0])), known.get((model, CLUSTERS[2]))
        if low is not None and high is not None:
            does = "fares better" if high > low else "fares no better"
            verdicts.append(
                f"{model}: the policy {does} with aggressive than conservative drivers here; better in the paper."
            )
    for cluster in dict.fromkeys(cluster for _, cluster in known):
        krauss, w99 = known.get(("krauss", cluster)), known.get(("w99", cluster))
        if krauss is not None and w99 is not None:
            does = "fares better" if w99 > krauss else "fares no better"
            verdicts.append(
                f"{cluster}: the policy {does} with Wiedemann 99 than with Krauss here; better in the paper."
            )
    return verdicts


def _grid(jobs: Sequence[Job]) -> Comparison:
    columns = (
        Column("", "", number=False),
        Column("Epochs", ""),
        Column("Batch size", ""),
        Column("Hidden size", ""),
        Column(
            "Best validation loss",
            "Mean over the networks of each one's lowest. The training is chosen by it, never by the test part.",
        ),
    )
    unknown = Cell("", number=True)
    rows: list[tuple[Cell, ...]] = [
        (text("paper: the best found"), number(500, "500"), number(1, "1"), unknown, unknown)
    ]
    losses = {job.name: job.metrics.get("validation_loss/best", math.nan) for job in jobs}
    for job in sorted(
        jobs, key=lambda job: (not math.isfinite(losses[job.name]), losses[job.name])
    ):
        settings = [
            str(job.setting(path))
            for path in ("learner.epochs", "learner.batch_size", "policy.hidden_size")
        ]
        rows.append(
            (
                text(f"here: {job.name}"),
                *(Cell(one, one, number=True) for one in settings),
                _loss(losses[job.name]),
            )
        )
    known = {name: loss for name, loss in losses.items() if math.isfinite(loss)}
    verdicts = (
        (f"The smallest validation loss here: {min(known, key=lambda name: known[name])}.",)
        if known
        else ()
    )
    return Comparison(
        "Grid search of the training", Sheet(columns, tuple(rows)), verdicts, _explanation(jobs, 1)
    )


def _loss(value: float) -> Cell:
    return number(value, f"{value:.4g}")


def _explanation(jobs: Sequence[Job], pairs: int) -> str:
    """Says what of the jobs' set-up is not the paper's; only what can be read off the jobs."""
    said = {
        "sources": sorted({str(job.data.get("source", "")) for job in jobs} - {""}),
        "optimizers": sorted({job.component("optimizer") for job in jobs}),
        "learners": sorted({job.component("learner") for job in jobs}),
        "epochs": sorted({str(job.setting("learner.epochs")) for job in jobs}),
        "batches": sorted({str(job.setting("learner.batch_size")) for job in jobs}),
    }
    counts = sorted({job.pairs["pair_id"].nunique() for job in jobs})
    parts = []
    if said["sources"]:
        parts.append(
            f"the recordings (here {', '.join(said['sources'])}; there NGSIM I-80, 13 April 2005, 4:00 to 4:15 p.m.)"
        )
    if counts != [pairs] and pairs > 1:
        parts.append(
            f"the number of pairs (here {' or '.join(map(str, counts))} in a job; there {pairs} in all)"
        )
    if said["optimizers"] != ["botorch"]:
        parts.append(
            f"the search (here {', '.join(said['optimizers'])}; there Bayesian optimization)"
        )
    if said["learners"] != ["imitation"]:
        parts.append(
            f"how the policy learns (here {', '.join(said['learners'])}; there from the windows' best parameters)"
        )
    if said["epochs"] != ["500"] or said["batches"] != ["1"]:
        parts.append(
            f"the training (here {' or '.join(said['epochs'])} epochs, batch size {' or '.join(said['batches'])}; there 500, 1)"
        )
    parts.append(
        "what the paper does not print, such as the parameters' bounds and the number of evaluations of its search"
    )
    listed = "; ".join(parts)
    return f"The numbers need not agree, because these things differ, or may: {listed}."
