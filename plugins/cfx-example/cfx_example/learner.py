"""A learner: how a policy is trained. This one trains several times and keeps the best.

A protocol calls `fit` once for all its folds, whose networks are trained side by side.
"""

from __future__ import annotations

from dataclasses import replace

import cfx
import torch
from cfx.plugin import Learner, Policy, Settings, TrainingData, TrainingResult
from pydantic import Field
from torch import Tensor


class BestOfSettings(Settings):
    """Settings of `best_of`."""

    restarts: int = Field(3, ge=1, description="trainings, each from other initial weights")
    epochs: int = Field(
        100, ge=1, description="passes over the training windows at most, of each training"
    )


class BestOf(Learner):
    """Runs cfx's `imitation` several times, and keeps each network's best weights.

    The best are those with the smallest validation loss.
    """

    schema = BestOfSettings
    settings: BestOfSettings
    needs_labels = True

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        imitation = cfx.get("learner", "imitation")(epochs=self.settings.epochs)
        assert isinstance(imitation, Learner)
        runs = []
        losses = []
        for restart in range(self.settings.restarts):
            run = imitation.fit(policy, replace(training_data, seed=training_data.seed + restart))
            runs.append(run)
            losses.append(_smallest_losses(run, training_data.names))
        best = torch.stack(losses).argmin(dim=0)  # (N,): the first training where none has a loss
        networks = torch.arange(len(best))
        # Every weight has the network as its first dimension, so that networks of several trainings
        # can be put together.
        chosen = {}
        for name in runs[0].network.state_dict():
            weights = torch.stack([run.network.state_dict()[name] for run in runs])
            chosen[name] = weights[best, networks]
        runs[0].network.load_state_dict(chosen)
        return runs[0]


def _smallest_losses(run: TrainingResult, names: tuple[str, ...]) -> Tensor:
    """Returns the smallest validation loss of each network, `(N,)`; infinity without one."""
    smallest = run.curves.groupby("network")["validation_loss"].min()
    losses = torch.tensor([smallest.get(name, torch.inf) for name in names])
    return losses.nan_to_num(nan=torch.inf)
