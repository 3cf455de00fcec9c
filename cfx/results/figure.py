"""What a figure of a job is: what it shows of the result, and how.

An entry point of the group `cfx.figures` makes it known; its name becomes that of the figure's
files.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from cfx.core.component import Component

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cfx.results.result import Result


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

    def is_usual(self, result: Result) -> bool:
        """Says whether a job draws it unasked: the others take time, and `cfx figures` draws them.

        Args:
            result: of the job.
        """
        return True

    @abstractmethod
    def draw(self, result: Result) -> Figure | None:
        """Draws it, with `cfx.figures.canvas.blank` as its paper.

        It is called in the common look. A figure belongs to no window (`pyplot` is not used) and
        the same result gives the same figure.

        Args:
            result: of the job.

        Returns:
            None where the result holds nothing of what it shows.
        """
