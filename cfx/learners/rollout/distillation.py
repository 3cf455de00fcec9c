"""Distillation: experts say how they would drive from where the student stands.

Behind regime switches the error of a whole trajectory says little about which parameters would have
served better. Experts are networks that set the acceleration themselves and were trained on the
same trajectories before. The student drives, the expert says what it would do there, and the
student learns from each window alone, by an error that has not come through later windows'
switches. This is the scheme of DAgger (S. Ross, G. Gordon and D. Bagnell, 2011, *A reduction of
imitation learning and structured prediction to no-regret online learning*, AISTATS).

Difference from the paper: trajectories are always the student's, from the first step on, and are
    not
collected: each is learned from once.

Shapes: N networks, D trajectories of each, S steps of a window, s width of the policy's state, m of
the model's memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.learners.rollout.batch import RolloutBatch
from cfx.learners.rollout.dataset import Conditioning, RolloutDataset
from cfx.learners.rollout.loop import burn_in
from cfx.learners.rollout.state import LeaderWindow, LoopState
from cfx.learners.rollout.step import WindowStep


class ExpertState(NamedTuple):
    """Where experts stand beside N by D trajectories.

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
