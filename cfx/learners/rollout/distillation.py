"""Someone to learn from: networks that set the acceleration itself and have learned from the same drives before.

Behind regime switches the error of a drive says little about which parameters would have served better. A teacher says what to do
next, wherever the pupil has got to: so the pupil drives, and learns from each window alone, by an error that has not come through
later windows' switches (S. Ross, G. Gordon and D. Bagnell, 2011, *A reduction of imitation learning and structured prediction to
no-regret online learning*, AISTATS).

Shapes: N networks, D drives of each, S steps of a window, n parameters, s width of the policy's state, m of the model's memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.step import LeaderWindow, LoopState, WindowStep


@dataclass(frozen=True)
class Expert:
    """N networks that know the pupils' drives.

    Attributes:
        step: drives one window.
        material: the pupils' drivers, each driven from the base of the teacher's model.
    """

    step: WindowStep
    dataset: RolloutDataset

    @torch.no_grad()
    def watch(self, drives: RolloutBatch, leader_length: Tensor, most: int | None) -> Watching:
        """Begins to watch drives, having read what the pupil has; arguments as of `Material.read`, lengths `(N, D)` in m."""
        _, base, told = self.dataset.of_drives(drives)
        return Watching(
            self.step, base, told, leader_length, None, self.dataset.read(self.step, drives, most)
        )


@dataclass
class Watching:
    """A teacher beside N by D drives.

    Attributes:
        step: drives one window.
        base: in unit space, `(N, D, n)`.
        told: the same in the squashed space, and the drivers' driver features, `(N, D, n + k)`.
        leader_length: `(N, D)`, m.
        memory: of the teacher's model, `(N, D, m)`; None before the first window.
        state: of the teacher's networks, `(N, D, s)`.
    """

    step: WindowStep
    base: Tensor
    told: Tensor
    leader_length: Tensor
    memory: Tensor | None
    state: Tensor

    @torch.no_grad()
    def would_drive(self, recent: LoopState, ahead: LeaderWindow) -> Tensor:
        """Returns the speeds at which the teacher would drive the next window from where the pupil stands, `(N, D, S)` in m/s."""
        position, speed, acceleration = (value.detach() for value in recent[:3])
        memory = (
            self.step.model.initial_memory(speed[..., -1]) if self.memory is None else self.memory
        )
        stands = LoopState(position, speed, acceleration, memory, self.state)
        after, wanted, _ = self.step.drive(stands, ahead, self.leader_length, self.base, self.told)
        self.memory, self.state = after.memory, after.state
        return wanted


def apart(recent: LoopState) -> LoopState:
    """Returns the same state, through which gradients reach only what the policy remembers, not how the vehicle got there."""
    position, speed, acceleration, memory = (
        value.detach().requires_grad_() for value in recent[:4]
    )
    return LoopState(position, speed, acceleration, memory, recent.state)
