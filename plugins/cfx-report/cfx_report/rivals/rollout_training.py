"""Training of networks that drive: stretches of recordings are driven, and gradients flow back.

As in a test the network drives some seconds behind a recorded leader, its
speeds and gaps are compared with the recorded ones, and what differs is traced back through all
steps (back-propagation through time). Sites are drawn evenly, whatever their size.

Shapes: B stretches, T frames, f features. SI units.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from cfx.plugin import Pair, PairBatch, PairSet, Settings, threads
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver, rollout

FEATURES = 5
"""What a network sees of a frame."""

_BRAKES, _ACCELERATES = 8.0, 4.0
"""m/s2: what a network can ask for."""

_FAR_M = 100.0
_GAP_WEIGHT = 0.1
"""1/s: an error of a metre counts as one of 0.1 m/s; both are then about as large."""

_VALIDATED = 0.1
"""Share of the drivers who are kept for validation; of the fold's training pairs alone."""


class RolloutSettings(Settings):
    """Settings of networks that are trained by rollout: the budget."""

    hidden_size: int = Field(32, ge=1, description="width of the network")
    steps: int = Field(400, ge=1, description="steps of the optimizer")
    stretches: int = Field(64, ge=1, description="stretches of recordings in a step")
    seconds: float = Field(20.0, gt=0.5, description="s that a stretch lasts")
    learning_rate: float = Field(0.003, gt=0, description="of Adam; falls to 0 as a half cosine")


class RolloutRival(Rival):
    """Base of networks that set the acceleration and are trained by driving."""

    schema: ClassVar[type[Settings]] = RolloutSettings
    settings: RolloutSettings
    trains = True

    @abstractmethod
    def network(self) -> NetworkDriver:
        """Returns the network, untrained; float64, as everything that drives."""

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        s = self.settings
        with torch.random.fork_rng(devices=[]), threads.one_thread():
            torch.manual_seed(seed)
            driver = self.network()
            random = np.random.default_rng(seed)
            learned, kept = _divided(pairs, random)
            validation = _stretches(kept, 4 * s.stretches, s.seconds, driver, random)
            optimizer = torch.optim.Adam(driver.module.parameters(), s.learning_rate)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, s.steps)
            best, least = copy.deepcopy(driver.module.state_dict()), np.inf
            for step in range(1, s.steps + 1):
                loss = _loss(driver, _stretches(learned, s.stretches, s.seconds, driver, random))
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]  # PyTorch declares no types for it
                nn.utils.clip_grad_norm_(driver.module.parameters(), 1.0)
                optimizer.step()
                schedule.step()
                if step % max(1, s.steps // 10) == 0:
                    with torch.no_grad():
                        error = float(_loss(driver, validation))
                    if error < least:
                        best, least = copy.deepcopy(driver.module.state_dict()), error
            driver.module.load_state_dict(best)
        return driver


class NetworkDriver(StepDriver):
    """A network that says an acceleration every half second.

    Attributes:
        module: the network; it answers numbers that `acceleration_of` brings into bounds.
    """

    module: nn.Module
    every = 5


def features_of(seen: Seen) -> Tensor:
    """Returns what a network sees of each frame, `(P, L, f)`, numbers about as large as 1."""
    gap = seen.gap.clamp(0.0, _FAR_M)
    return torch.stack(
        [
            seen.follower_speed / 10.0 - 1.0,
            (seen.leader_speed - seen.follower_speed) / 3.0,
            gap / 20.0 - 1.0,
            gap / (seen.follower_speed + 1.0) - 1.5,
            seen.leader_acceleration.clamp(-4.0, 4.0),
        ],
        -1,
    )


def acceleration_of(answer: Tensor) -> Tensor:
    """Brings answers into the bounds of what a car can do; near 0 they are accelerations."""
    return torch.where(
        answer < 0.0,
        _BRAKES * torch.tanh(answer / _BRAKES),
        _ACCELERATES * torch.tanh(answer / _ACCELERATES),
    )


def _divided(pairs: PairSet, random: np.random.Generator) -> tuple[list[Pair], list[Pair]]:
    """Divides pairs into those that are learned from, and those of drivers kept for validation."""
    drivers = sorted(set(pairs.drivers))
    count = max(1, round(_VALIDATED * len(drivers)))
    chosen = set(random.permutation(np.array(drivers, dtype=object))[:count].tolist())
    learned = [pair for pair in pairs if pair.driver not in chosen]
    kept = [pair for pair in pairs if pair.driver in chosen]
    return (learned, kept) if learned else (kept, kept)


def _stretches(
    pairs: Sequence[Pair],
    count: int,
    seconds: float,
    driver: NetworkDriver,
    random: np.random.Generator,
) -> tuple[PairBatch, Tensor]:
    """Draws stretches, each site as often as another; with the last measured frame of each.

    A fourth begins with a recording, before which nothing was seen, as in tests of full
    trajectories.
    """
    of_site: dict[str, list[Pair]] = {}
    for pair in pairs:
        of_site.setdefault(pair.site, []).append(pair)
    sites = list(of_site.values())
    past = round(driver.memory_s / pairs[0].dt) + driver.lags
    length = round(seconds / pairs[0].dt)
    drawn, first = [], []
    for number in range(count):
        site = sites[int(random.integers(len(sites)))]
        pair = site[int(random.integers(len(site)))]
        at = 0
        if number % 4:
            at = int(random.integers(max(1, len(pair) - length)))
        begin, end = max(0, at - past), min(len(pair), at + length + 1)
        drawn.append(_stretch(pair, begin, end, number))
        first.append(at - begin)
    return PairBatch.of(drawn), torch.tensor(first)


def _stretch(pair: Pair, begin: int, end: int, number: int) -> Pair:
    part = pair.with_arrays(lambda values: values[begin:end])
    return replace(part, pair_id=str(number))


def _loss(driver: NetworkDriver, drawn: tuple[PairBatch, Tensor]) -> Tensor:
    """Returns the mean over stretches of the errors by which tests judge."""
    batch, first = drawn
    steps = int((batch.lengths - 1 - first).max())
    speed, gap = rollout(driver, batch, first, steps)
    frames = first[:, None] + torch.arange(steps + 1)
    counted = (frames < batch.lengths[:, None]) & (frames > first[:, None])
    index = frames.clamp(max=batch.mask.shape[1] - 1)
    error = _root_mean_square(speed - batch.follower_speed.gather(1, index), counted)
    error = error + _GAP_WEIGHT * _root_mean_square(gap - batch.gap.gather(1, index), counted)
    return error.mean()


def _root_mean_square(values: Tensor, counted: Tensor) -> Tensor:
    squares = torch.where(counted, values, 0.0).square().sum(1) / counted.sum(1).clamp(min=1)
    return (squares + 1e-6).sqrt()  # the root has no slope at 0
