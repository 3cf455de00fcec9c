"""What a figure of a job is, and which are installed.

A figure is a class of its own: what it shows of the results, how it is drawn, what is said about
it. A distribution brings one by an entry point, whose name becomes that of the figure's files:

    [project.entry-points."cfx.figures"]
    speed_histogram = "my_package.figures:SpeedHistogram"
"""

from __future__ import annotations

import importlib.metadata
import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar

from cfx.core.errors import PluginError
from cfx.core.registry import OWN
from cfx.report.figures.results import Results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

GROUP = "cfx.figures"


class JobFigure(ABC):
    """A figure of a finished job, the same in its folder and in reports.

    Attributes:
        title: what it shows, in a few words, for readers who do not see it too.
        caption: sentences that a reader needs to read it.
        order: its place among the figures of a job; smaller numbers come first.
    """

    title: ClassVar[str]
    caption: ClassVar[str]
    order: ClassVar[int] = 1000

    @abstractmethod
    def draw(self, results: Results) -> Figure | None:
        """Draws it, with `cfx.report.figures.canvas.canvas` as its paper.

        It is called in the common look. A figure belongs to no window (`pyplot` is not used) and
        the same results give the same figure.

        Returns:
            None where the results hold nothing of what it shows.
        """


@dataclass(frozen=True)
class Installed:
    """A figure and who brings it.

    Attributes:
        name: of its files.
        figure: what is drawn.
        distribution: who brings it.
    """

    name: str
    figure: JobFigure
    distribution: str

    def draw(self, results: Results) -> Figure | None:
        """Draws it in the common look; None where there is nothing to show.

        One of another distribution that fails is left out with a warning: the job has its results.
        """
        from cfx.report.figures.canvas import look

        try:
            with look():
                return self.figure.draw(results)
        except Exception as error:
            if self.distribution == OWN:
                raise
            log.warning(
                "figure %s of the distribution %s is left out: %s: %s; repair or uninstall it",
                self.name,
                self.distribution,
                type(error).__name__,
                error,
            )
            return None


@cache
def installed() -> tuple[Installed, ...]:
    """Returns all figures in their order; one of another distribution never replaces cfx's own.

    A figure that cannot be imported, or is none, is left out with a warning.
    """
    found: dict[str, Installed] = {}
    entries = importlib.metadata.entry_points(group=GROUP)
    for entry in sorted(entries, key=lambda one: (_distribution(one) != OWN, one.name)):
        if entry.name in found:
            if _distribution(entry) != found[entry.name].distribution:
                log.warning(
                    "figure %s of the distribution %s is left out: %s brings one of that name",
                    entry.name,
                    _distribution(entry),
                    found[entry.name].distribution,
                )
            continue
        try:
            figure = _made(entry)
        except Exception as error:
            if _distribution(entry) == OWN:
                raise
            log.warning(
                "figure %s of the distribution %s is left out: %s; repair or uninstall it",
                entry.name,
                _distribution(entry),
                error,
            )
            continue
        found[entry.name] = Installed(entry.name, figure, _distribution(entry))
    return tuple(sorted(found.values(), key=lambda one: (one.figure.order, one.name)))


def figure(name: str) -> Installed:
    """Returns the figure of a name.

    Raises:
        PluginError: there is none.
    """
    for one in installed():
        if one.name == name:
            return one
    known = ", ".join(one.name for one in installed())
    raise PluginError(f"there is no figure '{name}'. Known: {known}.")


def _made(entry: importlib.metadata.EntryPoint) -> JobFigure:
    cls = entry.load()
    if not (isinstance(cls, type) and issubclass(cls, JobFigure)):
        raise PluginError(
            f"{entry.value} is no class that extends cfx.report.figures.figure.JobFigure"
        )
    for attribute in ("title", "caption"):
        if not getattr(cls, attribute, ""):
            raise PluginError(f"{entry.value} has no {attribute}; give it one")
    return cls()


def _distribution(entry: importlib.metadata.EntryPoint) -> str:
    return "" if entry.dist is None else entry.dist.name
