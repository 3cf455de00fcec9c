"""The page: one HTML file with its summary, plots, tables, scripts and styles in it."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cfx.plugin import Purpose, Result, colours, drawing, files, headline, registry, style, wording
from cfx_report.inline import inline_scripts, security_policy
from cfx_report.jobs import Runs, metric_title, of_purpose
from cfx_report.names import comparison_of
from cfx_report.section import MOST, Section, View, lacking

if TYPE_CHECKING:
    from jinja2 import Environment


_ASSETS = resources.files("cfx_report") / "assets"
_SCRIPTS = ("sortable/sortable.min.js", "sortable/sortable.a11y.min.js", "page.js")


def write_report(runs: Runs, output: Path, title: str | None = None) -> Path:
    """Writes the page about some jobs; returns its path.

    Args:
        runs: at least one finished job.
        output: the file; what was there is replaced once the new page is complete.
        title: of the page; None for one that names the driving models.

    Raises:
        OutputError: the page cannot be written.
    """
    files.write_output(output, render(runs, title), "the report")
    return output


def render(runs: Runs, title: str | None = None) -> str:
    """Returns the page about some jobs as HTML."""
    from markupsafe import Markup

    environment = _environment(runs)
    sections = []
    for installed in registry.installed("section"):
        body = installed.attempt(lambda section: _section(environment, section, runs), "")
        if body.strip():
            markup = Markup(body)  # noqa: S704 - a template's
            sections.append((installed.name, installed.component, markup))
    scripts = inline_scripts([asset(name) for name in _SCRIPTS])
    return environment.get_template("page.html.j2").render(
        title=title or _title(runs.jobs),
        written=f"{datetime.now():%d %B %Y}".lstrip("0"),
        # Nothing of a job's data is in them.
        scripts=[Markup(script) for script in scripts],  # noqa: S704
        security=security_policy(scripts),
        style=asset("page.css") + _colours(),
        summary=summary(runs.jobs),
        jobs=len(runs.jobs),
        sections=sections,
    )


def templates() -> Environment:
    """Returns what the templates of this folder are drawn with."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(asset),
    )
    environment.filters["placed"] = placed
    return environment


def _environment(runs: Runs) -> Environment:
    """Returns what templates are drawn with: the functions that `Section` lists."""
    environment = templates()
    environment.globals |= {
        "drawn": functools.partial(_drawn, environment),
        "caption": lambda name: drawing.figure_named(name).component.caption,
        "lacking": lambda file, what: lacking(runs.jobs, file, what),
        "most": MOST,
        "next_number": itertools.count(1).__next__,
    }
    blocks = environment.get_template("blocks.html.j2").module
    for name in ("figure", "table", "fold", "drawn_folds", "cards", "missing"):
        environment.globals[name] = getattr(blocks, name)
    return environment


def _drawn(environment: Environment, name: str, job: Result) -> Any:
    """Returns the figure of a name as the job has written it; "" if the job lacks its data."""
    drawable = drawing.figure_named(name)
    drawn = drawing.draw_figure(drawable, job)
    if drawn is None:
        return ""
    figure: Any = environment.globals["figure"]
    return figure({"": View(drawn)}, drawable.component.title)


def _section(environment: Environment, section: Section, runs: Runs) -> str:
    context = section.context(runs)
    if context is None:
        return ""
    template = environment.from_string(section.template)
    return template.render(runs=runs, section=section, **context)


def _title(jobs: Sequence[Result]) -> str:
    """Returns a title that names the driving models."""
    subject = (
        "Calibration"
        if len(of_purpose(jobs, Purpose.CALIBRATION)) == len(jobs)
        else "Parameters that adapt"
    )
    *others, last = dict.fromkeys(job.component("model") for job in jobs)
    models = f"{', '.join(others)} and {last}" if others else last
    return f"{subject}: {models}"


def asset(name: str) -> str:
    """Returns the text of a template, a style or a script of pages."""
    return (_ASSETS / name).read_text(encoding="utf-8")


def placed(svg: str, place: str) -> Any:
    """Returns an `svg` element with ids of its own, at a place of the page."""
    from markupsafe import Markup

    from cfx_report.inline import PLACE

    return Markup(svg.replace(PLACE, f"{place}-"))  # noqa: S704 - Matplotlib escapes all texts


def _colours() -> str:
    """Returns the style rules for the dots of methods and clusters."""
    rules = ""
    for name, colour in [
        *colours.COLOURS.items(),
        *zip(style.CLUSTERS, colours.CLUSTER_COLOURS, strict=True),
    ]:
        rules += f'\n[data-colour="{name}"]::before {{ background: {colour}; }}'
    return rules


_MOST = 3
"""Up to so many jobs have a sentence each."""


def summary(jobs: Sequence[Result]) -> list[str]:
    """Returns sentences: against driver-specific calibration, and against pooled calibration."""
    first = (
        f"{_amount(jobs)}: is a policy that adapts the parameters closer to the real driver than"
        f" {wording.explained('driver_specific')}?"
    )
    compared = of_purpose(jobs, Purpose.ADAPTATION)
    warnings = _few(compared)
    references = [_reference(job) for job in of_purpose(jobs, Purpose.POLICY)]
    constant = of_purpose(jobs, Purpose.CALIBRATION)
    if not compared and not references:
        first = f"{_amount(jobs)}: how close does the driving model come with constant parameters?"
    if len(constant) <= _MOST:
        references += [_calibration(job) for job in constant]
    else:
        references.append(f"{len(constant)} jobs are calibrations, without adaptation.")
    if len(jobs) > 1:
        references += comparison_of(jobs).sentences()
    if len(compared) <= _MOST:
        return [first, *map(_verdict, compared), *warnings, *references]
    counts = f"{_counts(compared)} (by the 95 % interval of the improvement)."
    return [first, counts, *warnings, *references]


def _few(jobs: Sequence[Result]) -> list[str]:
    """Returns a warning if any of the jobs compares its policy on few drivers."""
    if not jobs:
        return []
    fewest = min(job.pairs["driver"].nunique() for job in jobs)
    warning = wording.few_drivers(fewest)
    return [warning] if warning else []


def _counts(jobs: Sequence[Result]) -> str:
    """Returns in how many jobs the policy is closer, over each of two baselines."""
    sentences = []
    for baseline, against in (
        ("driver_specific", f"Of {len(jobs)} jobs"),
        ("pooled", "against pooled calibration"),
    ):
        sides = [_side(job, baseline) for job in jobs if baseline in job.baselines()]
        if sides:
            yes, no, undecided = map(sides.count, ("yes", "no", "undecided"))
            sentences.append(f"{against}: yes in {yes}, no in {no}, undecided in {undecided}")
    return "; ".join(sentences)


def _reference(job: Result) -> str:
    """Says what a policy reaches that sets the acceleration itself."""
    speed, gap = job.metric("rmse_speed", "policy"), job.metric("rmse_gap", "policy")
    return (
        f"{job.name}: the policy sets the acceleration itself. RMSE of speed {speed:.3f} m/s, of"
        f" gap {gap:.2f} m: an upper reference for the models that follow."
    )


def _calibration(job: Result) -> str:
    """Says how close constant parameters come."""
    judge, errors = job.judge, []
    for method in job.methods:
        error = job.metric(judge.name, method)
        if method != "policy" and np.isfinite(error):
            errors.append(f"{wording.short_label(method)} {error:.3f}")
    return (
        f"{job.name}: a calibration; its parameters stay constant. {metric_title(judge)}:"
        f" {', '.join(errors)}."
    )


def _amount(jobs: Sequence[Result]) -> str:
    pairs: set[tuple[str, str]] = set()
    sources: dict[str, None] = {}
    for job in jobs:
        source = str(job.data.get("source", ""))
        if source:
            sources[source] = None
        for pair in job.pairs["pair_id"].unique():
            pairs.add((source, pair))
    where = f" from {Path(next(iter(sources))).name}" if len(sources) == 1 else ""
    return f"{wording.plural(len(pairs), 'pair')} of leader and follower{where}"


def _side(job: Result, baseline: str = "driver_specific") -> str:
    if job.statistics(baseline).ci95_low > 0:
        return "yes"
    return "no" if job.statistics(baseline).ci95_high < 0 else "undecided"


def _verdict(job: Result) -> str:
    if not np.isfinite(job.statistics("driver_specific").geometric):
        return f"{job.name}: no pair has a defined improvement."
    pooled = ""
    if "pooled" in job.baselines():
        pooled = f"; over pooled calibration {_gain(job, 'pooled')}"
    gain = _gain(job, "driver_specific")
    return f"{job.name}: {_side(job)}. Improvement of the {job.judge.heading}: {gain}{pooled}."


def _gain(job: Result, baseline: str) -> str:
    improvement = job.statistics(baseline)
    low, high = improvement.ci95_low, improvement.ci95_high
    if not np.isfinite(improvement.geometric):
        return "not defined"
    certainty = "no interval for a single driver"
    if np.isfinite(low):
        certainty = f"95 % interval {wording.percent_interval(low, high)}"
    gain = f"{wording.percent(improvement.geometric, 1)} ({certainty})"
    note = headline.summaries_disagree(improvement.geometric, improvement.ratio_of_means)
    note = note.replace("-", wording.MINUS)
    return f"{gain}, {note}" if note else gain
