"""How strong the prior of driver-specific parameters is, chosen on stretches that are held out.

A set at its optimum is fitted to more than the driver's style: with a weak prior W99's parameters
err by 0.38 m/s where they were calibrated on I-80 and by 0.72 m/s on the rest. How strong a prior
serves best depends on the model and on what the recording says; so it is tried.

Shapes: P pairs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cfx.errors import listed

WEIGHTS = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Which are tried, from the weak prior's on. At 1 a parameter that is one unit of the squashed
space away from its default costs as much as the default's loss over n."""

FITTED = 2 / 3
"""Share of the part that may be used that is calibrated on; the rest is held out, once the last
third and once the first. One third alone says what its own traffic asks for: for IDM and 24
drivers of I-80 the last one chooses a weight of 0.67 and both choose 0.35, with errors of 0.734 and
0.707 m/s on the last fifth, which neither has seen."""

MOST = 32
"""Pairs that are tried at most, those evenly spread over all: so a large recording costs little
more than its own calibration."""


@dataclass(frozen=True)
class PriorStrength:
    """What was tried, and what is best.

    Attributes:
        errors: by weight the geometric mean over drivers of the loss on what was held out, in the
            objective's unit.
        pairs: how many were tried.
    """

    errors: Mapping[float, float]
    pairs: int

    @property
    def weight(self) -> float:
        """The weight for all that may be used; the weakest where no error is known.

        The least error lies where a parabola through the best weight and its neighbours has it, on
        logarithmic scales. A prior counts as much as so many seconds of recording: what was best
        beside two thirds of them is two thirds as strong beside all.
        """
        weights, errors = [], []
        for weight, error in self.errors.items():
            if math.isfinite(error):
                weights.append(math.log(weight))
                errors.append(math.log(error))
        if not errors:
            return WEIGHTS[0]
        best = errors.index(min(errors))
        place = weights[best]
        if 0 < best < len(errors) - 1:
            near = slice(best - 1, best + 2)
            curved, slope, _ = np.polyfit(weights[near], errors[near], 2)
            if curved > 0:
                place = float(-slope / (2 * curved))
        return max(WEIGHTS[0], FITTED * math.exp(place))

    def worded(self, unit: str) -> str:
        """Returns the choice and what it was chosen from, as a sentence."""
        if not self.pairs:
            return (
                "The prior draws driver-specific parameters towards the default with the weight"
                f" {self.weight:g}: no pair can be driven on the first and the last third of what"
                " is calibrated on"
            )
        tried = [f"{weight:g}: {error:.3f}" for weight, error in self.errors.items()]
        shown = f"{listed(tried, len(tried))} {unit}".rstrip()
        return (
            "The prior draws driver-specific parameters towards the default with the weight"
            f" {self.weight:.2g}: where a curve through errors on thirds that were left out"
            f" ({self.pairs} pairs) is lowest, times 2/3, since all three thirds are calibrated on;"
            f" by weight {shown} (calibration.prior=none: without)"
        )

    def to_json(self) -> dict[str, object]:
        """Returns what `data.json` says of it."""
        errors = {f"{weight:g}": error for weight, error in self.errors.items()}
        return {"weight": self.weight, "pairs": self.pairs, "held_out_error": errors}
