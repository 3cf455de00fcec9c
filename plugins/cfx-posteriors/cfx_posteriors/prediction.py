"""Predictions of recordings, a step of the noise at a time, with states corrected after each.

The compiled kernel does the same where all is measured (`Stepper.accumulate`); this is for what it
cannot do: forecasts, and simulators that have no kernel.

Shapes: P drivers, q candidates of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from cfx.plugin import Leader, SegmentLosses, Start
from cfx_posteriors import noise


class Predictor:
    """Drives along recordings, a step of the noise after the other.

    Args:
        segments: the recordings of P drivers, and what simulates them.
        p: one tensor per parameter, SI units, `(P, q)`.
        gain: of the noise, `(P, q)`; None: one closed loop.
        stride: frames of a step.
        signal: whose errors count.
    """

    def __init__(
        self,
        segments: SegmentLosses,
        p: Mapping[str, Tensor],
        gain: Tensor | None,
        stride: int,
        signal: Literal["speed", "gap"],
    ) -> None:
        self._segments, self._p, self._gain = segments, p, gain
        self._stride, self._signal = stride, signal
        measured = segments.segments
        shape = next(iter(p.values())).shape
        begin = (measured.position, measured.speed, measured.acceleration)
        start = Start(*(value[:, None].expand(shape) for value in begin))
        self._follower = segments.stepper.begin(start)
        self._steps = 0

    @torch.no_grad()
    def advance(self) -> tuple[Tensor, Tensor]:
        """Takes a step; returns the predicted signal `(P, q)` and the measured one `(P, 1)`."""
        measured = self._segments.segments
        first, after = self._steps * self._stride, (self._steps + 1) * self._stride
        leader = Leader(
            measured.leader_position[first:after, :, None],
            measured.leader_speed[first:after, :, None],
            measured.leader_acceleration[first:after, :, None],
            measured.leader_length[:, None],
        )
        self._follower, _, _ = self._segments.stepper.advance(self._follower, leader, self._p)
        self._steps += 1
        self._rear = measured.leader_rear[after - 1, :, None]
        self._gap = measured.measured_gap[after - 1, :, None]
        self._speed = measured.measured_speed[after - 1, :, None]
        if self._signal == "gap":
            return self._rear - self._follower.position, self._gap
        return self._follower.speed, self._speed

    def correct(self, error: Tensor, is_measured: Tensor) -> None:
        """Moves position and speed towards the signal after the step.

        Args:
            error: predicted minus true signal, `(P, q)`.
            is_measured: whether the true signal was measured, bool, broadcasting to `(P, q)`. If
                not, the error is drawn from the noise. It then stands for an acceleration that was
                constant within the step: one that changes the speed by e moves the position by
                e / 2 times the step's duration.
        """
        if self._gain is None:
            return
        follower = self._follower
        half = 0.5 * self._stride * self._segments.stepper.dt
        of_speed, of_position = error, half * error
        if self._signal == "gap":
            of_speed, of_position = -error / half, -error
        of_speed = torch.where(is_measured, follower.speed - self._speed, of_speed)
        of_position = torch.where(
            is_measured, follower.position - (self._rear - self._gap), of_position
        )
        share = noise.gain_after(self._gain, self._steps)
        self._follower = follower._replace(
            position=follower.position - share * of_position,
            speed=(follower.speed - share * of_speed).clamp(min=0.0),
        )
