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
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.learners.rollout.dataset import Conditioning, RolloutDataset
from cfx.learners.rollout.inputs import Measured, RolloutBatch, RolloutInputs
from cfx.learners.rollout.scan import Observed, Scan
from cfx.learners.rollout.window import (
    GradientPath,
    LeaderWindow,
    LoopState,
    WindowStep,
)


class ExpertState(NamedTuple):
    """State of the experts beside N by D trajectories.

    Attributes:
        conditioning: what they know of the drivers.
        leader_length: `(N, D)`, m.
        memory: of the experts' model, `(N, D, m)`; None before the first window.
        state: of the experts' networks, `(N, D, s)`.
    """

    conditioning: Conditioning
    leader_length: Tensor
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
    def begin(self, batch: RolloutBatch, leader_length: Tensor, most: int | None) -> ExpertState:
        """Returns the experts' state before the first window.

        Args:
            batch: the trajectories.
            leader_length: `(N, D)`, m.
            most: windows of history that are observed at most; None: all.
        """
        conditioning = self.dataset.condition(batch)
        state = burn_in(self.step, self.dataset, batch, conditioning, most)
        return ExpertState(conditioning, leader_length, None, state)

    @torch.no_grad()
    def label(
        self, state: ExpertState, student: LoopState, leader: LeaderWindow
    ) -> tuple[Tensor, ExpertState]:
        """Says how the experts would drive the next window.

        Args:
            state: where the experts stand.
            student: where the students stand.
            leader: the leader around the window.

        Returns:
            Speeds `(N, D, S)`, m/s, and the experts' state afterwards.
        """
        position, speed = student.position.detach(), student.speed.detach()
        memory = state.memory
        if memory is None:
            memory = self.step.model.initial_memory(speed[..., -1])
        acceleration, latent = student.acceleration.detach(), student.latent.detach()
        start = LoopState(position, speed, acceleration, memory, state.state, latent)
        conditioning = state.conditioning
        after, speeds, _ = self.step.drive_window(
            start, leader, state.leader_length, conditioning.base, conditioning.features
        )
        return speeds, state._replace(memory=after.memory, state=after.state)


class Segment(NamedTuple):
    """Simulated values between two cuts of the gradients, `(N, D, frames)` each.

    Attributes:
        speed: m/s.
        gap: m.
        measured: at the same frames.
        expert_speed: the speeds at which experts would have driven each window, m/s; None without
            experts.
        first: how many frames were simulated before.
    """

    speed: Tensor
    gap: Tensor
    measured: Measured
    expert_speed: Tensor | None
    first: int = 0

    def only(self, trajectories: slice) -> Segment:
        """Returns the segment of some trajectories."""
        measured = Measured(*(values[:, trajectories] for values in self.measured))
        expert_speed = self.expert_speed
        if expert_speed is not None:
            expert_speed = expert_speed[:, trajectories]
        speed, gap = self.speed[:, trajectories], self.gap[:, trajectories]
        return Segment(speed, gap, measured, expert_speed, self.first)


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
    tokens, present = observed_windows(dataset, batch, conditioning, most)
    state = step.core.network.initial_state(*conditioning.pair.shape)
    if state.is_floating_point() and torch.is_grad_enabled():
        # As all later states, so that one compiled function serves all windows.
        state = state.detach().requires_grad_()
    for token, own in zip(tokens, present, strict=True):
        state = step.observe(token, conditioning.features, state, own)
    return state


def observed_windows(
    dataset: RolloutDataset, batch: RolloutBatch, conditioning: Conditioning, most: int | None
) -> tuple[Tensor, Tensor]:
    """Returns the tokens of measured windows before trajectories begin; none before a cold start.

    Returns:
        Tokens `(B, N, D, f)`, and whether a trajectory has the window, bool `(B, N, D)`.
    """
    start = torch.where(batch.cold_start, 0, batch.start)
    count = int(start.max())
    if most is not None:
        count = min(count, most)
    windows = start - count + torch.arange(count, device=start.device)[:, None, None]
    return dataset.recordings.tokens[conditioning.pair, windows.clamp(min=0)], windows >= 0


def simulate(
    step: WindowStep,
    dataset: RolloutDataset,
    batch: RolloutBatch,
    windows: int,
    path: GradientPath,
    *,
    burn_in_windows: int | None = None,
    expert: Expert | None = None,
    noise: Tensor | None = None,
    paths: int = 1,
    scan: Scan | None = None,
) -> Iterator[Segment]:
    """Simulates trajectories in closed loop.

    Args:
        step: simulates one window.
        dataset: what was measured.
        batch: the trajectories.
        windows: H.
        path: the way that gradients take back.
        burn_in_windows: windows of history that are observed at most; None: all.
        expert: says how it would have driven each window; None: nothing is asked.
        noise: what a stochastic head draws from, `(H, N, paths D, k)`; None: nothing is drawn.
        paths: of each trajectory, all of them behind the ones before. What was measured is observed
            once for all.
        scan: the window as compiled code, which simulates where no expert is asked and nothing is
            drawn; None: none.

    Yields:
        What was simulated between two cuts of the gradients.
    """
    if scan is not None and expert is None and noise is None:
        yield from _scanned(scan, dataset, batch, windows, path, burn_in_windows)
        return
    state = burn_in(step, dataset, batch, dataset.condition(batch), burn_in_windows)
    state = state.repeat(1, paths, 1)
    batch = batch.repeated(paths)
    conditioning = dataset.condition(batch)
    inputs = RolloutInputs.of(dataset.recordings.batch, conditioning.pair, batch, step, windows)
    now = inputs.initial(state)
    expert_state: ExpertState | None = None
    if expert is not None:
        expert_state = expert.begin(batch, inputs.leader_length, burn_in_windows)
    length = path.segment_length(windows)
    for first in range(0, windows, length):
        speeds, gaps, wanted = [], [], []
        for window in range(first, min(first + length, windows)):
            leader = inputs.leader_window(window)
            if expert is not None and expert_state is not None:
                label, expert_state = expert.label(expert_state, now, leader)
                wanted.append(label)
            known = (inputs.leader_length, conditioning.base, conditioning.features)
            if noise is None:
                now, speed, gap = step.drive_window(now, leader, *known)
            else:
                now, speed, gap = step.drive_window(now, leader, *known, noise[window])
            now = path.after_window(now)
            speeds.append(speed)
            gaps.append(gap)
        frames = slice(first * step.stride, (first + len(speeds)) * step.stride)
        expert_speed = None
        if wanted:
            expert_speed = torch.cat(wanted, -1)
        measured = inputs.measured_at(frames)
        speed, gap = torch.cat(speeds, -1), torch.cat(gaps, -1)
        yield Segment(speed, gap, measured, expert_speed, frames.start)
        now = path.after_segment(now)


def _scanned(
    scan: Scan,
    dataset: RolloutDataset,
    batch: RolloutBatch,
    windows: int,
    path: GradientPath,
    most: int | None,
) -> Iterator[Segment]:
    """As `simulate`, by compiled code."""
    conditioning = dataset.condition(batch)
    pairs, step = dataset.recordings.batch, scan.step
    inputs = RolloutInputs.of(pairs, conditioning.pair, batch, step, windows)
    tokens, present = observed_windows(dataset, batch, conditioning, most)
    known = conditioning.features.expand(len(tokens), -1, -1, -1)
    features = torch.cat([tokens, known], -1)
    features.sub_(step.core.scaler.mean[:, None]).div_(step.core.scaler.scale[:, None])
    observed = Observed(features, present.to(tokens.dtype))
    first = 0
    for speed, gap in scan.simulate(inputs, observed, conditioning, windows, path):
        measured = inputs.measured_at(slice(first, first + speed.shape[-1]))
        yield Segment(speed, gap, measured, None, first)
        first += speed.shape[-1]
