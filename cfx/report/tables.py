"""The tables of a report, with the words that say what each column is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from cfx.evaluation.result import Improvement
from cfx.figures.look import percent
from cfx.report.read import Job, improvement_of
from cfx.style.result import CLUSTERS

NOTHING = "\N{EN DASH}"
BASELINES = {
    "default": "the model's default parameters",
    "population": "one set of parameters for all, calibrated jointly on the training drivers",
    "fixed": "the driver's own fixed parameters, calibrated on the first part of his own drive",
    "shrunk": "the driver's own fixed parameters shrunk towards the default, which the policy starts from",
}
"""What the policy is compared with, in words that end a sentence."""

SHORT = {"fixed": "own fixed", "shrunk": "own, shrunk"}
"""Methods in a table, where their own name says too little."""


@dataclass(frozen=True)
class Cell:
    """What a table shows, and by what it is sorted; `second` is a smaller line below, `best` marks the best of a column."""

    text: str
    sort: str = ""
    number: bool = False
    colour: str = ""
    second: str = ""
    best: bool = False


@dataclass(frozen=True)
class Column:
    """A column: its heading, and what it is in a sentence a reader needs no other document for."""

    heading: str
    meaning: str
    number: bool = True


@dataclass(frozen=True)
class Sheet:
    """A table; one cell per column in each row. `groups` are headings above the columns, each with how many it spans."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    groups: tuple[tuple[str, int], ...] = ()

    def explained(self) -> tuple[Column, ...]:
        """Returns the columns that have something to explain."""
        return tuple(column for column in self.columns if column.meaning)


def text(value: object) -> Cell:
    """Returns a cell with a text, sorted as one."""
    return Cell(str(value) or NOTHING)


def number(value: float, shown: str) -> Cell:
    """Returns a cell with a number; one that is not defined is sorted last."""
    known = math.isfinite(value)
    return Cell(shown if known else NOTHING, repr(float(value)) if known else "", number=True)


def share(value: float) -> Cell:
    """Returns a cell with a signed percentage."""
    return number(value, percent(value, 1))


def tested(jobs: Iterable[Job]) -> str:
    """Says which frames the errors are measured on, for instance "the last 20 % of each pair's frames"."""
    splits = sorted({job.split for job in jobs if math.isfinite(job.split)})
    parts = " or ".join(f"{100 * (1 - split):.3g}" for split in splits)
    return (
        f"the last {parts} % of each pair's frames"
        if parts
        else "the test part of each pair's frames"
    )


def errors(jobs: Sequence[Job]) -> Sheet:
    """Returns the errors: a row per job and method. The numbers are those of `metrics.json`."""
    frames = tested(jobs)
    columns = [
        Column("Job", "", number=False),
        Column("Method", f"{_methods(jobs)}.", number=False),
        Column("Pairs", "Pairs of a leader and a follower; the means are taken over them."),
        Column(
            "RMSE of speed (m/s)",
            f"Root mean square difference between the simulated and the measured speed of the follower over {frames}, driven in"
            " closed loop from the last measured state on: the simulation sees the leader, never the measured follower. Mean over"
            " the pairs. Every method drives the same frames from the same state.",
        ),
        Column("RMSE of gap (m)", "The same for the gap, bumper to bumper."),
        Column("Collisions", "Pairs in which the simulated gap becomes negative on these frames."),
    ]
    whole = any(job.baselines("whole/") for job in jobs)
    if whole:
        meaning = "The same over the whole drive of drivers that nothing was fitted to, from its first frame on."
        columns += [
            Column(
                "Whole drive: RMSE of speed (m/s)",
                meaning + " The driver's own fixed parameters do not compete here.",
            ),
            Column("Whole drive: RMSE of gap (m)", "The same for the gap."),
        ]
    rows = [
        _error_row(job, method, whole)
        for job in jobs
        for method in (job.methods if job.has_constant_baseline else ("policy",))
    ]
    return Sheet(tuple(columns), tuple(rows))


def _methods(jobs: Sequence[Job]) -> str:
    said = BASELINES | {"policy": "parameters that the policy chooses anew as it drives"}
    return "; ".join(
        f"{SHORT.get(m, m)}: {said.get(m, m)}"
        for m in dict.fromkeys(m for job in jobs for m in job.methods)
    )


def _error_row(job: Job, method: str, whole: bool) -> tuple[Cell, ...]:
    def value(name: str) -> float:
        return job.metrics.get(f"{name}/{method}", math.nan)

    pairs = int((job.pairs["method"] == method).sum())
    collisions = value("collisions")
    row = [
        text(job.name),
        Cell(SHORT.get(method, method), colour=method),
        number(pairs, str(pairs)),
        number(value("rmse_speed"), f"{value('rmse_speed'):.3f}"),
        number(value("rmse_gap"), f"{value('rmse_gap'):.3f}"),
        number(collisions, f"{collisions:.0f}"),
    ]
    if whole:
        row += [
            number(value(f"whole/{name}"), f"{value(f'whole/{name}'):.3f}")
            for name in ("rmse_speed", "rmse_gap")
        ]
    return tuple(row)


def improvements(jobs: Sequence[Job]) -> Sheet:
    """Returns the policy's improvement: a row per job, baseline and kind of frames. The numbers are those of `metrics.json`."""
    whole = any(job.baselines("whole/") for job in jobs)
    present = dict.fromkeys(
        baseline for job in jobs for where in ("", "whole/") for baseline in job.baselines(where)
    )
    against = "; ".join(f"{SHORT.get(name, name)}: {BASELINES.get(name, name)}" for name in present)
    frames = f"The frames that count: test part: {tested(jobs)}"
    columns = (
        Column("Job", "", number=False),
        Column("Policy against", f"The baseline. {against}.", number=False),
        *(
            (
                Column(
                    "Frames",
                    f"{frames}; whole drive: from its first frame on, of unseen drivers.",
                    number=False,
                ),
            )
            if whole
            else ()
        ),
        Column(
            "Mean",
            "Improvement of a pair: (RMSE of the baseline \N{MINUS SIGN} RMSE of the policy) / RMSE of the baseline, RMSE of the"
            f" speed over {tested(jobs)}. Above 0 the policy is closer to the real driver. Here the mean over the pairs.",
        ),
        Column(
            "95 % interval",
            "Bootstrap confidence interval of that mean; drivers are drawn, each with all his pairs.",
        ),
        Column(
            "Trimmed mean",
            "Mean without the top and the bottom tenth of the pairs, as the paper averages.",
        ),
        Column("Median", "Half of the pairs improve more."),
        Column("Better for", "Share of the pairs with an improvement above 0."),
        Column(
            "p", "Two-sided Wilcoxon signed-rank test of the baseline's RMSE against the policy's."
        ),
        Column(
            "Pairs",
            "Pairs that count. One does not if the baseline drives it without error, or a simulation diverges.",
        ),
    )
    kinds = [(baseline, where) for where in ("", "whole/") for baseline in present]
    rows = [
        _improvement_row(job, b, where, whole)
        for b, where in kinds
        for job in jobs
        if b in job.baselines(where)
    ]
    return Sheet(columns, tuple(rows))


def _improvement_row(job: Job, baseline: str, where: str, whole: bool) -> tuple[Cell, ...]:
    def value(name: str) -> float:
        return job.metrics.get(f"{improvement_of(baseline, where)}/{name}", math.nan)

    count = counted(job, baseline, where)
    frames = (
        (text("whole\N{NO-BREAK SPACE}drive" if where else "test\N{NO-BREAK SPACE}part"),)
        if whole
        else ()
    )
    return (
        text(job.name),
        Cell(SHORT.get(baseline, baseline), colour=baseline),
        *frames,
        share(value("mean")),
        interval(value("ci95_low"), value("ci95_high")),
        share(value("trimmed_mean")),
        share(value("median")),
        number(value("win_rate"), f"{100 * value('win_rate'):.0f} %"),
        number(value("p_value"), probability(value("p_value"))),
        number(count, str(count)),
    )


def counted(job: Job, baseline: str, where: str = "") -> int:
    """Returns the number of pairs whose improvement over a baseline is defined."""
    if not where:
        return int(
            np.isfinite(job.by_pair.get(f"improvement/{baseline}", pd.Series(dtype=float))).sum()
        )
    speeds = job.pairs.pivot_table(
        index="pair_id", columns="method", values="full_trajectory_rmse_speed", aggfunc="first"
    )
    before, after = (speeds.get(method, pd.Series(dtype=float)) for method in (baseline, "policy"))
    return int((np.isfinite(before) & np.isfinite(after) & (before > 0)).sum())


def interval(low: float, high: float) -> Cell:
    """Returns a cell with an interval, sorted by its lower end."""
    known = math.isfinite(low) and math.isfinite(high)
    return Cell(
        f"{percent(low, 1)} to {percent(high, 1)}" if known else NOTHING,
        repr(low) if known else "",
        number=True,
    )


def probability(value: float) -> str:
    """Returns a p value as one writes it."""
    return "< 0.0001" if value < 1e-4 else f"{value:.2g}"


def clusters(series: Mapping[str, Mapping[str, pd.DataFrame]], baseline: str) -> Sheet:
    """Returns the improvement by cluster.

    Args:
        series: by name and cluster, some rows of `Job.by_pair`.
        baseline: what the policy is compared with.
    """
    columns = (
        Column("Jobs", "", number=False),
        Column(
            "Cluster",
            "A quarter of the drivers, a half and a quarter by style score, unless the cuts say otherwise.",
            number=False,
        ),
        Column("Pairs", "Pairs of drivers of this cluster whose improvement is defined."),
        Column("Mean", f"Improvement over {BASELINES.get(baseline, baseline)}."),
        Column("95 % interval", "Of the mean, as above."),
        Column("Trimmed mean", "As above."),
        Column("Median", "As above."),
        Column("Better for", "As above."),
    )
    rows = []
    for name, by_cluster in series.items():
        for cluster, table in by_cluster.items():
            if (
                f"rmse_speed/{baseline}" not in table
            ):  # these jobs have no such baseline; others beside them have
                continue
            found = statistics(table, baseline)
            rows.append(
                (
                    text(name),
                    Cell(
                        cluster,
                        str(CLUSTERS.index(cluster)) if cluster in CLUSTERS else cluster,
                        colour=cluster,
                    ),
                    number(found.pairs, str(found.pairs)),
                    share(found.mean),
                    interval(found.ci95_low, found.ci95_high),
                    share(found.trimmed_mean),
                    share(found.median),
                    number(found.win_rate, f"{100 * found.win_rate:.0f} %"),
                )
            )
    return Sheet(columns, tuple(rows))


def statistics(table: pd.DataFrame, baseline: str) -> Improvement:
    """Returns the statistics over some pairs, as an evaluation makes them.

    Args:
        table: some rows of `Job.by_pair`.
        baseline: what the policy is compared with.
    """
    from cfx.evaluation.statistics import improvement_statistics  # imports scipy

    before, after = (
        table[f"rmse_speed/{method}"].to_numpy(dtype=float) for method in (baseline, "policy")
    )
    return improvement_statistics(
        before, after, [str(driver) for driver in table["driver"]], seed=0
    )
