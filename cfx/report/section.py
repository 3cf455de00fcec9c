"""What a section of the report is.

An entry point of the group `cfx.sections` makes it known; its name becomes its anchor in the page.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from cfx.core.component import Component
from cfx.report.blocks import Block
from cfx.report.job import Runs


class Section(Component):
    """A section of the page about finished jobs.

    Attributes:
        title: its heading.
        entry: its name in the contents.
        order: its place in the page; cfx's own stand at 100, 200, ...
        figures: names of the figures that it shows. Those of other distributions that no section
            shows stand in "Further figures".
    """

    kind = "section"
    title: ClassVar[str] = ""
    entry: ClassVar[str] = ""
    order: ClassVar[int] = 1000
    figures: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.title and cls.entry else " has no title or no entry; give it both"

    @abstractmethod
    def blocks(self, runs: Runs) -> Sequence[Block]:
        """Return what it shows of some jobs; a section without blocks is left out."""
