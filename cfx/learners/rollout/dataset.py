"""What is learned from when a policy learns by driving: drivers placed in networks, and drives drawn from their recordings.

Shapes: P pairs of the training data, N networks (each member of an ensemble counts), B drivers of the largest, D drives, H windows of a
drive, W windows of the longest pair, L frames that a token holds, S steps of a window, f features, n tuned parameters, k driver features,
s width of a policy's state, m of a model's memory.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.agents.heads.offset import coordinates
from cfx.agents.scaler import Scaler
from cfx.learners.base import TrainingData
from cfx.learners.batched import Grid
from cfx.learners.rollout.step import LeaderWindow, LoopState, WindowStep
from cfx.models.base import Leader
from cfx.pairs import PairBatch
from cfx.policies.base import Policy
from cfx.policies.driver_features import measure
from cfx.policies.features import measured_history, tokens
from cfx.simulation.trajectory import Start

_FEW_DRIVERS = 5
"""A network with fewer drivers holds out the end of each drive for validation, not drivers."""

_TABLE = 4_000_000
"""Vehicle steps of one part of a table of errors, which bounds its memory to some hundred MB."""


class RolloutBatch(NamedTuple):
    """Drives to simulate, D for each network.

    Attributes:
        place: which of the network's drivers, `(N, D)`.
        start: window at whose beginning the policy takes over, `(N, D)`.
        unseen driver: whether it has read nothing and begins from the population's parameters, bool `(N, D)`.
        last: the last frame that counts, `(N, D)`.
        weight: `(N, D)`; 0 leaves a drive out.
        scale: factor on all distances, speeds and accelerations of the drive, `(N, D)`; None: 1. A made-up recording of another
            driver on another road.
    """

    place: Tensor
    start: Tensor
    cold_start: Tensor
    last: Tensor
    weight: Tensor
    scale: Tensor | None = None

    @property
    def row(self) -> Tensor:
        """The network of each drive, `(N, 1)`: with `place` it says where the drive's driver stands in a table of places."""
        return torch.arange(len(self.place), device=self.place.device)[:, None]

    def weighed(self) -> RolloutBatch:
        """Returns the drives that have weight, in order; others fill up a network that has fewer of them than another."""
        has_weight = self.weight > 0
        most = int(has_weight.sum(1).max())
        kept = (
            has_weight.long().argsort(dim=1, descending=True, stable=True)[:, :most].sort(1).values
        )
        return RolloutBatch._make(
            value if value is None else value.gather(1, kept) for value in self
        )


@dataclass
class RolloutDataset:
    """The training data, placed as N networks by B drivers, in single precision.

    Attributes:
        batch: the P pairs.
        pair: which of them stands at each place, `(N, B)`.
        trains, validates: what a place is used for, bool `(N, B)`.
        until: last frame that training may use, `(N, B)`.
        last: last frame of the training part, `(N, B)`.
        base: each driver's base in unit space, `(N, B, n)`.
        start: the population's, `(N, n)`: of those who bring no base of their own.
        tokens: what was measured, `(P, W, f)`.
        driver features: of drivers, from their whole training parts, `(P, k)`; NaN where too little was measured.
        scaler: normalises tokens, the base in the squashed space, and driver features, f + n + k features; alike for all members of a
            ensemble.
        members: networks of an ensemble, which stand behind one another.
    """

    batch: PairBatch
    pair: Tensor
    trains: Tensor
    validates: Tensor
    until: Tensor
    last: Tensor
    base: Tensor
    start: Tensor
    tokens: Tensor
    driver_features: Tensor
    scaler: Scaler
    ensemble_size: int = 1

    @classmethod
    def of(
        cls,
        training_data: TrainingData,
        policy: Policy,
        share: float,
        generator: torch.Generator,
        ensemble_size: int = 1,
    ) -> RolloutDataset:
        """Places training data.

        Args:
            training data: what may be learned from.
            policy: what is read.
            share: of the drivers (of each drive's end, where drivers are few), kept for validation.
            generator: chooses them, for each member of an ensemble anew.
            members: networks of an ensemble.
        """
        batch = _single(training_data.batch)
        device = batch.lengths.device
        space, stride = training_data.simulator.model.adaptation_space, training_data.windows.stride
        grid = Grid(training_data.network.to(device), len(training_data.names))
        pairs = torch.arange(len(batch), device=device)
        population = grid.mean(space.to_unit(training_data.fixed)).float()
        placed = (grid.scatter(pairs), grid.scatter(torch.ones_like(pairs)).bool(), population)
        pair, real, start = (values.repeat_interleave(ensemble_size, 0) for values in placed)
        last = training_data.split.frame.to(device)[pair]
        held, few = _held_out(training_data, pair.cpu(), real.cpu(), share, generator)
        held, few = held.to(device), few.to(device)[:, None]
        cut = (last * (1.0 - share)).long()
        own = space.to_unit(
            training_data.fixed if training_data.base is None else training_data.base
        ).float()
        windows = torch.arange(0, int(training_data.split.frame.max()) + 1, stride, device=device)
        seen = tokens(
            measured_history(batch, pairs[:, None], windows, training_data.windows.length),
            policy.inputs,
            policy.summary,
        )
        trains = real & (few | ~held)
        until = torch.where(few, cut, last)
        driver_features = _driver_features(training_data, policy, batch)
        features = torch.cat([seen, coordinates(own)[:, None].expand(-1, len(windows), -1)], -1)[
            pair[::ensemble_size]
        ]
        seen_by_any = trains.view(-1, ensemble_size, trains.shape[1]).any(1)
        there = seen_by_any[..., None] & (windows <= until[::ensemble_size, :, None])
        known = driver_features.isnan().logical_not().all(-1)[pair[::ensemble_size]]
        told = driver_features.nan_to_num()[pair[::ensemble_size], None].expand(
            -1, -1, len(windows), -1
        )
        scalers = Scaler.of(features, there), Scaler.of(told, there & known[..., None])
        mean, scale = (
            torch.cat(values, -1)
            for values in zip(*((one.mean, one.scale) for one in scalers), strict=True)
        )
        scaler = Scaler(
            mean.repeat_interleave(ensemble_size, 0), scale.repeat_interleave(ensemble_size, 0)
        )
        return cls(
            batch=batch,
            pair=pair,
            trains=trains,
            validates=real & (few | held) & (share > 0),
            until=until,
            last=last,
            base=own[pair],
            start=start,
            tokens=seen,
            driver_features=driver_features,
            scaler=scaler,
            ensemble_size=ensemble_size,
        )

    def driven_from(self, base: Tensor) -> RolloutDataset:
        """Returns the same drivers, all driven from one base of another model, `(n,)` in its unit space."""
        (networks, drivers), tokens, driver_features = (
            self.pair.shape,
            self.tokens.shape[-1],
            self.tokens.shape[-1] + self.base.shape[-1],
        )
        told = coordinates(base).expand(networks, -1)
        mean, scale = self.scaler.mean, self.scaler.scale
        scaler = Scaler(
            torch.cat([mean[:, :tokens], told, mean[:, driver_features:]], -1),
            torch.cat([scale[:, :tokens], torch.ones_like(told), scale[:, driver_features:]], -1),
        )
        return replace(
            self,
            base=base.expand(networks, drivers, -1),
            start=base.expand(networks, -1),
            scaler=scaler,
        )

    def driving(self, most: int | None, generator: torch.Generator) -> Tensor:
        """Returns places of the drivers for whom drives are drawn in one gradient step, as many of each network, `(N, D)`.

        Everybody in order, unless that is more than `most`: then as many of those who are learned from. Drives of those who are
        kept for validation have no weight and are not simulated.
        """
        networks, drivers = self.pair.shape
        if most is None or drivers <= most:
            return torch.arange(drivers, device=self.pair.device).expand(networks, drivers)
        return _chosen(self.trains, most, generator)

    def held(self, most: int | None, generator: torch.Generator) -> Tensor:
        """Returns places of the drivers kept for validation, at most `most` of each network, `(N, D)`; D may be 0.

        Where a network keeps fewer than another, some who are not kept make up for it; `validates` tells them apart.
        """
        count = int(self.validates.sum(1).max())
        return _chosen(self.validates, count if most is None else min(most, count), generator)

    def of_drives(self, drives: RolloutBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Says whose drives these are.

        Returns:
            Which pair each is of, `(N, D)`; the base that its driver is driven from, `(N, D, n)`; and what networks are told of
            him in every window: that base in the squashed space, and his driver features, `(N, D, n + k)`.
        """
        pair, cold_start = self.pair.gather(1, drives.place), drives.cold_start[..., None]
        base = torch.where(cold_start, self.start[:, None], self.base[drives.row, drives.place])
        told = coordinates(base)
        if (k := self.driver_features.shape[-1]) > 0:
            driver_features = self.driver_features[pair]
            told = torch.cat(
                [
                    told,
                    torch.where(
                        cold_start | driver_features.isnan(),
                        self.scaler.mean[:, None, -k:],
                        driver_features,
                    ),
                ],
                -1,
            )
        return pair, base, told

    def read(self, step: WindowStep, drives: RolloutBatch, most: int | None = None) -> Tensor:
        """Lets the policy read what was measured before each drive; nothing, for an unseen driver.

        Args:
            step: reads one window.
            drives: where they begin.
            most: windows that are read at most, the last ones before the drive; None: all there are.

        Returns:
            The policy's state as each drive begins, `(N, D, s)`.
        """
        pair, _, told = self.of_drives(drives)
        start = torch.where(drives.cold_start, 0, drives.start)
        count = int(start.max()) if most is None else min(int(start.max()), most)
        windows = start - count + torch.arange(count, device=start.device)[:, None, None]
        seen = self.tokens[pair, windows.clamp(min=0)]
        state = step.network.initial_state(*pair.shape)
        if state.is_floating_point() and torch.is_grad_enabled():
            state = (
                state.detach().requires_grad_()
            )  # as all later ones, so that one compiled function serves all
        for k in range(count):
            state = step.read(seen[k], told, state, windows[k] >= 0)
        return state


class Measured(NamedTuple):
    """What was measured at simulated frames; `(N, D, frames)` each.

    Attributes:
        speed: m/s.
        gap: m.
        counted: 1 for a frame within the training part, else 0.
    """

    speed: Tensor
    gap: Tensor
    counted: Tensor


@dataclass(frozen=True)
class RolloutInputs:
    """What is measured around drives; H windows, time in frames from `1 - L` to `H S`.

    Attributes:
        leader: position, speed, acceleration, window by window, `(3, H, N, D, L + S)`.
        leader_length: `(N, D)`.
        follower: position, speed, acceleration of the last L frames before the policy takes over, `(3, N, D, L)`.
        memory: of the model at that moment, `(N, D, m)`.
        measured: at the `H S` frames that are simulated.
    """

    leader: Tensor
    leader_length: Tensor
    follower: Tensor
    memory: Tensor
    measured: Measured

    @classmethod
    def of(
        cls, batch: PairBatch, pair: Tensor, drives: RolloutBatch, step: WindowStep, windows: int
    ) -> RolloutInputs:
        length, stride = step.length, step.stride
        now, end = (drives.start * stride)[..., None], batch.mask.shape[1] - 1
        device = pair.device

        def at(signal: Tensor, frames: Tensor) -> Tensor:
            return signal[pair[..., None], frames.clamp(min=0, max=end)]

        origin = at(batch.follower_position, now)
        past = now + torch.arange(1 - length, 1, device=device)
        follower = torch.stack(
            [
                at(batch.follower_position, past) - origin,
                at(batch.follower_speed, past),
                at(batch.follower_acceleration, past),
            ]
        )
        offsets = torch.arange(windows, device=device)[:, None] * stride + torch.arange(
            1 - length, stride + 1, device=device
        )
        around = now + offsets[:, None, None]
        leader = torch.stack(
            [
                at(batch.leader_position, around) - origin,
                at(batch.leader_speed, around),
                at(batch.leader_acceleration, around),
            ]
        )
        simulated = now + torch.arange(1, windows * stride + 1, device=device)
        length_of = batch.leader_length[pair]
        real_speed, real_gap = at(batch.follower_speed, simulated), at(batch.gap, simulated)
        if drives.scale is not None:
            scale = drives.scale[..., None]
            follower, real_speed, real_gap = follower * scale, real_speed * scale, real_gap * scale
            rear = torch.stack([length_of[..., None], *[torch.zeros_like(scale)] * 2])[:, None]
            leader = (leader - rear) * scale + rear  # the gap is scaled, the vehicle is not
        return cls(
            leader=leader,
            leader_length=length_of,
            follower=follower,
            memory=step.model.initial_memory(follower[1, ..., -1]),
            measured=Measured(
                real_speed,
                real_gap,
                (simulated <= drives.last[..., None]).to(follower.dtype),
            ),
        )

    def recent(self, state: Tensor) -> LoopState:
        """Returns where the drives begin."""
        position, speed, acceleration = self.follower.unbind(0)
        begin = LoopState(position, speed, acceleration, self.memory, state)
        if not torch.is_grad_enabled():
            return begin
        # Gradients flow through all later states; if they did not through the first, it would be compiled for once more.
        return LoopState(
            *(value if value.requires_grad else value.clone().requires_grad_() for value in begin)
        )

    def real(self, frames: slice) -> Measured:
        """Returns what was measured at some of the simulated frames."""
        return Measured(*(signal[..., frames] for signal in self.measured))

    def ahead(self, window: int) -> LeaderWindow:
        """Returns the leader around a window."""
        return LeaderWindow(*self.leader[:, window].unbind(0))


@dataclass(frozen=True)
class BaseErrors:
    """RMSE of speed and of gap of constant parameters, which a drive's errors are divided by.

    Attributes:
        familiar, strange: of each driver's base and of the population's set over the horizon from each window on,
            `(N, B, W, 2)`.
        whole: of the population's set over the whole training part, `(N, B, 2)`.
    """

    familiar: Tensor
    strange: Tensor
    whole: Tensor

    @classmethod
    def of(cls, training_data: TrainingData, dataset: RolloutDataset, horizon: int) -> BaseErrors:
        """Simulates them; `horizon` in windows."""
        stride, (networks, drivers) = training_data.windows.stride, dataset.pair.shape
        windows = torch.arange(dataset.tokens.shape[1], device=dataset.pair.device) * stride
        near, far = (
            _Constant(training_data, dataset.batch, steps)
            for steps in (horizon * stride, int(dataset.last.max()))
        )
        first = slice(None, None, dataset.ensemble_size)  # what drives is the same for all members
        pairs, own = dataset.pair[first].flatten(), dataset.base[first].flatten(0, 1)
        start = dataset.start[first].repeat_interleave(drivers, 0)

        def placed(errors: Tensor) -> Tensor:
            return errors.view(networks // dataset.ensemble_size, drivers, -1, 2).repeat_interleave(
                dataset.ensemble_size, 0
            )

        familiar = placed(near.errors(pairs, own, windows))
        strange = (
            familiar if training_data.base is None else placed(near.errors(pairs, start, windows))
        )
        return cls(familiar, strange, placed(far.errors(pairs, start, windows[:1]))[:, :, 0])

    def over_whole(self, drives: RolloutBatch) -> Tensor:
        """Returns the errors of the population's set over each drive from the first frame to the last, `(N, D, 2)`."""
        return _scaled(self.whole[drives.row, drives.place], drives)

    def over_horizon(self, drives: RolloutBatch) -> Tensor:
        """Returns the errors over the horizon from where each drive begins, `(N, D, 2)`."""
        places = (drives.row, drives.place, drives.start)
        errors = torch.where(
            drives.cold_start[..., None], self.strange[places], self.familiar[places]
        )
        return _scaled(errors, drives)


def _scaled(errors: Tensor, drives: RolloutBatch) -> Tensor:
    return errors if drives.scale is None else errors * drives.scale[..., None]


class _Constant:
    """Drives with constant parameters from many frames on."""

    def __init__(self, training_data: TrainingData, batch: PairBatch, steps: int) -> None:
        self.simulator = training_data.simulator
        self.batch = batch
        self.steps = steps
        self.last = training_data.split.frame.to(batch.lengths.device)

    @torch.no_grad()
    def errors(self, pair: Tensor, unit: Tensor, windows: Tensor) -> Tensor:
        """Returns RMSE of speed and gap over the horizon, `(B, W, 2)`.

        Args:
            pair: `(B,)`.
            unit: parameters in unit space, `(B, n)`.
            windows: frames at which drives begin, `(W,)`.
        """
        size = max(1, _TABLE // (len(windows) * self.steps))
        parts = zip(torch.split(pair, size), torch.split(unit, size), strict=True)
        return torch.cat([self._part(one, values, windows) for one, values in parts])

    def _part(self, pair: Tensor, unit: Tensor, windows: Tensor) -> Tensor:
        batch, end = self.batch, self.batch.mask.shape[1] - 1
        shape = (len(pair), len(windows))
        frames = (windows + torch.arange(self.steps + 1, device=pair.device)[:, None])[:, None]
        index = frames.clamp(max=end).expand(-1, *shape)
        rows = pair[:, None].expand(shape)
        first = windows.clamp(max=end).expand(shape)
        position, speed, acceleration = (
            signal[rows, index]
            for signal in (batch.leader_position, batch.leader_speed, batch.leader_acceleration)
        )
        length = batch.leader_length[rows]
        start = Start(
            *(
                s[rows, first]
                for s in (
                    batch.follower_position,
                    batch.follower_speed,
                    batch.follower_acceleration,
                )
            )
        )
        space = self.simulator.model.adaptation_space
        p = {
            k: v[:, None] if v.dim() else v for k, v in space.unpack(space.from_unit(unit)).items()
        }
        leader = Leader(position[:-1], speed[:-1], acceleration[:-1], length)
        _, simulated, driven = self.simulator.advance(self.simulator.begin(start), leader, p)
        counted = (frames[1:] <= self.last[pair][:, None]).to(driven.dtype)
        gap = position[1:] - length - simulated
        errors = [driven - batch.follower_speed[rows, index[1:]], gap - batch.gap[rows, index[1:]]]
        total = counted.sum(0).clamp(min=1.0)
        return torch.stack([((e.square() * counted).sum(0) / total).sqrt() for e in errors], -1)


def _single(batch: PairBatch) -> PairBatch:
    """Returns the batch in single precision, which resolves positions on it to 0.1 mm."""
    names = [f.name for f in fields(batch) if f.name not in {"lengths", "mask", "dt"}]
    changed: dict[str, Any] = {name: getattr(batch, name).float() for name in names}
    return replace(batch, **changed)


def _driver_features(training_data: TrainingData, policy: Policy, batch: PairBatch) -> Tensor:
    """Returns what networks are told of the drivers, `(P, k)`."""
    until = training_data.split.frame.to(batch.lengths.device)
    if not policy.driver_features:
        return until.new_empty((len(batch), 0), dtype=torch.float32)
    return measure(
        batch, policy.driver_features, training_data.simulator.dt, torch.zeros_like(until), until
    ).float()


def _chosen(wanted: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Returns places of `count` drivers of each network by lot, `(N, count)`: those `wanted`, `(N, B)`, and others if too few."""
    lots = torch.rand(wanted.shape, generator=generator).to(wanted.device)
    return torch.where(wanted, lots, -1.0).topk(count, dim=1).indices.sort(1).values


def _held_out(
    training_data: TrainingData,
    pair: Tensor,
    real: Tensor,
    share: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Chooses validation drivers for each network.

    Returns:
        Whether a place's driver is held out, `(N, B)`; and which networks have too few drivers for that, `(N,)`.
    """
    drivers = training_data.drivers or tuple(
        str(number) for number in range(len(training_data.batch))
    )
    held, few = torch.zeros_like(real), torch.zeros(len(pair), dtype=torch.bool)
    for number, (places, there) in enumerate(zip(pair.tolist(), real.tolist(), strict=True)):
        who = [drivers[place] if here else None for place, here in zip(places, there, strict=True)]
        known = sorted({driver for driver in who if driver is not None})
        few[number] = len(known) < _FEW_DRIVERS
        if few[number] or share == 0:
            continue
        order = torch.randperm(len(known), generator=generator)[: max(1, round(share * len(known)))]
        chosen = {known[index] for index in order.tolist()}
        held[number] = torch.tensor([driver in chosen for driver in who])
    return held, few
