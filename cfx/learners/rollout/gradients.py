"""The way that gradients take back through the windows of a simulated trajectory.

A closed loop of many windows multiplies Jacobians, and behind a regime switch these can be large:
the gradients of Wiedemann 99 overflow without a bound. So each way back is an object that says
where gradients are scaled, clipped or cut; the loop itself (`cfx.learners.rollout.loop`) does not
know.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from cfx.learners.rollout.state import LoopState


class GradientPath(ABC):
    """Base of the ways back.

    Life cycle: the loop asks for `segment_length` once, calls `after_window` on the state behind
    each window, and `after_segment` behind each segment. Both return the same values.
    """

    @abstractmethod
    def segment_length(self, windows: int) -> int:
        """Returns after how many windows a loss is taken, for trajectories of so many windows."""

    @abstractmethod
    def after_window(self, state: LoopState) -> LoopState:
        """Returns the state from which the next window starts."""

    @abstractmethod
    def after_segment(self, state: LoopState) -> LoopState:
        """Returns the state from which the next segment starts."""


class NoGradients(GradientPath):
    """Nothing is recorded: one segment, as in validation."""

    def segment_length(self, windows: int) -> int:
        return windows

    def after_window(self, state: LoopState) -> LoopState:
        return state

    def after_segment(self, state: LoopState) -> LoopState:
        return state


@dataclass(frozen=True)
class ThroughTime(GradientPath):
    """Back-propagation through time, with decay, clipping and cuts.

    A decay of g per window makes gradients forget with a time constant of -1 / ln g windows.

    Attributes:
        decay: factor on gradients that come back through one window, 0 to 1.
        clip: largest absolute value of each of them.
        cut_after: windows after which they are cut; None: never.
    """

    decay: float
    clip: float
    cut_after: int | None = None

    def segment_length(self, windows: int) -> int:
        return self.cut_after or windows

    def after_window(self, state: LoopState) -> LoopState:
        return LoopState(
            self._bounded(state.position),
            self._bounded(state.speed),
            self._bounded(state.acceleration),
            self._bounded(state.memory),
            self._bounded(state.state),
            self._bounded(state.latent),
        )

    def after_segment(self, state: LoopState) -> LoopState:
        return LoopState(
            _cut(state.position),
            _cut(state.speed),
            _cut(state.acceleration),
            _cut(state.memory),
            _cut(state.state),
            _cut(state.latent),
        )

    def _bounded(self, value: Tensor) -> Tensor:
        bounded: Tensor = _Bounded.apply(value, self.decay, self.clip)  # type: ignore[no-untyped-call]
        return bounded


class ThroughMemory(ThroughTime):
    """Gradients come back through the policy's memory alone, not through the vehicle's motion."""

    def after_window(self, state: LoopState) -> LoopState:
        bounded = super().after_window(state)
        return LoopState(
            _cut(bounded.position),
            _cut(bounded.speed),
            _cut(bounded.acceleration),
            _cut(bounded.memory),
            bounded.state,
            _cut(bounded.latent),
        )


class _Bounded(torch.autograd.Function):
    """The identity, whose gradient is scaled and clipped on its way back."""

    @staticmethod
    def forward(ctx, value, decay, clip):  # type: ignore[no-untyped-def]  # torch's signature
        ctx.decay, ctx.clip = decay, clip
        return value.view_as(value)

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]  # torch's signature
        gradient = torch.nan_to_num(gradient, 0.0, 0.0, 0.0) * ctx.decay
        return gradient.clamp(-ctx.clip, ctx.clip), None, None


def _cut(value: Tensor) -> Tensor:
    """Returns the value without its past, as the start of new gradients."""
    return value.detach().requires_grad_()
