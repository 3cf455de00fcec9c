"""Sections that show figures, with little else: trajectories, errors, style, learning, history."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any

from cfx.plugin import (
    Purpose,
    Result,
    distributions,
    pair_lines,  # pair_lines
    registry,
    style,
    wording,
)
from cfx_report.figures.history import history_curves
from cfx_report.jobs import Runs, are_calibrations, metric_title, of_purpose
from cfx_report.section import MOST, Column, Section, Sheet, View, interval, job_names, number


class ErrorsSection(Section):
    """How errors grow from the measured state on."""

    title = "Errors over time"
    entry = "Errors over time"
    order = 1700
    figures = ("error_over_time",)


class StyleSection(Section):
    """Driving style of all drivers."""

    title = "Driving style"
    entry = "Driving style"
    order = 1500
    figures = ("style_distribution", "site_styles")
    template = """
<p>{{ caption("style_distribution") }}</p>
{{ cards("style_distribution", scorings) }}
{% if by_site %}
<p>{{ caption("site_styles") }}</p>
{{ cards("site_styles", by_site) }}
{{ table(distances) }}
{% endif %}
{{ missing("style.csv", "the distribution of the style scores") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return a job for each scoring of the drivers, with the names of those it holds for."""
        jobs: dict[str, list[Result]] = {}
        for job in runs.jobs:
            if len(job.tables.get("style", ())):
                table = job.tables["style"][["driver", "score", "cluster"]].to_csv()
                scoring = hashlib.sha256(table.encode()).hexdigest()
                jobs.setdefault(scoring, []).append(job)
        named = len(jobs) > 1
        scorings, by_site = [], []
        for alike in jobs.values():
            names = job_names(alike) if named else ""
            scorings.append((names, "", alike[0]))
            if "style_distances" in alike[0].tables:
                by_site.append((names, "", alike[0]))
        rows: list[dict[str, Any]] = []
        for name, _, job in by_site:
            for row in job.tables["style_distances"].to_dict("records"):
                rows.append({"jobs": name, **{str(key): row[key] for key in row}})
        distances = Sheet.of(_DISTANCES if named else _DISTANCES[1:], rows)
        return {"scorings": scorings, "by_site": by_site, "distances": distances}


def _group(row: Mapping[str, Any], prefix: str) -> str:
    site, kind = row[f"{prefix}site"], row[f"{prefix}driver_type"]
    return str(site) if kind == style.ALL_TYPES else f"{site}, {kind}"


_DISTANCES: tuple[Column[dict[str, Any]], ...] = (
    Column("Jobs", lambda row: row["jobs"]),
    Column("Drivers", lambda row: _group(row, "")),
    Column("Compared with", lambda row: _group(row, "other_")),
    Column(
        "Distance",
        lambda row: number(row["distance"], ".3f"),
        "Energy distance between the distributions of their style scores.",
    ),
    Column(
        "p",
        lambda row: number(row["p_value"], ".3f"),
        "Of a permutation of the drivers, corrected for all comparisons.",
    ),
    Column(
        "Differ most in",
        lambda row: style.name_of_indicator(str(row["most"])),
        "The indicator whose normalised values, times its weight, are furthest apart.",
    ),
)


class LearningSection(Section):
    """Learning curves."""

    title = "Learning curves"
    entry = "Learning curves"
    order = 1800
    figures = ("learning_curve",)
    template = """
<p>{{ caption("learning_curve") }}</p>
{{ cards("learning_curve", learned) }}
{% if without %}<p class="fine">Nothing was learned in {{ without }}.</p>{% endif %}
{{ missing("curves.parquet", "the learning curves") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the jobs that learned something with the number of networks, and the others."""
        learned, without = [], []
        for job in runs.jobs:
            table = job.tables.get("curves")
            if table is not None and len(table):
                networks = wording.plural(int(table["network"].nunique()), "network")
                learned.append((job.name, f"({networks})", job))
            elif table is not None:
                without.append(job)
        if not learned and are_calibrations(runs.jobs):
            return None
        names = job_names(without) if len(without) <= MOST else f"{len(without)} jobs"
        return {"learned": learned, "without": names}


class HistorySection(Section):
    """How much burn-in the policy needs."""

    title = "How much history the policy needs"
    entry = "History"
    order = 1000
    figures = ("history",)
    template = """
<p>{{ caption("history") }}</p>
{{ cards("history", varied) }}
{{ table(amounts) }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return the jobs that varied the history, and a row per job, base and amount."""
        jobs = [job for job in runs.jobs if "history" in job.tables]
        rows: list[dict[str, Any]] = []
        for job in jobs:
            for amount in history_curves(job.tables["history"]).to_dict("records"):
                rows.append({"job": job.name, **{str(key): amount[key] for key in amount}})
        varied = [(job.name, "", job) for job in jobs]
        return {"varied": varied, "amounts": Sheet.of(_AMOUNTS, rows)} if jobs else None


_AMOUNTS: tuple[Column[dict[str, Any]], ...] = (
    Column("Job", lambda row: row["job"]),
    Column(
        "Base",
        lambda row: wording.method_label(row["base"]),
        "What the policy's answers are offsets from.",
    ),
    Column(
        "Burn-in",
        lambda row: row["amount"],
        "Measured history before the test part; a share is of the full trajectory.",
    ),
    Column(
        "Improvement",
        lambda row: number(row["geometric"], "+.1%"),
        "Over driver-specific calibration on the test part, geometric over drivers.",
    ),
    Column(
        "95 % interval",
        lambda row: interval(row["low"], row["high"]),
        "Confidence interval over drivers.",
    ),
    Column("Pairs", lambda row: number(row["pairs"], "d"), "Pairs whose improvement is defined."),
)


class FurtherSection(Section):
    """Figures of other distributions that a job has drawn and no section shows."""

    title = "Further figures"
    entry = "Further figures"
    order = 1900
    template = """
{% for figure in further %}
{% set folds = drawn_folds(figure.name, runs.jobs) | trim %}
{% if folds %}
<h3>{{ figure.component.title }}</h3>
<p>{{ figure.component.caption }}</p>
{{ folds }}
{% endif %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the figures."""
        shown: set[str] = set()
        for section in registry.installed("section"):
            shown |= set(section.component.figures)
        drawn: set[str] = set()
        for job in runs.jobs:
            drawn |= {path.stem for path in job.figures}
        further = []
        for figure in registry.installed("figure"):
            is_other = figure.distribution not in {distributions.OWN, "cfx-report"}
            if is_other and figure.name in drawn - shown:
                further.append(figure)
        return {"further": further}


class TrajectoriesSection(Section):
    """Speed, gap and parameters of the best, the median and the worst pair over time."""

    title = "Trajectories"
    entry = "Trajectories"
    order = 1600
    template = """
<p>
{% if adapting %}
The pair that improves most over driver-specific calibration, the one in the middle and the one that
improves least, on the test part.
{% endif %}
{% if constant %}
Of a calibration: the pairs with the least, the median and the largest error.
{% endif %}
What lies outside a parameter's bounds is shaded.
</p>
{% for job in jobs %}
{% call fold(job.name, loop.first, "job") %}
{% for pair in chosen(job) %}
<div class="pair">
<h3>{{ title(job, pair) }} <span class="fine">{{ errors(job, pair) }}</span></h3>
{{ figure(view(job, pair.pair_id), "Speed, gap and parameters of pair " ~ pair.pair_id) }}
</div>
{% endfor %}
{% endcall %}
{% endfor %}
{{ missing("trajectories.parquet", "speed, gap and parameters over time") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the jobs that kept their trajectories, and what is shown of their pairs."""
        jobs = [job for job in runs.jobs if "trajectories" in job.tables]
        constant = of_purpose(jobs, Purpose.CALIBRATION)
        shown = {
            "chosen": chosen_pairs,
            "title": _title,
            "errors": _errors_of_pair,
            "view": pair_of,
        }
        adapting = len(constant) < len(jobs)
        return {"jobs": jobs, "adapting": adapting, "constant": bool(constant), **shown}


def chosen_pairs(job: Result) -> tuple[pair_lines.RankedPair, ...]:
    """Returns the best, the median and the worst pair; fewer if there are fewer."""
    present = [trajectory.pair_id for trajectory in job.trajectories]
    table = job.by_pair[job.by_pair["pair_id"].isin(present)]
    if job.purpose is Purpose.CALIBRATION:
        gains = -table[f"{job.judge.name}/{job.judged}"].to_numpy(dtype=float)
    else:
        gains = table["improvement/driver_specific"].to_numpy(dtype=float)
    return pair_lines.rank_pairs(table["pair_id"].astype(str).tolist(), gains)


def pair_of(job: Result, pair_id: str) -> dict[str, View]:
    """Speed, gap and each tuned parameter of one pair of a job."""
    return {"": View(pair_lines.draw_pair(job, pair_id))}


def _title(job: Result, pair: pair_lines.RankedPair) -> str:
    title = pair.title[:1].upper() + pair.title[1:]
    if job.purpose is Purpose.ADAPTATION and math.isfinite(pair.improvement):
        improvement = wording.percent(pair.improvement, 1)
        title += f": {improvement} over {wording.short_label('driver_specific')} calibration"
    return title


def _errors_of_pair(job: Result, pair: pair_lines.RankedPair) -> str:
    row = job.by_pair.set_index("pair_id").loc[pair.pair_id]
    errors = []
    for method in job.shown_methods:
        errors.append(f"{wording.short_label(method)} {row[f'{job.judge.name}/{method}']:.3f}")
    return f"{metric_title(job.judge)}: {', '.join(errors)}"
