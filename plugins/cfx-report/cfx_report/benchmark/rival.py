"""What a rival is: it learns from the pairs of a fold, and then drives followers that it never saw.

An entry point of the group `cfx.rivals` makes one known. Its settings are those of any component.
`Driver` is what learning gives; `StepDriver` is one that says an acceleration from what it sees,
and is simulated by `rollout`. Forecasts are simulations from many moments, unless a driver says
otherwise.

Shapes: P pairs, T frames, L frames that a driver sees at once, S samples. SI units.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from cfx.plugin import Component, PairBatch, PairSet, threads

__all__ = ["Driver", "Rival", "Seen", "StepDriver", "rollout"]


class Rival(Component):
    """Base of every rival of the benchmark.

    Life cycle: the benchmark makes one from its settings, and calls `fit` once for each fold, with
    the pairs that this fold may learn from. What tunes itself does so within these pairs. Nothing
    is kept on the rival between folds.

    Attributes:
        trains: whether learning depends on chance, so that one seed says too little.
        reference: where the method is published.
    """

    kind = "rival"
    trains: ClassVar[bool] = False
    reference: ClassVar[str] = ""

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.reference else " must say its `reference`: where the method is published"

    @abstractmethod
    def fit(self, pairs: PairSet, seed: int) -> Driver:
        """Learns from recorded pairs.

        Args:
            pairs: those of a fold, of any roads and drivers; all signals are known.
            seed: of everything that is left to chance; the same seed gives the same driver.
        """


class Driver(ABC):
    """Drives followers behind recorded leaders.

    Life cycle: `adapted` is called first where the past of each driver is given, then `drive`, or
    `forecast`. The follower's signals after `first` are NaN: nobody can learn from them.

    Attributes:
        is_stochastic: whether another seed drives otherwise, so that forecasts are sampled.
    """

    is_stochastic: bool = False

    @abstractmethod
    def drive(self, batch: PairBatch, first: Tensor, seed: int | None) -> Tensor:
        """Drives each follower from its last measured frame to the end of its pair.

        Args:
            batch: P pairs. The leader is known throughout, the follower up to `first`.
            first: the last measured frame of each, `(P,)` int64.
            seed: of what is left to chance; None: nothing is drawn.

        Returns:
            Speeds `(P, T)`, m/s, those after `first` in each row count. Positions follow from
            them: `x' = x + v' dt`, as everywhere in cfx.
        """

    def forecast(self, batch: PairBatch, first: Tensor, seed: int, samples: int) -> Tensor:
        """Returns speeds that may happen, `(S, P, T)`; S is 1 where nothing is left to chance.

        Args:
            batch, first: as for `drive`.
            seed: of the first sample.
            samples: how many of a stochastic driver.
        """
        if not self.is_stochastic:
            return self.drive(batch, first, None)[None]
        paths = []
        for number in range(samples):
            paths.append(self.drive(batch, first, seed * 1_000_003 + number))
        return torch.stack(paths)

    def adapted(self, past: PairSet, seed: int) -> Driver:
        """Returns a driver who knows the past of each follower; by default the same.

        Args:
            past: the recorded pairs up to the last measured frame, in the order of the batch that
                is driven then.
            seed: of what is left to chance.
        """
        return self


class Seen(NamedTuple):
    """The last L frames that followers see, up to now: `(P, L)` each, SI units.

    Before a recording begins, its first frame is repeated.
    """

    leader_speed: Tensor
    leader_acceleration: Tensor
    follower_speed: Tensor
    follower_acceleration: Tensor
    gap: Tensor


class StepDriver(Driver):
    """A driver that says an acceleration from what it sees.

    The state is passed in and returned; `memory` may hold anything of a batch, such as the state of
    a recurrent network.

    Attributes:
        lags: L, frames that are seen at once.
        every: frames for which an acceleration holds.
        memory_s: s of the measured past that are shown before the first frame, so that the memory
            knows them.
    """

    lags: int = 1
    every: int = 1
    memory_s: float = 0.0

    @abstractmethod
    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Returns accelerations `(P,)`, m/s2, and the memory afterwards.

        Args:
            seen: what each of P followers sees.
            memory: as returned the last time, or by `begin`.
            generator: draws, on the CPU, what is left to chance; None: nothing is drawn.
        """

    def begin(self, seen: Seen) -> Tensor:
        """Returns the memory of P followers before anything; its first dimension is P."""
        return seen.gap.new_zeros((len(seen.gap), 0))

    @torch.no_grad()
    @threads.one_thread()
    def drive(self, batch: PairBatch, first: Tensor, seed: int | None) -> Tensor:
        steps = int((batch.lengths - 1 - first).max())
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        speed, _ = rollout(self, batch, first, steps, generator)
        return on_frames(speed, batch, first)


def on_frames(speed: Tensor, batch: PairBatch, first: Tensor) -> Tensor:
    """Returns simulated speeds `(*, P, K + 1)` at the frames of their pairs, `(*, P, T)`.

    Args:
        speed: from the last measured frame on, which is number 0.
        batch: the P pairs.
        first: the last measured frame of each, `(P,)`.
    """
    frames = torch.arange(batch.mask.shape[1], device=first.device)
    step = (frames - first[:, None]).clamp(min=0, max=speed.shape[-1] - 1)
    return speed.gather(-1, step.expand(*speed.shape[:-1], -1))


def rollout(
    driver: StepDriver,
    batch: PairBatch,
    first: Tensor,
    steps: int,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulates P followers from their last measured frames on; gradients flow through it.

    Forward Euler with the new speed, as `cfx.simulation` does it: `v' = max(0, v + a dt)`,
    `x' = x + v' dt`.

    Args:
        driver: says the accelerations.
        batch: P pairs; a pair that ends earlier goes on at its leader's last speed.
        first: the last measured frame of each, `(P,)`.
        steps: K.
        generator: draws what is left to chance; None: nothing is drawn.

    Returns:
        Speed and gap `(P, K + 1)`, number 0 being measured.
    """
    dt, lags = batch.dt, driver.lags
    shown = round(driver.memory_s / dt)
    view = _View(batch, first, before=shown + lags - 1, steps=steps)
    now = shown + lags - 1
    speeds = list(view.speed[:, : now + 1].unbind(1))
    accelerations = list(view.acceleration[:, : now + 1].unbind(1))
    gaps = list(view.gap[:, : now + 1].unbind(1))

    def seen_at(column: int) -> Seen:
        recent = slice(column - lags + 1, column + 1)
        return Seen(
            view.leader_speed[:, recent],
            view.leader_acceleration[:, recent],
            torch.stack(speeds[recent], 1),
            torch.stack(accelerations[recent], 1),
            torch.stack(gaps[recent], 1),
        )

    memory = driver.begin(seen_at(lags - 1))
    for column in range(lags - 1, now):
        if (now - column) % driver.every == 0:
            _, memory = driver.accelerations(seen_at(column), memory, generator)
    chosen = accelerations[now]
    for step in range(steps):
        column = now + step
        if step % driver.every == 0:
            chosen, memory = driver.accelerations(seen_at(column), memory, generator)
        speed = (speeds[column] + chosen * dt).clamp(min=0.0)
        moved = view.leader_position[:, column + 1] - view.leader_position[:, column]
        gaps.append(gaps[column] + moved - speed * dt)
        accelerations.append((speed - speeds[column]) / dt)
        speeds.append(speed)
    return torch.stack(speeds[now:], 1), torch.stack(gaps[now:], 1)


class _View:
    """Signals of P pairs, `(P, before + 1 + steps)`; the last measured frames are one column."""

    def __init__(self, batch: PairBatch, first: Tensor, before: int, steps: int) -> None:
        columns = torch.arange(-before, steps + 1, device=first.device)
        index = (first[:, None] + columns).clamp(min=0, max=batch.mask.shape[1] - 1)
        self.leader_position = batch.leader_position.gather(1, index)
        self.leader_speed = batch.leader_speed.gather(1, index)
        self.leader_acceleration = batch.leader_acceleration.gather(1, index)
        measured = index[:, : before + 1]
        self.speed = batch.follower_speed.gather(1, measured)
        self.acceleration = batch.follower_acceleration.gather(1, measured)
        self.gap = batch.gap.gather(1, measured)
