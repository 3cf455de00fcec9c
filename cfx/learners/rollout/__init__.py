"""Learning through the simulation: the learner `rollout`."""

from __future__ import annotations

from cfx.learners.rollout.learner import RolloutLearner, RolloutModule, RolloutSettings

__all__ = ["RolloutLearner", "RolloutModule", "RolloutSettings"]
