"""Samples the trajectories of gradient steps and of validation, and augments them.

Trajectories are augmented where they are simulated (`RolloutBatch.scale`, `RolloutBatch.shift`).
`augmentation` does the same to single situations, for the valid range, with as many that are made
faster.

Shapes: P pairs, N networks, D trajectories of each, W windows of the longest pair.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.learners.base import Augment
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.settings import RolloutSettings
from cfx.policies.history import History

_VALIDATION_STARTS = (0.2, 0.4, 0.6, 0.8)
"""Shares of a validation trajectory at which the policy takes over."""


SHIFTED = 0.3
"""Share of the cold starts that are made faster.

Accelerations stay as they were recorded: a factor on all distances and speeds would multiply them,
and one on time as well would make time gaps grow with the speed.
"""


class TrajectorySampler:
    """Chooses trajectories.

    Args:
        dataset: the drivers and their recordings.
        settings: how many, how long and how many cold starts.
        stride: frames of a window.
        has_cold_starts: whether cold starts differ from other trajectories.
        seed: of the training; what is sampled in a gradient step follows from it and from the
            step's number alone.
    """

    def __init__(
        self,
        dataset: RolloutDataset,
        settings: RolloutSettings,
        stride: int,
        *,
        has_cold_starts: bool,
        seed: int,
    ) -> None:
        self.dataset = dataset
        self.settings = settings
        self.stride = stride
        self.seed = seed
        self.cold_start_fraction = 0.0
        if has_cold_starts:
            self.cold_start_fraction = settings.cold_start_fraction
        generator = torch.Generator().manual_seed(seed)
        self.validation_places = dataset.validation_places(settings.drivers, generator)

    @property
    def trajectories(self) -> int:
        """How many trajectories are sampled of each network in a step, with weight or without."""
        drivers = self.dataset.pair.shape[1]
        if self.settings.drivers is not None:
            drivers = min(drivers, self.settings.drivers)
        return self.settings.draws * drivers

    def step_seed(self, step: int) -> int:
        """Returns the seed of everything random in a gradient step.

        It depends on nothing else, so that a training that was continued is the same training.
        """
        return (self.seed * 1_000_003 + step) % 2**63

    def training(self, step: int) -> RolloutBatch:
        """Returns the trajectories of a gradient step."""
        s, dataset = self.settings, self.dataset
        generator = torch.Generator().manual_seed(self.step_seed(step))
        place = dataset.training_places(s.drivers, generator).repeat(1, s.draws)
        shape = tuple(place.shape[1:])
        share = dataset.uniform(shape, generator)
        until = dataset.until.gather(1, place)
        latest = (until // self.stride - s.horizon // 2).clamp(min=1)
        draws = dataset.uniform(shape, generator)
        cold_start = draws < self.cold_start_fraction
        scale = None
        if self.cold_start_fraction > 0 and s.scaling > 0:
            factor = torch.exp(s.scaling * dataset.normal(shape, generator))
            scale = torch.where(cold_start, factor, 1.0)
        shift, wider = self._shift(place, cold_start, generator)
        weight = dataset.trains.gather(1, place).float()
        start = (share * latest).long()
        batch = RolloutBatch(place, start, cold_start, until, weight, scale, shift, wider)
        return batch.without_unweighted()

    def _shift(
        self, place: Tensor, cold_start: Tensor, generator: torch.Generator
    ) -> tuple[Tensor | None, Tensor | None]:
        """Returns the speed (m/s) and the gap (m) added to trajectories, `(N, D)` each."""
        s, dataset = self.settings, self.dataset
        if self.cold_start_fraction == 0 or s.speed_shift == 0:
            return None, None
        shape = tuple(place.shape[1:])
        draws, speed = dataset.uniform(shape, generator), dataset.uniform(shape, generator)
        is_shifted = cold_start & (draws < SHIFTED) & ~dataset.in_queue.gather(1, place)
        shift = torch.where(is_shifted, s.speed_shift * speed, 0.0)
        time_gap = dataset.recordings.time_gap[dataset.pair.gather(1, place)]
        return shift, shift * time_gap

    def validation_with_history(
        self, shares: tuple[float, ...] = _VALIDATION_STARTS
    ) -> RolloutBatch:
        """Returns validation trajectories over the horizon, with observed history.

        Args:
            shares: of each trajectory, at which the policy takes over.
        """
        dataset, place = self.dataset, self.validation_places
        last, until = dataset.last.gather(1, place), dataset.until.gather(1, place)
        begin = torch.where(until < last, until, 0)
        starts = []
        for share in shares:
            starts.append(((begin + share * (last - begin)) / self.stride).long())
        copies = len(starts)
        places = place.repeat(1, copies)
        return RolloutBatch(
            place=places,
            start=torch.cat(starts, 1),
            cold_start=torch.zeros_like(places, dtype=torch.bool),
            last=last.repeat(1, copies),
            weight=self._validation_weight().repeat(1, copies),
        )

    def validation_cold_starts(self) -> RolloutBatch:
        """Returns full validation trajectories of which nothing was observed.

        Drivers of whom only the end is kept for validation have no weight.
        """
        dataset, place = self.dataset, self.validation_places
        last = dataset.last.gather(1, place)
        is_whole = dataset.until.gather(1, place) == last
        return RolloutBatch(
            place=place,
            start=torch.zeros_like(place),
            cold_start=torch.ones_like(place, dtype=torch.bool),
            last=last,
            weight=self._validation_weight() * is_whole,
        )

    def _validation_weight(self) -> Tensor:
        """Returns how much each validation trajectory counts, `(N, D)`: as often as sampled."""
        weight = self.dataset.validates.float()
        if self.dataset.chance is not None:
            chance = self.dataset.chance * self.dataset.validates
            weight = (chance / chance.amax(1, keepdim=True).clamp(min=1e-300)).float()
        return weight.gather(1, self.validation_places)


def augmentation(
    settings: RolloutSettings, time_gap: Tensor, generator: torch.Generator
) -> Augment:
    """Returns what scales situations and makes some of them faster, as training does.

    Args:
        settings: how much.
        time_gap: of each driver, `(P,)`, s.
        generator: on the CPU.
    """

    def augment(history: History, pairs: Tensor) -> History:
        gap = history["gap"]
        normal = torch.randn(gap.shape, generator=generator).to(gap)
        draws = torch.rand((2, *gap.shape), generator=generator).to(gap)
        scale = torch.exp(settings.scaling * normal)
        shift = torch.where(draws[0] < SHIFTED, settings.speed_shift * draws[1], 0.0)
        wider = shift * time_gap[pairs][:, None].to(gap)
        return {
            "leader_speed": history["leader_speed"] * scale + shift,
            "leader_acceleration": history["leader_acceleration"] * scale,
            "follower_speed": history["follower_speed"] * scale + shift,
            "follower_acceleration": history["follower_acceleration"] * scale,
            "gap": gap * scale + wider,
        }

    return augment
