"""What a live driver has done, as numbers for a report.

Shapes: D vehicles, f signals.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from cfx.plugin import Agent, valid_range

_OBEYED_MPS = 1e-3
"""A speed this close to what SUMO was told is what it was told."""


@dataclass
class DriveCounts:
    """What a driver did over all steps of all its vehicles.

    Attributes:
        steps: steps of the model behind a leader.
        outside: those of them that began outside what the policy has learned from.
        limited: those at a limit of acceleration.
        beyond: in how many each signal alone was too low, then too high; None before the first.
        free: steps of the model without a leader.
        told: speeds that SUMO was told and whose result was seen.
        changed: those of them that SUMO changed, by the checks that the speed mode leaves it.
    """

    steps: int = 0
    free: int = 0
    told: int = 0
    changed: int = 0
    outside: int = 0
    limited: int = 0
    beyond: Tensor | None = None

    def add(self, score: Tensor, beyond: Tensor) -> None:
        """Counts one step of D vehicles: scores `(D,)`, unusual signals `(D, 2 f)`."""
        is_outside = score > 1.0
        self.steps += len(score)
        self.outside += int(is_outside.sum())
        unusual = beyond[is_outside].sum(0)
        self.beyond = unusual if self.beyond is None else self.beyond + unusual

    def add_told(self, told: Tensor, speed: Tensor, going: Tensor) -> None:
        """Counts what became of the speeds that SUMO was told.

        Args:
            told: `(D,)`, m/s; NaN where SUMO was told none.
            speed: that vehicles have, `(D,)`, m/s.
            going: which vehicles were told one step ago, bool `(D,)`.
        """
        obliged = going & ~told.isnan()
        changed = (speed - told).abs() > _OBEYED_MPS
        self.told += int(obliged.sum())
        self.changed += int((obliged & changed).sum())

    def outside_in_words(self, policy: Agent) -> str:
        """Returns how much was driven outside what the policy has learned, in words; or ""."""
        if policy.valid_range is None or self.beyond is None:
            return ""
        return valid_range.share_in_words(policy.valid_range, self.outside, self.steps, self.beyond)
