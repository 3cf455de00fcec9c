"""Objectives: how far a simulated trajectory is from the measured one.

An objective is a pure function in two parts. `terms` says what each frame contributes, `finish`
turns the sums over frames into the loss. The sums can therefore be accumulated frame by frame while
a rollout is running, in a compiled step as well, without keeping the trajectory.

Shapes: K frames, any batch of trajectories. All tensors broadcast against each other.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple

from torch import Tensor

from cfx.core.component import Component

Signal = Literal["speed", "gap"]


class FrameValues(NamedTuple):
    """Simulated and recorded values: one frame `(*batch,)`, or many with a dimension of time.

    A signal that the objective does not list in `signals` may be NaN or have another shape.

    Attributes:
        speed: simulated speed of the follower, m/s.
        gap: simulated gap, bumper to bumper, m; negative after a collision.
        measured_speed: measured speed of the follower, m/s.
        measured_gap: measured gap, bumper to bumper, m.
        dt: time step, s.
    """

    speed: Tensor
    gap: Tensor
    measured_speed: Tensor
    measured_gap: Tensor
    dt: float


class Objective(Component):
    """Base of every objective.

    Life cycle: a job makes one objective. Calibration minimises it for the driver-specific
    parameters, for the pooled ones and for those of each window; closed-loop training minimises its
    mean over trajectories by gradient. Both call the object itself, or `sums` and `finish`.

    A subclass implements `terms` and `finish`: pure functions of tensors without Python branches on
    their values, on any device, in float32 and float64, differentiable wherever the loss is.
    `cfx_contracts.objectives` tests all this.

    Punzo, Zheng and Montanino (2021), *About calibration of car-following dynamics of automated and
    human-driven vehicles: Methodology, guidelines and codes*, Transportation Research Part C, find
    that errors of spacing identify parameters better than errors of speed.

    Attributes:
        unit: the loss's unit, such as "m/s"; "" for a loss without unit.
        metric: the metric that is the same number, such as "rmse_speed": jobs are judged by it. ""
            where there is none: they are judged by the objective itself.
        signals: the signals that `terms` reads; the others are not computed for it.
        tie_tolerance: losses of a window that differ by less, in `unit`, count as equal where
            `windows.tie_tolerance` is null: about the accuracy of recorded trajectories.
        floor: a small loss, in `unit`. Training that divides a loss by that of constant parameters
            adds it to the divisor, so that a trajectory which these parameters follow almost
            perfectly does not outweigh all others.
    """

    kind = "objective"
    unit: ClassVar[str]
    metric: str = ""
    signals: Sequence[Signal] = ("speed", "gap")
    tie_tolerance: ClassVar[float] = 0.0
    floor: ClassVar[float] = 0.0

    @abstractmethod
    def terms(self, frames: FrameValues) -> tuple[Tensor, ...]:
        """Returns what each frame contributes.

        Args:
            frames: one frame `(*batch,)` or many, such as `(K, *batch)`.

        Returns:
            A tuple of the same length in every call, of tensors that broadcast to the frames'
            shape.
        """

    @abstractmethod
    def finish(self, sums: tuple[Tensor, ...], count: Tensor, epsilon: float = 0.0) -> Tensor:
        """Returns the loss `(*batch,)` of trajectories, never negative.

        Args:
            sums: each term, summed over the frames that count; `(*batch,)` or broadcasting to it.
            count: number of frames that count, at least 1, broadcasting to `(*batch,)`.
            epsilon: added to every mean square before its root is taken, in the square of the
                signal's unit; above 0 the slope is finite at a perfect simulation too. With 0
                the loss is exact.
        """

    def sums(self, frames: FrameValues, counted: Tensor, *, dim: int = 0) -> tuple[Tensor, ...]:
        """Returns each term summed over time; the sums of parts of a trajectory may be added up.

        Args:
            frames: many frames.
            counted: 1 (or True) for frames that count and 0 for others, broadcasting to the frames.
            dim: the dimension of time, of the frames and of `counted` alike.

        Returns:
            As many tensors as there are terms, without the dimension of time: `(*batch,)` each.
        """
        total = [(term * counted).sum(dim) for term in self.terms(frames)]
        return tuple(total)

    def __call__(
        self, frames: FrameValues, counted: Tensor, *, dim: int = 0, epsilon: float = 0.0
    ) -> Tensor:
        """Returns the loss `(*batch,)` of full trajectories, in `unit`; 0 where no frame counts.

        Args:
            frames: many frames, such as `(K, *batch)`.
            counted: 1 (or True) for frames that count and 0 for others, broadcasting to the frames.
                Values of frames that do not count must be finite.
            dim: the dimension of time, of the frames and of `counted` alike.
            epsilon: see `finish`.
        """
        count = counted.sum(dim).clamp(min=1)
        return self.finish(self.sums(frames, counted, dim=dim), count, epsilon)

    def worded(self, loss: float) -> str:
        """Returns a loss with its unit, for people."""
        return f"{loss:.3g} {self.unit}".rstrip()


def root_mean_square(total: Tensor, count: Tensor, epsilon: float = 0.0) -> Tensor:
    """Returns the root of the mean square.

    Args:
        total: sum of squares over the frames that count.
        count: number of these frames.
        epsilon: added to the mean square.
    """
    return (total / count + epsilon).sqrt()


def ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Returns the ratio of two tensors that are not negative; the numerator where it divides by 0.

    So an objective whose denominator is 0, of a measured follower that stands still all the time,
    is 0 for a simulated one that stands still too and finite for all others.
    """
    return numerator / denominator.masked_fill(denominator == 0, 1.0)
