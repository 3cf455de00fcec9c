"""The page: one HTML file with its plots, tables, scripts and styles in it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any

from cfx.core import registry
from cfx.core.files import write_output
from cfx.data.style import CLUSTERS
from cfx.evaluation.result import Purpose
from cfx.report.blocks import Block
from cfx.report.job import Runs, of_purpose
from cfx.report.scripts import inline_scripts, security_policy
from cfx.report.summary import summary
from cfx.results.look import CLUSTER_COLOURS, COLOURS

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
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(_asset),
    )
    environment.filters["placed"] = _placed
    return environment.get_template("page.html.j2").render(_content(runs, title))


def _content(runs: Runs, title: str | None) -> dict[str, Any]:
    from markupsafe import Markup

    scripts = inline_scripts([_asset(name) for name in _SCRIPTS])
    sections = []
    for one in registry.installed("section"):
        blocks: Sequence[Block] = one.attempt(lambda section: section.blocks(runs), ())
        if blocks:
            sections.append((one, blocks))
    subject = "Parameters that adapt"
    if len(of_purpose(runs.jobs, Purpose.CALIBRATION)) == len(runs.jobs):
        subject = "Calibration"
    *others, last = dict.fromkeys(job.component("model") for job in runs.jobs)
    models = last
    if others:
        models = f"{', '.join(others)} and {last}"
    return {
        "title": title or f"{subject}: {models}",
        "written": f"{datetime.now():%d %B %Y}".lstrip("0"),
        # Nothing of a job's data is in them.
        "scripts": [Markup(script) for script in scripts],  # noqa: S704
        "security": security_policy(scripts),
        "style": _asset("page.css") + _colours(),
        "summary": summary(runs.jobs),
        "jobs": len(runs.jobs),
        "sections": sections,
    }


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
