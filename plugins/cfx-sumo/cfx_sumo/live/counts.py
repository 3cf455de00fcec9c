"""Counts what a live driver does, for the report at the end.

Shapes: D vehicles, f signals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.plugin import Agent, valid_range

_OBEYED_MPS = 1e-3
"""SUMO obeyed where a vehicle's speed differs by at most this from the speed that it was told."""


@dataclass
class DriveCounts:
    """Counts over all steps of all vehicles of a driver.

    Attributes:
        steps: steps of the model behind a leader.
        outside: of these, the ones that began outside the policy's valid range.
        limited: of these, the ones at a limit of acceleration.
        beyond: steps outside the valid range in which each signal was too low, then too high,
            `(2 f,)`; None before the first step.
        free: steps of the model without a leader.
        told: speeds that SUMO was told, of vehicles that were still there one step later.
        changed: of these, the ones that SUMO changed, by the checks that its speed mode leaves on.
    """

    steps: int = 0
    free: int = 0
    told: int = 0
    changed: int = 0
    outside: int = 0
    limited: int = 0
    beyond: Tensor | None = None

    def add(self, score: NDArray[np.float64], beyond: Tensor, rows: Tensor) -> None:
        """Counts one step of D vehicles.

        Args:
            score: of each, `(D,)`.
            beyond: unusual signals of all rows of a table, `(C, 2 f)`.
            rows: of the vehicles, `(D,)` int64.
        """
        self.steps += len(score)
        outside = np.flatnonzero(score > 1.0)
        if len(outside) == 0 and self.beyond is not None:
            return
        self.outside += len(outside)
        unusual = beyond[rows[torch.from_numpy(outside)]].sum(0)
        self.beyond = unusual if self.beyond is None else self.beyond + unusual

    def add_told(
        self, told: NDArray[np.float64], speed: NDArray[np.float64], going: Tensor | None
    ) -> None:
        """Counts what became of the speeds that SUMO was told.

        Args:
            told: `(D,)`, m/s; NaN where SUMO was told none.
            speed: that vehicles have, `(D,)`, m/s.
            going: which vehicles were told one step ago, bool `(D,)`; None: all.
        """
        changed = np.abs(speed - told) > _OBEYED_MPS
        if going is None:
            self.told += len(told)
            self.changed += int(np.count_nonzero(changed))
            return
        obliged = going.numpy() & ~np.isnan(told)
        self.told += int(np.count_nonzero(obliged))
        self.changed += int(np.count_nonzero(obliged & changed))

    def outside_in_words(self, policy: Agent) -> str:
        """Returns how much was driven outside what the policy has learned, in words; or ""."""
        if policy.valid_range is None or self.beyond is None:
            return ""
        return valid_range.share_in_words(policy.valid_range, self.outside, self.steps, self.beyond)
