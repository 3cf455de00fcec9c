"""Learning through the simulation: the learner `rollout`.

From the settings down: `learner` puts a training together, `shard` cuts it, and `module` trains a
part of it by gradient steps, for which `sampling` chooses trajectories of the `dataset`. `loop`
simulates them window by window (`window`, or compiled: `scan`), and `loss` judges them.
"""

from __future__ import annotations

from cfx.learners.rollout.learner import RolloutLearner
from cfx.learners.rollout.settings import RolloutSettings

__all__ = ["RolloutLearner", "RolloutSettings"]
