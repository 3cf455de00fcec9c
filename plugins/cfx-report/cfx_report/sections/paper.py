"""Published numbers beside a job's, where the job ran one of a paper's experiments.

`published.json` has the paper's numbers, what a column shows of a job, and what differs between the
paper's set-up and a job's: another paper is another such file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import resources
from operator import itemgetter
from typing import Any

from cfx.plugin import Result, job_folder, wording
from cfx_report.jobs import Runs
from cfx_report.section import Cell, Column, Section, Sheet, number, text


class PaperSection(Section):
    """Published numbers beside a job's, where the job ran one of a paper's experiments."""

    title = "The paper's numbers beside these"
    entry = "The paper's numbers"
    order = 1100

    template = """
<p>{{ paper.citation }}</p>
{% for experiment in experiments %}
<h3>{{ experiment.heading }}</h3>
{{ table(experiment.sheet, sortable=false) }}
<ul>{% for words in experiment.verdicts %}<li>{{ words }}</li>{% endfor %}</ul>
<p>{{ experiment.differences }}</p>
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return a comparison for each of the paper's experiments among the jobs."""
        paper = published()
        experiments = []
        for experiment, about in paper["experiments"].items():
            jobs = [job for job in runs.jobs if job.setting("preset") == experiment]
            if "ranked" in about:
                jobs = _ranked(jobs, about["ranked"])
            if jobs:
                experiments.append(
                    {
                        "heading": about["heading"],
                        "sheet": comparison(about, jobs),
                        "verdicts": verdicts(about, jobs),
                        "differences": differences(paper, about, jobs),
                    }
                )
        return {"paper": paper, "experiments": experiments} if experiments else None


def published() -> dict[str, Any]:
    """Return what `published.json` holds."""
    file = resources.files("cfx_report.sections") / "published.json"
    figures: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return figures


def comparison(about: Mapping[str, Any], jobs: Sequence[Result]) -> Sheet:
    """Return the paper's rows of an experiment, and a row per job; names stand first."""
    rows = [("paper", *row) for row in about["published"]]
    for job in jobs:
        values = [value_of(job, column["value"]) for column in about["columns"]]
        rows.append((f"here: {job.name}", *values))
    columns: list[Column[Sequence[Any]]] = [Column("", itemgetter(0))]
    for place, column in enumerate(about["columns"], start=1):
        cell = partial(_cell, place, column.get("form", ""))
        columns.append(Column(column["heading"], cell, column.get("meaning", "")))
    return Sheet.of(columns, rows)


def value_of(job: Result, path: str) -> Any:
    """Return what a column shows of a job: a text or a number, NaN where it is not known.

    Args:
        job: of the report.
        path: `source`, `pair`, `pairs`, `component/GROUP`, `setting/PATH`, `metric/KEY` or
            `improvement/STATISTIC/BASELINE`.
    """
    kind, *rest = path.split("/")
    readers: dict[str, Callable[..., Any]] = {
        "component": job.component,
        "setting": job.setting,
        "metric": lambda *parts: job.metrics.get("/".join(parts), math.nan),
        "improvement": lambda name, over: getattr(job.statistics(over), name),
        "source": lambda: job_folder.without_folders(str(job.data.get("source", ""))),
        "pairs": job.pairs["pair_id"].nunique,
        "pair": lambda: _pair(job),
    }
    return readers[kind](*rest)


def _pair(job: Result) -> str:
    """Return the numbers of a single pair, or how many there are."""
    table = job.pairs.drop_duplicates("pair_id")
    if len(table) > 1 or not {"follower_id", "leader_id"} <= set(table.columns):
        return wording.plural(len(table), "pair")
    return f"{table['follower_id'].iloc[0]}/{table['leader_id'].iloc[0]}"


def verdicts(about: Mapping[str, Any], jobs: Sequence[Result]) -> list[str]:
    """Return what the jobs say of the paper's claim, and the claim."""
    sentences = []
    if about["judged"]:
        measured = above = 0
        for job in jobs:
            gain = float(value_of(job, about["judged"]))
            in_words = wording.percent_or_undefined(gain, 1)
            sentences.append(f"{job.name}: mean of the ratios {in_words}.")
            measured += math.isfinite(gain)
            above += math.isfinite(gain) and gain > 0
        if measured > 1:
            sentences.append(f"Above 0 % in {above} of {measured} jobs here.")
    if "ranked" in about and math.isfinite(value_of(jobs[0], about["ranked"])):
        sentences.append(f"The smallest of the last column here: {jobs[0].name}.")
    for better in about.get("better", ()):
        sentences += _compared(better, about["judged"], jobs)
    return [*sentences, about["claim"]]


def _ranked(jobs: Sequence[Result], path: str) -> list[Result]:
    """Return the jobs by a number, the smallest first, those where it is not known last."""

    def place(job: Result) -> tuple[bool, float]:
        value = value_of(job, path)
        return not math.isfinite(value), value

    return sorted(jobs, key=place)


def _compared(better: Mapping[str, str], judged: str, jobs: Sequence[Result]) -> list[str]:
    """Say whether the policy fares better with one value than with another, others being equal."""
    gains: dict[str, dict[str, float]] = {}  # by what jobs share, then by what is compared
    for job in jobs:
        gain = value_of(job, judged)
        if math.isfinite(gain):
            gains_of_equals = gains.setdefault(str(value_of(job, better["same"])), {})
            gains_of_equals[str(value_of(job, better["value"]))] = gain
    sentences = []
    for shared, gain_of in gains.items():
        if {better["with"], better["than"]} <= set(gain_of):
            verdict = "no better"
            if gain_of[better["with"]] > gain_of[better["than"]]:
                verdict = "better"
            sentences.append(
                f"{shared}: the policy fares {verdict} with {better['with']} than with"
                f" {better['than']} here; better in the paper."
            )
    return sentences


def differences(paper: Mapping[str, Any], about: Mapping[str, Any], jobs: Sequence[Result]) -> str:
    """Say what of the jobs' set-up is not the paper's; only what can be read off the jobs."""
    pairs = about["pairs"]
    listed = list(paper["differences"])
    if pairs > 1:
        number_of = {"what": "the number of pairs", "value": "pairs", "there": f"{pairs} in all"}
        listed.insert(1, {**number_of, "same": str(pairs)})
    differing = []
    for condition in listed:
        values = {str(value_of(job, condition["value"])) for job in jobs}
        values.discard("")  # of jobs of which it is not known
        if values and values != {condition["same"]}:
            here = " or ".join(sorted(values))
            differing.append(f"{condition['what']} (here {here}; there {condition['there']})")
    differing.append(paper["unknown"])
    return (
        f"The numbers need not agree, because these things differ, or may: {'; '.join(differing)}."
    )


def _cell(place: int, form: str, row: Sequence[Any]) -> Cell:
    value = row[place]
    if not form:
        return text(value)
    if isinstance(value, int | float):
        return number(value, form)
    return Cell("" if value is None else str(value), number=True)
