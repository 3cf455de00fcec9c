"""What the augmentation of cold starts makes of situations, for the valid range.

Trajectories are augmented where they are simulated (`RolloutBatch.scale`, `RolloutBatch.shift`).
Here the same is done to single situations, with as many that are made faster.

Shapes: P pairs, W windows of the longest pair.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.learners.rollout.sampling import SHIFTED
from cfx.learners.rollout.settings import RolloutSettings
from cfx.policies.features import History


class Augmentation:
    """Scales situations and makes some of them faster, as training does.

    Args:
        settings: how much.
        time_gap: of each driver, `(P,)`, s.
        generator: on the CPU.
    """

    def __init__(
        self, settings: RolloutSettings, time_gap: Tensor, generator: torch.Generator
    ) -> None:
        self.settings = settings
        self.time_gap = time_gap
        self.generator = generator

    def __call__(self, history: History, pairs: Tensor) -> History:
        """Returns other situations of pairs `(P,)`; signals `(P, W)` each."""
        s, like = self.settings, history.gap
        normal = torch.randn(like.shape, generator=self.generator).to(like)
        lots = torch.rand((2, *like.shape), generator=self.generator).to(like)
        scale = torch.exp(s.scaling * normal)
        shift = torch.where(lots[0] < SHIFTED, s.speed_shift * lots[1], 0.0)
        wider = shift * self.time_gap[pairs][:, None].to(like)
        return History(
            leader_speed=history.leader_speed * scale + shift,
            leader_acceleration=history.leader_acceleration * scale,
            follower_speed=history.follower_speed * scale + shift,
            follower_acceleration=history.follower_acceleration * scale,
            gap=history.gap * scale + wider,
        )
