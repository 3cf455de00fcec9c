"""An input: what a policy reads of each frame. This one is the deceleration that a driver needs.

A job calls `values` with the last frames of a driver, in training and in driving, for many drivers
at once. The network sees what it gives, scaled by its spread over the training data.
"""

from __future__ import annotations

from cfx.plugin import SIGNALS, History, PolicyInput
from torch import Tensor

NEAREST = 1.0
"""m: smaller gaps count as this, so that the input is finite bumper to bumper."""

# An input may read a further signal, which a column of the recording gives (`data=tidy`):
#
#     RAIN = Signal("rain", "mm/h", "rainfall", column="rain_mmph", low=0, high=200)
#
# Name it in `signals`, and read history["rain"].


class NeededDeceleration(PolicyInput):
    """Square of the closing speed over twice the gap; 0 where the gap grows."""

    unit = "m/s2"
    meaning = "deceleration that keeps the follower off a leader who goes on as now"
    signals = (SIGNALS["follower_speed"], SIGNALS["leader_speed"], SIGNALS["gap"])

    def values(self, history: History) -> Tensor:
        closing = (history["follower_speed"] - history["leader_speed"]).clamp(min=0.0)
        return closing.square() / (2.0 * history["gap"].clamp(min=NEAREST))
