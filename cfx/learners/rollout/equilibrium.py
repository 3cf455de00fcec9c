"""The gap at which drivers settle: rollouts behind leaders of constant speed.

Errors of speed and gap over seconds say little about the gap that a driver keeps in the end: where
gaps of a recording hardly settle, a policy that follows speeds keeps whatever gap it began with.
So in each gradient step some trajectories last a minute behind a leader whose speed is constant,
begin at any time gap, and are compared with the recorded relation of gap and speed
(`cfx.data.steady`) of the drivers that the network learns from.

Drivers of whom nothing is known are to settle at the gap of the mean spacing. Drivers whose
features are known are to keep their own: that gap's spacing times the ratio of theirs to it, in the
mean over the speeds at which they were recorded.

Shapes: U recorded pairs, N networks (each member of an ensemble counts), B drivers of the network
that has most, D trajectories of each network, K ranges of speed, G speeds of the relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.data.steady import VEHICLE_M, SteadyFollowing, relation_of, steady_following
from cfx.errors import ConfigError
from cfx.learners.base import TrainingData
from cfx.learners.rollout.dataset import Recordings, RolloutBatch, RolloutDataset
from cfx.learners.rollout.simulated import SITES
from cfx.learners.rollout.window import Segment

TRAJECTORIES = 16
"""Behind leaders of constant speed, of each network in a gradient step."""

TIME_GAPS_S = (0.6, 3.0)
"""s: time gaps at which they begin in training."""

STANDING_M = 2.0
"""m: added to the gap at the start, which a standing vehicle has too."""

VALIDATION_TIME_GAPS_S = (1.0, 2.5)
"""s: time gaps at which they begin in validation."""

VALIDATION_SPEEDS = 8
"""Speeds of validation, evenly over the recorded ones."""

DECAY = 0.95
"""Factor on gradients that come back through one window. Behind a leader of constant speed they do
not explode, and a time gap needs some ten seconds to show in the gap."""

SETTLED = 0.5
"""Share of the time after which the gap counts."""

GRID_MPS = 0.25
"""m/s: between the speeds at which the relation is stored."""

RATIOS = (0.5, 2.0)
"""Least and greatest ratio of a driver's spacing to the mean one that is asked for."""

_EPSILON = 1e-4
"""Keeps the slope of a root finite where a trajectory has no error."""


@dataclass(frozen=True)
class EquilibriumTargets:
    """The relation of gap and speed that each network is to have.

    Attributes:
        speed: G speeds, m/s.
        gap: of the mean spacing, `(N, G)`, m; NaN where nobody was recorded.
        ratio: of each place's driver's spacing to the mean one, `(N, B)`; NaN where it is not
            known, or the driver is not learned from.
    """

    speed: Tensor
    gap: Tensor
    ratio: Tensor

    @classmethod
    def of(cls, training_data: TrainingData, dataset: RolloutDataset) -> EquilibriumTargets:
        """Measures what each network's drivers do; simulated ones do not count.

        Raises:
            ConfigError: nobody from whom a network learns follows steadily at two speeds.
        """
        recordings = dataset.recordings
        frames = torch.arange(recordings.batch.mask.shape[1], device=dataset.pair.device)
        last = training_data.pairs.split.frame.to(frames.device)[recordings.pair]
        following = steady_following(recordings.batch, frames <= last[:, None])
        drivers, sites = training_data.pairs.known_drivers, training_data.pairs.sites
        names, is_recorded = [], []
        for number in recordings.pair.tolist():
            names.append(drivers[number])
            is_recorded.append(sites is None or sites[number] not in SITES)
        counts = torch.tensor(is_recorded, device=dataset.pair.device)
        grid = np.arange(0.0, 60.0, GRID_MPS)
        gaps, ratios = [], []
        for network in range(len(dataset.pair)):
            places = dataset.trains[network] & counts[dataset.pair[network]]
            rows = dataset.pair[network][places]
            gap, ratio = _of_network(_rows(following, rows), rows, names, grid)
            if not np.isfinite(gap).any():
                raise ConfigError(
                    "learner.equilibrium_weight: nobody from whom a network learns follows a"
                    " leader steadily at two speeds, so nothing says which gap they keep; give more"
                    " recordings, or learner.equilibrium_weight=0"
                )
            gaps.append(torch.as_tensor(gap))
            of_places = torch.full(places.shape, torch.nan, dtype=torch.float64)
            of_places[places.cpu()] = torch.as_tensor(ratio)
            ratios.append(of_places)
        device = dataset.pair.device
        return cls(
            torch.as_tensor(grid).float().to(device),
            torch.stack(gaps).float().to(device),
            torch.stack(ratios).float().to(device),
        )

    def only(self, networks: slice) -> EquilibriumTargets:
        """Returns the relations of some of the networks."""
        return replace(self, gap=self.gap[networks], ratio=self.ratio[networks])

    def at(self, speed: Tensor) -> Tensor:
        """Returns the gap of the mean spacing at speeds `(N, D)`, m."""
        place = (speed / GRID_MPS).round().long().clamp(0, self.gap.shape[1] - 1)
        return self.gap.gather(1, place)

    def speeds(self, share: Tensor) -> Tensor:
        """Returns speeds at shares `(N, D)` of each network's recorded ones, m/s, on the grid."""
        measured = ~self.gap.isnan()
        place = torch.arange(self.gap.shape[1], device=share.device)
        first = torch.where(measured, place, self.gap.shape[1]).amin(1, keepdim=True)
        last = torch.where(measured, place, 0).amax(1, keepdim=True)
        return self.speed[(first + share * (last - first)).round().long()]


class SteadyTrajectories(NamedTuple):
    """Trajectories behind leaders of constant speed, as `simulate` takes them.

    Attributes:
        dataset: the leaders, a pair for each of N by D trajectories.
        batch: all of these trajectories.
        target: the gap at which each is to settle, `(N, D)`, m.
    """

    dataset: RolloutDataset
    batch: RolloutBatch
    target: Tensor

    def loss(self, segment: Segment) -> Tensor:
        """Returns the RMS of the logarithm of spacing over its target, `(N,)`.

        A relative error of spacing is one of the flow. Only frames after `SETTLED` count.

        Args:
            segment: the whole trajectories.
        """
        settled = segment.gap[..., int(SETTLED * segment.gap.shape[-1]) :]
        target = (self.target + VEHICLE_M)[..., None]
        # A vehicle that has run into its leader has no spacing to take the logarithm of.
        error = ((settled + VEHICLE_M).clamp(min=0.5) / target).log()
        return (error.square().mean(-1) + _EPSILON).sqrt().mean(1)


class SteadySampler:
    """Makes trajectories behind leaders of constant speed.

    Args:
        dataset: the drivers of the networks.
        targets: at which gap they are to settle.
        seconds: that a trajectory lasts.
        stride: frames of a window.
        length: frames that a policy sees.

    Raises:
        ConfigError: networks read signals that simulated leaders do not have.
    """

    def __init__(
        self,
        dataset: RolloutDataset,
        targets: EquilibriumTargets,
        seconds: float,
        stride: int,
        length: int,
    ) -> None:
        batch = dataset.recordings.batch
        if batch.surroundings:
            raise ConfigError(
                "learner.equilibrium_weight: the policy reads further signals, which a leader of"
                " constant speed does not have; leave them out of policy.inputs, or set"
                " learner.equilibrium_weight=0"
            )
        self.dataset, self.targets = dataset, targets
        self.windows = max(1, round(seconds / (stride * batch.dt)))
        self._frames = self.windows * stride + length + 1

    def training(self, generator: torch.Generator) -> SteadyTrajectories:
        """Returns those of a gradient step: random speeds and starts, and drivers by halves.

        Where driver features are known, half of the drivers have their own.
        """
        dataset = self.dataset
        shares = dataset.uniform((3, TRAJECTORIES), generator)
        speed = self.targets.speeds(shares[:, 0])
        low, high = TIME_GAPS_S
        time_gap = low + shares[:, 1] * (high - low)
        target = self.targets.at(speed)
        cold_start = torch.ones_like(speed, dtype=torch.bool)
        place = torch.zeros_like(speed, dtype=torch.long)
        is_known = ~self.targets.ratio.isnan()
        if dataset.recordings.driver_features.shape[-1] > 0 and bool(is_known.any(1).all()):
            cold_start[:, ::2] = False
            upto = is_known.long().cumsum(1)
            number = (shares[:, 2] * upto[:, -1:]).long() + 1
            place = torch.searchsorted(upto, number)
            ratio = self.targets.ratio.gather(1, place).clamp(*RATIOS)
            of_driver = ratio * (target + VEHICLE_M) - VEHICLE_M
            target = torch.where(cold_start, target, of_driver)
        return self._made(speed, time_gap, place, cold_start, target)

    def validation(self) -> SteadyTrajectories:
        """Returns drivers of whom nothing is known, at even speeds, from either start."""
        device = self.dataset.pair.device
        shares = torch.linspace(0.0, 1.0, VALIDATION_SPEEDS, device=device)
        starts = torch.tensor(VALIDATION_TIME_GAPS_S, device=device)
        networks = len(self.dataset.pair)
        share = shares.repeat(len(starts)).expand(networks, -1)
        time_gap = starts.repeat_interleave(len(shares)).expand(networks, -1)
        speed = self.targets.speeds(share)
        everyone = torch.ones_like(speed, dtype=torch.bool)
        place = torch.zeros_like(speed, dtype=torch.long)
        return self._made(speed, time_gap, place, everyone, self.targets.at(speed))

    def _made(
        self, speed: Tensor, time_gap: Tensor, place: Tensor, cold_start: Tensor, target: Tensor
    ) -> SteadyTrajectories:
        """Makes trajectories; all tables are `(N, D)`."""
        dataset, dt = self.dataset, self.dataset.recordings.batch.dt
        networks, count = speed.shape
        leader_speed = speed.flatten()[:, None].expand(-1, self._frames)
        time = dt * torch.arange(self._frames, device=speed.device)
        begin = (STANDING_M + time_gap * speed).flatten()[:, None]
        still = torch.zeros_like(leader_speed)
        position = leader_speed * time
        length = torch.full_like(begin[:, 0], VEHICLE_M)
        pairs = PairBatch(
            leader_position=position + begin + VEHICLE_M,
            leader_speed=leader_speed,
            leader_acceleration=still,
            follower_position=position,
            follower_speed=leader_speed,
            follower_acceleration=still,
            leader_length=length,
            lengths=torch.full_like(length, self._frames).long(),
            mask=torch.ones_like(leader_speed, dtype=torch.bool),
            dt=dt,
        )
        row = torch.arange(networks, device=speed.device)[:, None]
        of_driver = dataset.recordings
        driver_row = dataset.pair.gather(1, place).flatten()
        every = torch.arange(networks * count, device=speed.device)
        features = of_driver.driver_features[driver_row]
        tokens = of_driver.tokens.new_zeros((len(every), 1, of_driver.tokens.shape[-1]))
        recordings = Recordings(pairs, every, tokens, features, time_gap.flatten())
        everyone = torch.ones_like(cold_start)
        last = torch.full_like(place, self._frames - 1)
        steady = replace(
            dataset,
            recordings=recordings,
            pair=every.view(networks, count),
            known_as=every.view(networks, count),
            in_queue=~everyone,
            trains=everyone,
            validates=~everyone,
            until=last,
            last=last,
            base=dataset.base[row, place],
            chance=None,
        )
        batch = RolloutBatch(
            place=torch.arange(count, device=speed.device).expand(networks, -1),
            start=torch.zeros_like(place),
            cold_start=cold_start,
            last=last,
            weight=everyone.float(),
        )
        return SteadyTrajectories(steady, batch, target)


def _rows(following: SteadyFollowing, rows: Tensor) -> SteadyFollowing:
    """Returns the steady following of some pairs."""
    return SteadyFollowing(*(values[rows] for values in following))


def _of_network(
    following: SteadyFollowing, rows: Tensor, names: Sequence[str], grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the relation of some pairs on a grid of speeds, and the ratio of each pair to it.

    Args:
        following: of these pairs, `(Q, K)`.
        rows: which of the U pairs these are, `(Q,)`.
        names: the driver of each of the U pairs.
        grid: speeds, m/s.

    Returns:
        Gaps `(G,)`, m, NaN outside of what was recorded; and ratios `(Q,)`, NaN where a pair never
        followed steadily at such a speed.
    """
    drivers = [names[row] for row in rows.tolist()]
    relation = relation_of(following, drivers)
    if len(relation.speed) < 2:
        # Of a few drivers, such as the cars of one campaign, each range of speed counts.
        relation = relation_of(following, drivers, least=1)
    if len(relation.speed) < 2:
        return np.full_like(grid, np.nan), np.full(len(drivers), np.nan)
    speed, gap = following.speed.cpu().numpy(), following.gap.cpu().numpy()
    usual = relation.gap_at(speed)
    measured = np.isfinite(gap) & np.isfinite(usual)
    ratio = np.where(measured, (gap + VEHICLE_M) / (usual + VEHICLE_M), 0.0)
    count = measured.sum(1)
    mean = np.where(count > 0, ratio.sum(1) / np.maximum(count, 1), np.nan)
    return relation.gap_at(grid), mean
