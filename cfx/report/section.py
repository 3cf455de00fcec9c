"""What a section of the report is: a template, and what the template shows of some jobs.

An entry point of the group `cfx.sections` makes it known; its name becomes its anchor in the page.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from cfx.core.component import Component
from cfx.report.job import Job, Runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class View:
    """One view of a figure of which the reader chooses, and what must be said below it."""

    drawing: Figure
    note: str = ""

    @property
    def svg(self) -> str:
        """The drawing as an `svg` element."""
        from cfx.report.figures.write import inline_svg

        return inline_svg(self.drawing)


class Section(Component):
    """A section of the page about finished jobs.

    Its template is Jinja's; what stands between braces is escaped. Beside what `context` gives, it
    has `runs` and these functions:

    - `table(sheet, compact, sortable, explain)`: a `cfx.report.tables.Sheet`; set small, sorted by
      a click on a heading, with what its columns say below it.
    - `drawn(name, job)`: the figure of that name as the job has written it; nothing if the job
      lacks its data. `drawn_folds(name, jobs)`: the same of several jobs, a fold each.
    - `figure(views, label, chooser)`: `View`s by what the reader chooses.
    - `caption(name)`: what a reader needs to know of a figure.
    - `fold(summary, unfolded, style)`: what a click shows, as `{% call fold("More") %}`.
    - `cards(name, headed)`: the figure of that name of several jobs beside each other; `headed` has
      a heading, a smaller remark and a job for each.
    - `missing(file, what)`: a remark on the jobs that lack a file.

    Attributes:
        title: its heading.
        entry: its name in the contents.
        order: its place in the page; cfx's own stand at 100, 200, ...
        figures: names of the figures that it shows. Those of other distributions that no section
            shows stand in "Further figures".
        template: by default the figures with their captions, of each job that has their data.
    """

    kind = "section"
    title: ClassVar[str] = ""
    entry: ClassVar[str] = ""
    order: ClassVar[int] = 1000
    figures: ClassVar[tuple[str, ...]] = ()
    template: ClassVar[str] = """
{% for name in section.figures %}
{% set folds = drawn_folds(name, runs.jobs) | trim %}
{% if folds %}
<p>{{ caption(name) }}</p>
{{ folds }}
{% endif %}
{% endfor %}
"""

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.title and cls.entry else " has no title or no entry; give it both"

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Returns what the template shows by name; None where there is nothing to show."""
        return {}


MOST = 6
"""Jobs that are drawn at once, or named in a sentence; of more, the others are folded away."""


def lacking(jobs: tuple[Job, ...], file: str, what: str) -> str:
    """Returns a sentence on the jobs that lack a file; "" if none does.

    Args:
        jobs: of the page.
        file: its name.
        what: what cannot be shown without it.
    """
    without = [job.name for job in jobs if file in job.missing]
    if not without:
        return ""
    reason = "an older version of cfx wrote it, or the file was removed"
    return f"Not shown for {', '.join(without)}: {what}; this job has no {file} ({reason})."
