"""The page: one HTML file with its plots, tables, scripts and styles in it."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfx.core import registry
from cfx.core.files import write_output
from cfx.data.style import CLUSTERS
from cfx.evaluation.result import Purpose
from cfx.report.figures.figure import draw, figure_named
from cfx.report.job import Job, Runs, of_purpose
from cfx.report.scripts import inline_scripts, security_policy
from cfx.report.section import MOST, Section, View, lacking
from cfx.report.summary import summary
from cfx.results.look import CLUSTER_COLOURS, COLOURS

if TYPE_CHECKING:
    from jinja2 import Environment

_ASSETS = resources.files("cfx.report") / "assets"
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
    write_output(output, render(runs, title), "the report")
    return output


def render(runs: Runs, title: str | None = None) -> str:
    """Returns the page about some jobs as HTML."""
    from markupsafe import Markup

    environment = _environment(runs)
    sections = []
    for one in registry.installed("section"):
        body = one.attempt(lambda section: _section(environment, section, runs), "")
        if body.strip():
            sections.append((one.name, one.part, Markup(body)))  # noqa: S704 - a template's
    scripts = inline_scripts([_asset(name) for name in _SCRIPTS])
    return environment.get_template("page.html.j2").render(
        title=title or _title(runs.jobs),
        written=f"{datetime.now():%d %B %Y}".lstrip("0"),
        # Nothing of a job's data is in them.
        scripts=[Markup(script) for script in scripts],  # noqa: S704
        security=security_policy(scripts),
        style=_asset("page.css") + _colours(),
        summary=summary(runs.jobs),
        jobs=len(runs.jobs),
        sections=sections,
    )


def _environment(runs: Runs) -> Environment:
    """Returns what templates are drawn with: the functions that `Section` lists."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(_asset),
    )
    environment.filters["placed"] = _placed

    environment.globals |= {
        "drawn": functools.partial(_drawn, environment),
        "caption": lambda name: figure_named(name).part.caption,
        "lacking": lambda file, what: lacking(runs.jobs, file, what),
        "most": MOST,
        "next_number": itertools.count(1).__next__,
    }
    blocks = environment.get_template("blocks.html.j2").module
    for name in ("figure", "table", "fold", "drawn_folds", "cards", "missing"):
        environment.globals[name] = getattr(blocks, name)
    return environment


def _drawn(environment: Environment, name: str, job: Job) -> Any:
    """Returns the figure of a name as the job has written it; "" if the job lacks its data."""
    found = figure_named(name)
    drawing = draw(found, job.results)
    if drawing is None:
        return ""
    figure: Any = environment.globals["figure"]
    return figure({"": View(drawing)}, found.part.title)


def _section(environment: Environment, section: Section, runs: Runs) -> str:
    context = section.context(runs)
    if context is None:
        return ""
    template = environment.from_string(section.template)
    return template.render(runs=runs, section=section, **context)


def _title(jobs: Sequence[Job]) -> str:
    """Returns a title that names the driving models."""
    subject = (
        "Calibration"
        if len(of_purpose(jobs, Purpose.CALIBRATION)) == len(jobs)
        else "Parameters that adapt"
    )
    *others, last = dict.fromkeys(job.component("model") for job in jobs)
    models = f"{', '.join(others)} and {last}" if others else last
    return f"{subject}: {models}"


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _placed(svg: str, place: str) -> Any:
    """Returns an `svg` element with ids of its own, at a place of the page."""
    from markupsafe import Markup

    from cfx.report.figures.write import PLACE

    return Markup(svg.replace(PLACE, f"{place}-"))  # noqa: S704 - Matplotlib escapes all texts


def _colours() -> str:
    """Returns the style rules for the dots of methods and clusters."""
    rules = ""
    for name, colour in [*COLOURS.items(), *zip(CLUSTERS, CLUSTER_COLOURS, strict=True)]:
        rules += f'\n[data-colour="{name}"]::before {{ background: {colour}; }}'
    return rules
