"""Training data of the closed loop: drivers assigned to networks, with bases and inputs.

Shapes: P pairs of the training data, U recorded pairs among them, N networks (each member of an
ensemble counts), E ensembles, B drivers of the network that has most, D trajectories of each
network, W windows of the longest pair, f features of a token, n tuned parameters, k driver
features, c = n + k features of conditioning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cfx.core import memory
from cfx.core.parameters import squashed
from cfx.data.pairs import PairBatch
from cfx.data.signals import RECORDED
from cfx.learners.base import TrainingData
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.rollout.simulated import QUEUES, SITES
from cfx.policies.base import Policy
from cfx.policies.core import Grid
from cfx.policies.driver_features import measure
from cfx.policies.features import Scaler, tokens
from cfx.policies.heads.base import ParameterHead
from cfx.policies.history import measured_history
from cfx.policies.inputs import policy_inputs

_FEW_DRIVERS = 5
"""A network with fewer drivers keeps the end of each trajectory for validation, not drivers."""

_PAIRS_AT_ONCE = 4096
"""Pairs whose frames are read at once, in double precision: some 200 MB of 600 frames each."""

_MOVING_MPS = 3.0
_STANDSTILL_M = 2.0
_TIME_GAPS_S = (0.8, 2.5)
"""Above which speed a driver moves, which gap remains at standstill, and which time gaps are usual
on motorways."""


class RolloutBatch(NamedTuple):
    """Trajectories to simulate, D for each of N networks.

    Attributes:
        place: which of the network's drivers, `(N, D)`.
        start: window at whose beginning the policy takes over, `(N, D)`.
        cold_start: whether nothing was observed before and the pooled parameters are the base, as
            for an unseen driver; bool `(N, D)`.
        last: the last frame that counts, `(N, D)`.
        weight: `(N, D)`; 0 leaves a trajectory out.
        scale: factor on all distances, speeds and accelerations, `(N, D)`; None: 1. It makes a
            recording of another driver on another road.
        shift: m/s added to the speeds of both vehicles, `(N, D)`; None: nothing. It makes a
            recording of a faster road.
        wider: m by which the gap is wider for that, `(N, D)`; given where `shift` is.
    """

    place: Tensor
    start: Tensor
    cold_start: Tensor
    last: Tensor
    weight: Tensor
    scale: Tensor | None = None
    shift: Tensor | None = None
    wider: Tensor | None = None

    @property
    def row(self) -> Tensor:
        """The network of each trajectory, `(N, 1)`: the first index of tables `(N, B, ...)`."""
        return torch.arange(len(self.place), device=self.place.device)[:, None]

    def each(self, change: Callable[[Tensor], Tensor]) -> RolloutBatch:
        """Returns the trajectories with each table `(N, D)` changed alike."""
        changed = {}
        for name, table in self._asdict().items():
            if table is not None:
                changed[name] = change(table)
        return self._replace(**changed)

    def repeated(self, times: int) -> RolloutBatch:
        """Returns all trajectories so many times, each time behind the one before."""

        def of_all(values: Tensor) -> Tensor:
            return values.repeat(1, times)

        return self.each(of_all)

    def without_unweighted(self) -> RolloutBatch:
        """Returns the trajectories that have weight, in order.

        A network that has fewer of them than another is filled up with trajectories without weight.
        """
        has_weight = self.weight > 0
        most = int(has_weight.sum(1).max())
        order = has_weight.long().argsort(dim=1, descending=True, stable=True)
        weighted = order[:, :most].sort(1).values

        def of_kept(values: Tensor) -> Tensor:
            return values.gather(1, weighted)

        return self.each(of_kept)


class Conditioning(NamedTuple):
    """Context of the drivers of N by D trajectories: pairs, bases and features.

    Attributes:
        pair: which pair each is of, `(N, D)`.
        base: that answers are offsets from, in unit space, `(N, D, n)`.
        features: what networks read of it in every window: the base in the squashed space, and
            driver features, `(N, D, c)`, not normalised.
    """

    pair: Tensor
    base: Tensor
    features: Tensor


class NetworkShard(NamedTuple):
    """Some of all networks of a training.

    Attributes:
        networks: which these are.
        total: how many there are in all.
    """

    networks: slice
    total: int


@dataclass
class Recordings:
    """Recordings of U pairs, each stored once for all networks that learn from it.

    Attributes:
        batch: the pairs.
        pair: which of the P pairs each is, `(U,)`.
        tokens: measured, `(U, W, f)`.
        driver_features: from each driver's whole training part, `(U, k)`; NaN where too little was
            measured.
        time_gap: each driver's usual one, `(U,)`, s.
    """

    batch: PairBatch
    pair: Tensor
    tokens: Tensor
    driver_features: Tensor
    time_gap: Tensor

    def __getitem__(self, rows: Tensor) -> Recordings:
        """Returns some of the pairs."""
        return Recordings(
            self.batch[rows],
            self.pair[rows],
            self.tokens[rows],
            self.driver_features[rows],
            self.time_gap[rows],
        )


@dataclass
class RolloutDataset:
    """The training data, placed as N networks by B drivers, in single precision.

    Attributes:
        recordings: of the U pairs.
        pair: which of the U pairs stands at each place, `(N, B)`.
        known_as: whose driver features a place's driver has, `(N, B)`: of the U pairs, the driver's
            own, or a recorded driver's whom a simulated one stands for.
        in_queue: which drivers leave a simulated queue, bool `(N, B)`; nothing makes a motorway of
            their street.
        trains, validates: what a place is used for, bool `(N, B)`.
        until: last frame that training may use, `(N, B)`.
        last: last frame of the training part, `(N, B)`.
        base: each driver's base in unit space, `(N, B, n)`.
        pooled: the base of drivers without one of their own, in unit space, `(N, n)`.
        chance: how likely each place is sampled, in relation to the others of its network, `(N,
            B)`; None: all places alike.
        scaler: normalises tokens and conditioning, f + c features; alike for all members of an
            ensemble.
        ensemble_size: networks of an ensemble, which stand behind one another.
        shard: which of all networks of the training these are; None: all.
    """

    recordings: Recordings
    pair: Tensor
    known_as: Tensor
    in_queue: Tensor
    trains: Tensor
    validates: Tensor
    until: Tensor
    last: Tensor
    base: Tensor
    pooled: Tensor
    scaler: Scaler
    chance: Tensor | None = None
    ensemble_size: int = 1
    shard: NetworkShard | None = None

    @classmethod
    def of(
        cls,
        training_data: TrainingData,
        policy: Policy,
        head: ParameterHead,
        settings: RolloutSettings,
        generator: torch.Generator,
    ) -> RolloutDataset:
        """Places training data.

        Args:
            training_data: what may be learned from.
            policy: says what networks read.
            head: says which parameters bases have.
            settings: how many networks an ensemble has, which drivers are kept for validation, and
                how evenly drivers are sampled.
            generator: chooses the drivers for validation, for each member of an ensemble anew.
        """
        ensemble_size = settings.ensemble_size
        recorded, row = _recorded_once(training_data)
        batch = _single_precision(training_data.recorded, training_data.pairs.index[recorded])
        device = batch.lengths.device
        space, start = head.space, head.completed(training_data.pairs.start)
        grid = Grid(training_data.pairs.network.to(device), len(training_data.names))
        pairs = torch.arange(len(row), device=device)
        pair = grid.scatter(pairs).repeat_interleave(ensemble_size, 0)
        present = grid.scatter(torch.ones_like(pairs)).bool().repeat_interleave(ensemble_size, 0)
        pooled = grid.mean(space.to_unit(start)).float()
        last = training_data.pairs.split.frame.to(device)[pair]
        validation = settings.validation
        held_out, has_few_drivers = _validation_drivers(
            training_data, pair.cpu(), present.cpu(), validation, generator
        )
        held_out, has_few_drivers = held_out.to(device), has_few_drivers.to(device)[:, None]
        trains = present & (has_few_drivers | ~held_out)
        until = torch.where(has_few_drivers, (last * (1.0 - validation)).long(), last)
        bases = start
        if training_data.pairs.base is not None:
            bases = head.completed(training_data.pairs.base)
        base = space.to_unit(bases).float()
        frame = training_data.pairs.split.frame.to(device)[recorded]
        measured = _measured_tokens(training_data, policy, batch, frame)
        driver_features = _driver_features(training_data, policy, batch, frame)
        time_gap = usual_time_gaps(batch, frame, torch.arange(len(batch), device=device))
        of_driver = row[pair]
        # Whatever a member of the ensemble trains on counts, so that all members share one scaler.
        trained_by_any = trains.view(-1, ensemble_size, trains.shape[1]).any(1)
        first = slice(None, None, ensemble_size)
        windows = torch.arange(measured.shape[1], device=device) * training_data.windows.stride
        counted = trained_by_any[..., None] & (windows <= until[first, :, None])
        placed = base[pair]
        in_queue = present & _at_sites(training_data, (QUEUES,))[pair]
        known_as = _known_as(training_data, pair, present, row, driver_features, time_gap, in_queue)
        scaler = _scaler(
            measured, placed[first], driver_features, of_driver[first], known_as[first], counted
        )
        return cls(
            recordings=Recordings(batch, recorded, measured, driver_features, time_gap),
            pair=of_driver,
            known_as=known_as,
            in_queue=in_queue,
            trains=trains,
            validates=present & (has_few_drivers | held_out) & (validation > 0),
            until=until,
            last=last,
            base=placed,
            pooled=pooled.repeat_interleave(ensemble_size, 0),
            chance=_chance(training_data, pair, present, settings.balance),
            scaler=Scaler(
                scaler.mean.repeat_interleave(ensemble_size, 0),
                scaler.scale.repeat_interleave(ensemble_size, 0),
            ),
            ensemble_size=ensemble_size,
        )

    def only(self, networks: slice) -> RolloutDataset:
        """Returns some of all networks.

        What is sampled for a network does not depend on which others stand beside it.
        """
        both = torch.stack([self.pair[networks], self.known_as[networks]])
        rows, (pair, known_as) = torch.unique(both, return_inverse=True)
        recordings = self.recordings
        if len(rows) < len(recordings.pair):
            recordings = recordings[rows]
        chance = self.chance
        if chance is not None:
            chance = chance[networks]
        return replace(
            self,
            recordings=recordings,
            pair=pair,
            known_as=known_as,
            in_queue=self.in_queue[networks],
            trains=self.trains[networks],
            validates=self.validates[networks],
            until=self.until[networks],
            last=self.last[networks],
            base=self.base[networks],
            pooled=self.pooled[networks],
            chance=chance,
            scaler=Scaler(self.scaler.mean[networks], self.scaler.scale[networks]),
            shard=NetworkShard(networks, len(self.pair)),
        )

    def uniform(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Returns uniform random numbers from 0 to 1 for these networks, `(N, *shape)`.

        Args:
            shape: of each network's.
            generator: on the CPU; it goes on as if they were for all networks.
        """
        return self._drawn(torch.rand, shape, generator)

    def normal(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """As `uniform`, from the standard normal distribution."""
        return self._drawn(torch.randn, shape, generator)

    def _drawn(
        self, draw: Callable[..., Tensor], shape: tuple[int, ...], generator: torch.Generator
    ) -> Tensor:
        networks, total = self.shard or NetworkShard(slice(None), len(self.pair))
        # Drawn for all networks of the training, so that a network's numbers do not depend on which
        # others stand beside it.
        return draw((total, *shape), generator=generator)[networks].to(self.pair.device)

    def for_base(self, base: Tensor) -> RolloutDataset:
        """Returns the same drivers with one base of another model, `(n,)` in its unit space."""
        networks, drivers = self.pair.shape
        token_end = self.recordings.tokens.shape[-1]
        base_end = token_end + self.base.shape[-1]
        mean, scale = self.scaler.mean, self.scaler.scale
        center = squashed(base).expand(networks, -1)
        scaler = Scaler(
            torch.cat([mean[:, :token_end], center, mean[:, base_end:]], -1),
            torch.cat([scale[:, :token_end], torch.ones_like(center), scale[:, base_end:]], -1),
        )
        return replace(
            self,
            base=base.expand(networks, drivers, -1),
            pooled=base.expand(networks, -1),
            scaler=scaler,
        )

    def training_places(self, most: int | None, generator: torch.Generator) -> Tensor:
        """Returns the drivers of one gradient step, as many of each network, `(N, D)`.

        All drivers in order, unless there are more than `most`: then as many of those that are
        trained on. Drivers kept for validation are among them where all are taken; their
        trajectories have no weight. With `chance` drivers are drawn, each as often as it falls to
        them.
        """
        networks, drivers = self.pair.shape
        if self.chance is not None:
            count = drivers
            if most is not None:
                count = min(most, drivers)
            return self._draw(torch.where(self.trains, self.chance, 0.0), count, generator)
        if most is None or drivers <= most:
            return torch.arange(drivers, device=self.pair.device).expand(networks, drivers)
        return self._sample(self.trains, most, generator)

    def validation_places(self, most: int | None, generator: torch.Generator) -> Tensor:
        """Returns the drivers kept for validation, at most `most` of each network, `(N, D)`.

        D may be 0. A network that keeps fewer drivers than another is filled up with others;
        `validates` tells them apart.
        """
        count = int(self.validates.sum(1).max())
        if most is not None:
            count = min(most, count)
        return self._sample(self.validates, count, generator)

    def _sample(self, preferred: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Samples `count` places of each network without replacement, `(N, count)`, in order.

        Preferred ones, bool `(N, B)`, are taken first; others follow where they are too few.
        """
        # The greatest of uniform numbers are a sample; -1 stands behind all of them.
        draws = self.uniform(tuple(preferred.shape[1:]), generator)
        return torch.where(preferred, draws, -1.0).topk(count, dim=1).indices.sort(1).values

    def _draw(self, chance: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Draws `count` places of each network with replacement, `(N, count)`, in order."""
        # The inverse of the cumulative distribution at uniform numbers.
        upto = chance.cumsum(1)
        draws = self.uniform((count,), generator) * upto[:, -1:]
        places = torch.searchsorted(upto, draws, right=True)
        # Rounding of the sum may put a number behind the last place that has a chance.
        last = (chance > 0).long().cumsum(1).argmax(1, keepdim=True)
        return places.minimum(last).sort(1).values

    def observed_windows(
        self, batch: RolloutBatch, pair: Tensor, most: int | None
    ) -> tuple[Tensor, Tensor]:
        """Returns what was measured in windows before trajectories; nothing before a cold start.

        Args:
            batch: the trajectories.
            pair: which pair each is of, `(N, D)`.
            most: windows at most, the last ones before the start; None: all.

        Returns:
            Tokens `(B, N, D, f)`, and whether a trajectory has the window, bool `(B, N, D)`.
        """
        start = torch.where(batch.cold_start, 0, batch.start)
        count = int(start.max())
        if most is not None:
            count = min(count, most)
        windows = start - count + torch.arange(count, device=start.device)[:, None, None]
        return self.recordings.tokens[pair, windows.clamp(min=0)], windows >= 0

    def condition(self, batch: RolloutBatch) -> Conditioning:
        """Returns what is known of the drivers of these trajectories.

        The training drivers' mean stands for driver features that are unknown, and for those of
        cold starts.
        """
        pair, cold_start = self.pair.gather(1, batch.place), batch.cold_start[..., None]
        base = torch.where(cold_start, self.pooled[:, None], self.base[batch.row, batch.place])
        features = squashed(base)
        count = self.recordings.driver_features.shape[-1]
        if count > 0:
            known_as = self.known_as.gather(1, batch.place)
            measured = self.recordings.driver_features[known_as]
            usual = self.scaler.mean[:, None, -count:]
            read = torch.where(cold_start | measured.isnan(), usual, measured)
            features = torch.cat([features, read], -1)
        return Conditioning(pair, base, features)


def chances(sites: Sequence[str], drivers: Sequence[str], frames: Tensor, balance: float) -> Tensor:
    """Returns how likely each of P pairs is sampled, `(P,)`; they add up to 1.

    A driver's chance is shared among their pairs by frames to the power of `balance`; a site's
    among its drivers, and everything among sites, by the sums below to the power of 1 - `balance`.
    Powers of shares even out sources of different size, as in multilingual training (A. Conneau et
    al. 2020, Unsupervised cross-lingual representation learning at scale, ACL, section 3.1).

    Args:
        sites: of each pair.
        drivers: of each pair; a driver at two sites counts at each.
        frames: of each pair, `(P,)`.
        balance: from 0 (every pair alike) to 1.
    """
    site_of_pair = np.unique(np.asarray(sites), return_inverse=True)[1]
    name_of_pair = np.unique(np.asarray(drivers), return_inverse=True)[1]
    # A number for each driver at each site, and a pair of each of them.
    _, first_pair, driver_of_pair = np.unique(
        site_of_pair * len(name_of_pair) + name_of_pair, return_index=True, return_inverse=True
    )
    site_of_driver = site_of_pair[first_pair]
    pair_weight = frames.double().numpy() ** balance
    driver_total = np.bincount(driver_of_pair, pair_weight)
    driver_weight = driver_total ** (1.0 - balance)
    site_total = np.bincount(site_of_driver, driver_weight)
    site_weight = site_total ** (1.0 - balance)
    # P(site) P(driver | site) P(pair | driver)
    of_site = (site_weight / site_weight.sum())[site_of_pair]
    of_driver = (driver_weight / site_total[site_of_driver])[driver_of_pair]
    return torch.as_tensor(of_site * of_driver * pair_weight / driver_total[driver_of_pair])


def _chance(
    training_data: TrainingData, pair: Tensor, present: Tensor, balance: float
) -> Tensor | None:
    """Returns how likely each place is sampled, `(N, B)`; None where all are alike."""
    if balance == 0:
        return None
    drivers = training_data.pairs.known_drivers
    sites = training_data.pairs.sites or ("",) * len(drivers)
    frames = training_data.pairs.split.frame.cpu()
    chance = torch.zeros(pair.shape, dtype=torch.float64)
    for network, row in enumerate(pair.cpu()):
        places = present[network].cpu()
        pairs = row[places].tolist()
        sites_of_network, drivers_of_network = [], []
        for number in pairs:
            sites_of_network.append(sites[number])
            drivers_of_network.append(drivers[number])
        chance[network, places] = chances(
            sites_of_network, drivers_of_network, frames[pairs], balance
        )
    return chance.to(pair.device)


def _recorded_once(training_data: TrainingData) -> tuple[Tensor, Tensor]:
    """Finds pairs that stand for all that are equal to them.

    Equal are the same recorded pairs with the same training part, as of one driver that several
    networks learn from.

    Returns:
        Which of the P pairs these are, `(U,)`, and which one of these stands for each, `(P,)`.
    """
    frame = training_data.pairs.split.frame.to(training_data.device)
    recording_and_end = torch.stack([training_data.pairs.index.to(frame), frame], 1)
    _, equals = torch.unique(recording_and_end, dim=0, return_inverse=True)
    number = torch.arange(len(equals), device=equals.device)
    # The first of those that are equal stands for all of them.
    first = torch.full_like(number, len(equals)).scatter_reduce(0, equals, number, "amin")
    recorded, row = torch.unique(first[equals], return_inverse=True)
    return recorded, row


def time_gaps(training_data: TrainingData) -> Tensor:
    """Returns each driver's usual time gap in the training part, `(P,)`, s."""
    recorded, row = _recorded_once(training_data)
    last = training_data.pairs.split.frame.to(training_data.device)[recorded]
    return usual_time_gaps(training_data.recorded, last, training_data.pairs.index[recorded])[row]


def usual_time_gaps(batch: PairBatch, last: Tensor, pair: Tensor) -> Tensor:
    """Returns drivers' median time gaps while they move, `(U,)`, s.

    Args:
        batch: P pairs.
        last: the last frame that may be used, `(U,)`.
        pair: which of the P pairs these are, `(U,)`.
    """
    frames = torch.arange(batch.mask.shape[1], device=last.device)
    medians = []
    for shard in _shards_of_pairs(len(pair)):
        pairs = batch[pair[shard]]
        moves = (frames <= last[shard, None]) & (pairs.follower_speed > _MOVING_MPS)
        time_gap = (pairs.gap - _STANDSTILL_M) / pairs.follower_speed.clamp(min=_MOVING_MPS)
        medians.append(torch.where(moves, time_gap, torch.nan).nanmedian(1).values)
    return torch.cat(medians).nan_to_num(_TIME_GAPS_S[0]).clamp(*_TIME_GAPS_S)


def _validation_drivers(
    training_data: TrainingData,
    pair: Tensor,
    present: Tensor,
    validation: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Chooses validation drivers for each network; all pairs of a driver stay together.

    Returns:
        Whether a place's driver is kept, bool `(N, B)`, and which networks have too few drivers to
        keep any, bool `(N,)`.
    """
    drivers = training_data.pairs.known_drivers
    held_out, has_few_drivers = torch.zeros_like(present), torch.zeros(len(pair), dtype=torch.bool)
    for network in range(len(pair)):
        places = present[network].nonzero()[:, 0].tolist()
        driver_at = {place: drivers[int(pair[network, place])] for place in places}
        names = sorted(set(driver_at.values()))
        has_few_drivers[network] = len(names) < _FEW_DRIVERS
        if has_few_drivers[network] or validation == 0:
            continue
        count = max(1, round(validation * len(names)))
        order = torch.randperm(len(names), generator=generator)[:count]
        chosen = {names[index] for index in order.tolist()}
        for place, driver in driver_at.items():
            held_out[network, place] = driver in chosen
    return held_out, has_few_drivers


def _single_precision(batch: PairBatch, pair: Tensor) -> PairBatch:
    """Returns pairs `(U,)` in single precision, which resolves positions on them to 0.1 mm."""
    together = len(RECORDED) + len(batch.surroundings)

    def rows_of(signal: Tensor) -> Tensor:
        shape = (len(pair), signal.shape[1])
        values = torch.as_tensor(memory.empty(shape, np.float32, together=together))
        values = values.to(signal.device)
        for shard in _shards_of_pairs(len(pair)):
            values[shard] = signal[pair[shard]].float()
            memory.release()
        return values

    return PairBatch(
        **{name: rows_of(getattr(batch, name)) for name in RECORDED},
        leader_length=batch.leader_length[pair].float(),
        lengths=batch.lengths[pair],
        mask=batch.mask[pair],
        dt=batch.dt,
        surroundings={signal: rows_of(values) for signal, values in batch.surroundings.items()},
    )


def _shards_of_pairs(pairs: int) -> Iterator[slice]:
    """Yields the rows of pairs that are read together, so that their windows fit into memory."""
    for first in range(0, pairs, _PAIRS_AT_ONCE):
        yield slice(first, min(first + _PAIRS_AT_ONCE, pairs))


def _measured_tokens(
    training_data: TrainingData, policy: Policy, batch: PairBatch, last: Tensor
) -> Tensor:
    """Returns the tokens of all windows of the training parts, `(U, W, f)`."""
    device = batch.lengths.device
    end = int(last.max()) + 1
    windows = torch.arange(0, end, training_data.windows.stride, device=device)
    inputs = policy_inputs(policy.inputs)
    of_all_pairs = torch.empty(0)
    for shard in _shards_of_pairs(len(batch)):
        pairs = torch.arange(shard.start, shard.stop, device=device)[:, None]
        history = measured_history(batch, pairs, windows, training_data.windows.length)
        of_shard = tokens(history, inputs, policy.summary)
        if shard.start == 0:
            room = memory.empty((len(batch), *of_shard.shape[1:]), np.float32)
            of_all_pairs = torch.as_tensor(room).to(device)
        of_all_pairs[shard] = of_shard
        memory.release()
    return of_all_pairs


def _driver_features(
    training_data: TrainingData, policy: Policy, batch: PairBatch, until: Tensor
) -> Tensor:
    """Returns the driver features that networks read, `(U, k)`."""
    if not policy.driver_features:
        return until.new_empty((len(batch), 0), dtype=torch.float32)
    since = torch.zeros_like(until)
    dt = training_data.stepper.dt
    return measure(batch, policy.driver_features, dt, since, until).float()


def _at_sites(training_data: TrainingData, sites: Sequence[str]) -> Tensor:
    """Returns which of the P pairs are at some sites, bool `(P,)`."""
    pairs = training_data.pairs
    is_there = [site in sites for site in pairs.sites or ("",) * len(pairs)]
    return torch.tensor(is_there, device=training_data.device)


def _known_as(
    training_data: TrainingData,
    pair: Tensor,
    present: Tensor,
    row: Tensor,
    driver_features: Tensor,
    time_gap: Tensor,
    in_queue: Tensor,
) -> Tensor:
    """Chooses which of the U pairs each place's driver has the driver features of, `(N, B)`.

    A simulated driver who leaves a queue stands for a recorded one of the same network, who was
    never seen at a light: the driver whose time gap has the same rank among recorded drivers. So
    networks learn how each of the recorded drivers leaves a queue. All others have their own.

    Args:
        training_data: says at which sites drivers are.
        pair: which of the P pairs stands at each place, `(N, B)`.
        present: which places are taken, bool `(N, B)`.
        row: which of the U pairs stands for each of the P pairs.
        driver_features: `(U, k)`, NaN where unknown.
        time_gap: each driver's usual one, `(U,)`, s.
        in_queue: which drivers leave a queue, bool `(N, B)`.
    """
    known_as = row[pair]
    is_measured = driver_features.isfinite().all(1)[known_as]
    if driver_features.shape[1] == 0:
        return known_as
    is_recorded = present & is_measured & ~_at_sites(training_data, SITES)[pair]
    for network, rows in enumerate(known_as):
        queue, recorded = in_queue[network].nonzero()[:, 0], is_recorded[network].nonzero()[:, 0]
        if len(queue) == 0 or len(recorded) == 0:
            continue
        queue = queue[time_gap[rows[queue]].argsort(stable=True)]
        recorded = recorded[time_gap[rows[recorded]].argsort(stable=True)]
        rank = (torch.arange(len(queue), device=pair.device) + 0.5) / len(queue)
        known_as[network, queue] = rows[recorded[(rank * len(recorded)).long()]]
    return known_as


def _scaler(
    recorded_tokens: Tensor,
    base: Tensor,
    driver_features: Tensor,
    pair: Tensor,
    known_as: Tensor,
    counted: Tensor,
) -> Scaler:
    """Measures the scaler of each ensemble, one after the other: their windows are many.

    Args:
        recorded_tokens: tokens, `(U, W, f)`.
        base: of each place in unit space, `(E, B, n)`.
        driver_features: `(U, k)`, NaN where unknown.
        pair: which pair stands at each place, `(E, B)`.
        known_as: whose driver features each place's driver has, `(E, B)`.
        counted: windows that are trained on, bool `(E, B, W)`.
    """
    windows = recorded_tokens.shape[1]
    # A driver of whom a feature is unknown does not count in any of them.
    measured = driver_features.isnan().logical_not().all(-1)

    def tokens_and_bases(ensemble: int) -> _Values:
        for shard in _shards_of_pairs(pair.shape[1]):
            pairs = pair[ensemble, shard]
            center = squashed(base[ensemble, shard])[:, None].expand(-1, windows, -1)
            yield (
                torch.cat([recorded_tokens[pairs], center], -1)[None],
                counted[ensemble, shard][None],
            )
            memory.release()

    def features_of_drivers(ensemble: int) -> _Values:
        for shard in _shards_of_pairs(pair.shape[1]):
            pairs = known_as[ensemble, shard]
            values = driver_features[pairs].nan_to_num()[:, None].expand(-1, windows, -1)
            yield values[None], (counted[ensemble, shard] & measured[pairs][:, None])[None]

    means, scales = [], []
    for ensemble in range(len(pair)):
        first = Scaler.of_shards(partial(tokens_and_bases, ensemble))
        second = Scaler.of_shards(partial(features_of_drivers, ensemble))
        means.append(torch.cat([first.mean, second.mean], -1))
        scales.append(torch.cat([first.scale, second.scale], -1))
    return Scaler(torch.cat(means), torch.cat(scales))


_Values = Iterator[tuple[Tensor, Tensor]]
"""Features of the next drivers, and which windows count."""
