"""Sections that show figures, with little else: errors over time, style, learning, history."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from cfx.core import registry
from cfx.report.figures.history import BASE_LABELS, history_curves
from cfx.report.figures.text import plural
from cfx.report.job import Job, Runs
from cfx.report.section import MOST, Section
from cfx.report.tables import Column, Sheet, interval, job_names, number


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
    figures = ("style_distribution",)
    template = """
<p>{{ caption("style_distribution") }}</p>
{{ cards("style_distribution", scorings) }}
{{ missing("style.csv", "the distribution of the style scores") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return a job for each scoring of the drivers, with the names of those it holds for."""
        jobs: dict[str, list[Job]] = {}
        for job in runs.jobs:
            if len(job.tables.get("style", ())):
                table = job.tables["style"][["driver", "score", "cluster"]].to_csv()
                scoring = hashlib.sha256(table.encode()).hexdigest()
                jobs.setdefault(scoring, []).append(job)
        named = len(jobs) > 1
        scorings = [(job_names(one) if named else "", "", one[0]) for one in jobs.values()]
        return {"scorings": scorings}


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

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the jobs that learned something with the number of networks, and the others."""
        learned, without = [], []
        for job in runs.jobs:
            table = job.tables.get("curves")
            if table is not None and len(table):
                networks = plural(int(table["network"].nunique()), "network")
                learned.append((job.name, f"({networks})", job))
            elif table is not None:
                without.append(job)
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
            for one in history_curves(job.tables["history"]).to_dict("records"):
                rows.append({"job": job.name, **{str(key): one[key] for key in one}})
        varied = [(job.name, "", job) for job in jobs]
        return {"varied": varied, "amounts": Sheet.of(_AMOUNTS, rows)} if jobs else None


_AMOUNTS: tuple[Column[dict[str, Any]], ...] = (
    Column("Job", lambda row: row["job"]),
    Column(
        "Base",
        lambda row: BASE_LABELS.get(row["base"], str(row["base"])),
        "What the policy's answers are offsets from.",
    ),
    Column(
        "Burn-in",
        lambda row: row["amount"],
        "Measured history before the test part; a share is of the full trajectory.",
    ),
    Column(
        "Mean",
        lambda row: number(row["mean"], "+.1%"),
        "Mean improvement of the RMSE of speed over driver-specific calibration, test part.",
    ),
    Column(
        "95 % interval",
        lambda row: interval(row["low"], row["high"]),
        "Bootstrap confidence interval of the mean; drivers are resampled, each with all their"
        " pairs.",
    ),
    Column("Pairs", lambda row: number(row["pairs"], "d"), "Pairs whose improvement is defined."),
)


class FurtherSection(Section):
    """Figures of other distributions that no section shows."""

    title = "Further figures"
    entry = "Further figures"
    order = 1900
    template = """
{% for figure in further %}
{% set folds = drawn_folds(figure.name, runs.jobs) | trim %}
{% if folds %}
<h3>{{ figure.part.title }}</h3>
<p>{{ figure.part.caption }}</p>
{{ folds }}
{% endif %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the figures."""
        shown: set[str] = set()
        for section in registry.installed("section"):
            shown |= set(section.part.figures)
        further = []
        for one in registry.installed("figure"):
            if one.distribution != registry.OWN and one.name not in shown:
                further.append(one)
        return {"further": further}
