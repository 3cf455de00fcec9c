"""The closed loop of training: burn-in on measured history, then windows one after the other.

With distillation, experts say how they would drive from where the student stands. Behind regime
switches the error of a whole trajectory says little about which parameters would have served
better. Experts are networks that set the acceleration themselves and were trained on the same
trajectories before. The student drives, the expert says what it would do there, and the student
learns from each window alone, by an error that has not come through later windows' switches. This
is the scheme of DAgger (S. Ross, G. Gordon and D. Bagnell, 2011, *A reduction of imitation learning
and structured prediction to no-regret online learning*, AISTATS).

Difference from the paper: trajectories are always the student's, from the first step on, and are
not collected: each is learned from once.

Shapes: N networks, D trajectories of each, H windows of a trajectory, S steps of a window, s width
of the policy's state, m of the model's memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from cfx.learners.rollout.dataset import Conditioning, RolloutBatch, RolloutDataset
from cfx.learners.rollout.window import (
    GradientPath,
    LeaderWindow,
    LoopState,
    RolloutInputs,
    Segment,
    WindowStep,
)


class ExpertState(NamedTuple):
    """State of the experts beside N by D trajectories.

    Attributes:
        conditioning: what they know of the drivers.
        memory: of the experts' model, `(N, D, m)`; None before the first window.
        state: of the experts' networks, `(N, D, s)`.
    """

    conditioning: Conditioning
    memory: Tensor | None
    state: Tensor


@dataclass(frozen=True)
class Expert:
    """N expert networks, one for each student.

    Attributes:
        step: simulates one window with the experts' model.
        dataset: the students' drivers, with the base of the experts' model.
    """

    step: WindowStep
    dataset: RolloutDataset

    @torch.no_grad()
    def begin(self, batch: RolloutBatch, most: int | None) -> ExpertState:
        """Returns the experts' state before the first window, as `burn_in` leaves it."""
        conditioning = self.dataset.condition(batch)
        state = burn_in(self.step, self.dataset, batch, conditioning, most)
        return ExpertState(conditioning, None, state)

    @torch.no_grad()
    def label(
        self, state: ExpertState, student: LoopState, leader: LeaderWindow, leader_length: Tensor
    ) -> tuple[Tensor, ExpertState]:
        """Returns the speeds `(N, D, S)`, m/s, of experts who drive the students' next window.

        The experts' state afterwards is returned too.
        """
        student = student.detached()
        memory = state.memory
        if memory is None:
            memory = self.step.model.initial_memory(student.speed[..., -1])
        start = student._replace(memory=memory, state=state.state)
        base, features = state.conditioning.base, state.conditioning.features
        after, speeds, _ = self.step.drive_window(start, leader, leader_length, base, features)
        return speeds, state._replace(memory=after.memory, state=after.state)


class CompiledLoop(Protocol):
    """What compiled code does instead of this module, as `cfx.learners.compiled` makes it."""

    def trajectories(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        burn_in_windows: int | None,
    ) -> Segment:
        """Returns what `simulate` yields without `path`."""
        ...

    def gradients(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        path: GradientPath,
        burn_in_windows: int | None,
    ) -> Iterator[Segment]:
        """Yields what `simulate` does with `path`."""
        ...


def burn_in(
    step: WindowStep,
    dataset: RolloutDataset,
    batch: RolloutBatch,
    conditioning: Conditioning,
    most: int | None = None,
) -> Tensor:
    """Lets networks observe what was measured before each trajectory; nothing before a cold start.

    Args:
        step: observes one window.
        dataset: holds what was measured.
        batch: where the trajectories begin.
        conditioning: of these trajectories.
        most: windows that are observed at most, the last ones before the start; None: all.

    Returns:
        The policy's state at the start of each trajectory, `(N, D, s)`.
    """
    tokens, present = dataset.observed_windows(batch, conditioning.pair, most)
    state = step.core.network.initial_state(*conditioning.pair.shape)
    if state.is_floating_point() and torch.is_grad_enabled():
        # As all later states, so that one compiled function serves all windows.
        state = state.detach().requires_grad_()
    for token, has_window in zip(tokens, present, strict=True):
        state = step.observe(token, conditioning.features, state, has_window)
    return state


def simulate(
    step: WindowStep,
    dataset: RolloutDataset,
    batch: RolloutBatch,
    windows: int,
    path: GradientPath | None = None,
    *,
    burn_in_windows: int | None = None,
    expert: Expert | None = None,
    noise: Tensor | None = None,
    compiled: CompiledLoop | None = None,
) -> Iterator[Segment]:
    """Simulates trajectories in closed loop.

    Args:
        step: simulates one window.
        dataset: what was measured.
        batch: the trajectories.
        windows: H.
        path: the way that gradients take back; None: they are not recorded.
        burn_in_windows: windows of history that are observed at most; None: all.
        expert: says how it would have driven each window; None: nothing is asked.
        noise: what a stochastic head draws from, `(H, N, paths D, k)`; None: nothing is drawn. Each
            path of all trajectories stands behind the one before. What was measured is observed
            once for all.
        compiled: the window as compiled code, which simulates where no expert is asked and nothing
            is drawn; None: none.

    Yields:
        What was simulated between two cuts of the gradients.
    """
    if compiled is not None and expert is None and noise is None:
        if path is None:
            yield compiled.trajectories(dataset, batch, windows, burn_in_windows)
        else:
            yield from compiled.gradients(dataset, batch, windows, path, burn_in_windows)
        return
    state = burn_in(step, dataset, batch, dataset.condition(batch), burn_in_windows)
    if noise is not None:
        paths = noise.shape[2] // batch.place.shape[1]
        state = state.repeat(1, paths, 1)
        batch = batch.repeated(paths)
    conditioning = dataset.condition(batch)
    inputs = RolloutInputs.of(dataset.recordings.batch, conditioning.pair, batch, step, windows)
    now = inputs.initial(state)
    expert_state: ExpertState | None = None
    if expert is not None:
        expert_state = expert.begin(batch, burn_in_windows)
    length = windows
    if path is not None:
        length = path.windows_of_segment(windows)
    for first in range(0, windows, length):
        speeds, gaps, expert_speeds = [], [], []
        for window in range(first, min(first + length, windows)):
            leader = inputs.leader_window(window)
            if expert is not None and expert_state is not None:
                label, expert_state = expert.label(expert_state, now, leader, inputs.leader_length)
                expert_speeds.append(label)
            drivers = (inputs.leader_length, conditioning.base, conditioning.features)
            drawn = None if noise is None else noise[window]
            now, speed, gap = step.drive_window(now, leader, *drivers, drawn)
            if path is not None:
                now = path.after_window(now)
            speeds.append(speed)
            gaps.append(gap)
        frames = slice(first * step.stride, (first + len(speeds)) * step.stride)
        expert_speed = None
        if expert_speeds:
            expert_speed = torch.cat(expert_speeds, -1)
        measured = inputs.measured_at(frames)
        speed, gap = torch.cat(speeds, -1), torch.cat(gaps, -1)
        yield Segment(speed, gap, measured, expert_speed, frames.start)
        if path is not None:
            now = path.after_segment(now)
