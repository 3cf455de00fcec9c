"""What a figure of a job is: what it shows of the results, how it is drawn, what is said of it.

An entry point of the group `cfx.figures` makes it known; its name becomes that of the figure's
files.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.errors import PluginError
from cfx.report.figures.results import Results

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class JobFigure(Component):
    """A figure of a finished job, the same in its folder and in reports.

    Attributes:
        title: what it shows, in a few words, for readers who do not see it too.
        caption: sentences that a reader needs to read it.
        order: its place among the figures of a job; smaller numbers come first.
    """

    kind = "figure"
    title: ClassVar[str] = ""
    caption: ClassVar[str] = ""
    order: ClassVar[int] = 1000

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.title and cls.caption else " has no title or no caption; give it both"

    @abstractmethod
    def draw(self, results: Results) -> Figure | None:
        """Draws it, with `cfx.report.figures.canvas.canvas` as its paper.

        It is called in the common look. A figure belongs to no window (`pyplot` is not used) and
        the same results give the same figure.

        Returns:
            None where the results hold nothing of what it shows.
        """


def figure_named(name: str) -> registry.Installed[JobFigure]:
    """Return the figure of a name.

    Raises:
        PluginError: there is none that works.
    """
    for one in registry.installed("figure"):
        if one.name == name:
            return one
    raise PluginError(f"there is no figure '{name}'")


def draw(one: registry.Installed[JobFigure], results: Results) -> Figure | None:
    """Return a figure in the common look; None where there is nothing to show, or it fails."""
    from cfx.report.figures.canvas import figure_style

    def attempt(figure: JobFigure) -> Figure | None:
        with figure_style():
            return figure.draw(results)

    return one.attempt(attempt, None)
