"""How smooth a simulated trajectory is. Shapes: P pairs, K + 1 frames."""

from __future__ import annotations

from torch import Tensor

from cfx.evaluation.metrics.base import Metric, Trajectories
from cfx.evaluation.metrics.masked import root_mean_square


class Jerk(Metric):
    """Root mean square jerk; NaN where fewer than two frames count.

    The jerk is the difference of successive accelerations over the time step. The acceleration at
    the start is the recorded driver's own and does not count: the jump from it is no act of the
    model.
    """

    unit = "m/s3"
    direction = "none"
    heading = "RMS jerk"
    meaning = "root mean square jerk; that of the recorded drivers says what is usual"
    is_of_recording = True
    headline = False
    order = 24

    def compute(self, trajectories: Trajectories) -> Tensor:
        counted = trajectories.counted
        jerk = trajectories.speed.diff(n=2, dim=-1) / trajectories.dt**2
        return root_mean_square(jerk, counted[:, 2:] & counted[:, 1:-1])
