"""The contract of a demonstration: what a finished job shows beyond its tables and figures."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cfx.core.component import Component
from cfx.data.pairs import PairSet
from cfx.evaluation.result import Evaluation
from cfx.policies.agent import Agent

DEMO_PAGE = "demo.html"
"""A page of this name is what a user opens; the job says where it is."""


class Demo(Component):
    """Base of every demonstration, such as a job's trajectories in another simulator.

    A job makes it with its other components, calls `check` before it calibrates anything, and
    `write` once, when its policy is saved and everything is measured. `metrics.json` is written
    after it, so that a job whose demonstration fails is not complete.
    """

    kind = "demo"

    def check(self, pairs: PairSet) -> None:
        """Refuses what it cannot show, before the job begins its work.

        Args:
            pairs: that the job evaluates.

        Raises:
            CfxError: something is not installed, or none of the pairs can be shown.
        """
        return

    @abstractmethod
    def write(
        self,
        folder: Path,
        pairs: PairSet,
        policy: Agent,
        evaluation: Evaluation,
        protocol: Mapping[str, Any],
    ) -> Sequence[Path]:
        """Writes the demonstration.

        Args:
            folder: its own within the job's, under the demonstration's name; it is there. The
                policy lies beside it, in `policy`.
            pairs: that the job evaluated.
            policy: that the job trained.
            evaluation: what the job measured.
            protocol: the protocol's config node, which may say what the policy knew of drivers.

        Returns:
            The files, which MLflow keeps too.

        Raises:
            CfxError: it cannot be written.
            OSError: the folder cannot be written.
        """
