"""Learning through the simulation: the learner `rollout`.

From the settings down: `learner` puts a training together, `shard` cuts it, `train` trains a part
of it, and `module` takes gradient steps, for which `sampling` chooses trajectories of the
`dataset`. `loop` simulates their `inputs` window by window (`window`), and `loss` judges them.
"""

from __future__ import annotations

from cfx.learners.rollout.learner import RolloutLearner
from cfx.learners.rollout.settings import RolloutSettings

__all__ = ["RolloutLearner", "RolloutSettings"]
