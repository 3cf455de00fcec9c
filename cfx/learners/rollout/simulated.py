"""Simulated drivers, from whom networks learn beside the recorded ones.

A policy is wrong where it has learned nothing. Hardly any recording of free traffic has vehicles
that crawl: drivers of Krauss's model and of IDM, who differ from one another, follow leaders in
stop-and-go traffic (`cfx.simulation.synthetic`). No open recording has a light: drivers of IDM
leave queues (`cfx.simulation.queues`). Either are a site of their own, so `learner.balance` says
how often they are sampled, and no constant parameters are calibrated on them: the base of each is
the pooled set of the network.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cfx.data.accelerations import averaged
from cfx.data.pairs import PairBatch, PairSet
from cfx.learners.base import TrainingData, TrainingPairs
from cfx.simulation.queues import queue_pairs
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.windows import Split

STOP_AND_GO, QUEUES = "simulated", "simulated queues"
"""Their sites."""

SITES = (STOP_AND_GO, QUEUES)
"""Sites where nobody was recorded."""

_MODELS = ("krauss", "idm")
"""Whose drivers they are, by halves."""

_CRUISE_MPS = (2.0, 6.0)
"""m/s: between which leaders cruise; recordings of free traffic hardly have such speeds."""

_HETEROGENEITY, _VARIATION = 0.5, 0.2
"""How much drivers differ from one another, and drift in time (`SyntheticSettings`)."""

_LASTS_S = 60.0
"""s: how long each driver is simulated."""


def with_simulated_drivers(
    training_data: TrainingData, stop_and_go: int, queues: int
) -> TrainingData:
    """Adds drivers to what each of N networks learns from.

    Args:
        training_data: P recorded pairs.
        stop_and_go: drivers in stop-and-go traffic; half of them drive by each model.
        queues: drivers who leave queues.

    Returns:
        P + N (stop_and_go + queues) pairs, one network behind the other.
    """
    frames, dt = training_data.recorded.mask.shape[1], training_data.stepper.dt
    seed = training_data.seed
    if stop_and_go > 0:
        drivers = stop_and_go_drivers(stop_and_go, dt, frames, seed)
        training_data = _with_drivers(training_data, drivers, STOP_AND_GO)
    if queues > 0:
        drivers = queue_drivers(queues, dt, frames, seed)
        training_data = _with_drivers(training_data, drivers, QUEUES)
    return training_data


def _with_drivers(training_data: TrainingData, drivers: PairSet, site: str) -> TrainingData:
    """Adds the same S drivers of a site to what each of N networks learns from."""
    count, frames = len(drivers), training_data.recorded.mask.shape[1]
    pairs = training_data.pairs
    batch = PairBatch.of(drivers, device=training_data.device, frames=frames)
    whole = Split.none(drivers, training_data.windows)
    networks, device = len(training_data.names), pairs.index.device
    added = torch.arange(count, device=device).repeat(networks)
    network = torch.arange(networks, device=device).repeat_interleave(count)
    # All recorded pairs of a network start from its pooled set.
    first = torch.searchsorted(pairs.network, network)
    pooled = pairs.start[first.to(pairs.start.device)]
    order = torch.cat([pairs.network, network]).argsort(stable=True)

    def joined(recorded: Tensor, simulated: Tensor) -> Tensor:
        return torch.cat([recorded, simulated.to(recorded)])[order.to(recorded.device)]

    def named(recorded: tuple[str, ...], simulated: list[str]) -> tuple[str, ...]:
        of_all = [*recorded, *simulated * networks]
        return tuple(of_all[number] for number in order.tolist())

    sites = pairs.sites or ("",) * len(pairs)
    names = [f"{site} {pair.pair_id}" for pair in drivers]
    base = pairs.base
    if base is not None:
        base = joined(base, pooled)
    return replace(
        training_data,
        recorded=training_data.recorded.followed_by(batch),
        pairs=TrainingPairs(
            index=joined(pairs.index, len(training_data.recorded) + added),
            split=Split(
                joined(pairs.split.frame, whole.frame.to(added.device)[added]),
                joined(pairs.split.windows, whole.windows.to(added.device)[added]),
            ),
            network=joined(pairs.network, network),
            start=joined(pairs.start, pooled),
            base=base,
            drivers=named(pairs.known_drivers, names),
            sites=named(sites, [site] * count),
        ),
    )


def stop_and_go_drivers(count: int, dt: float, frames: int, seed: int) -> PairSet:
    """Simulates drivers in stop-and-go traffic.

    Args:
        count: how many.
        dt: time step, s.
        frames: of each at most; fewer are simulated where a minute has fewer.
        seed: same seed, same drivers.
    """
    pairs = []
    for number, model in enumerate(_MODELS[:count]):
        dataset = SyntheticDataset(
            seed=seed + number,
            pairs=(count + len(_MODELS) - 1 - number) // len(_MODELS),
            frames=min(frames, round(_LASTS_S / dt)),
            dt=dt,
            model=model,
            cruise_mps=_CRUISE_MPS,
            heterogeneity=_HETEROGENEITY,
            variation=_VARIATION,
        )
        for pair in dataset.read():
            pairs.append(replace(pair, pair_id=f"{model} {pair.pair_id}"))
    return averaged(PairSet(tuple(pairs), STOP_AND_GO))[0]


def queue_drivers(count: int, dt: float, frames: int, seed: int) -> PairSet:
    """Simulates drivers who leave queues; arguments as of `stop_and_go_drivers`."""
    return averaged(queue_pairs(count, dt, min(frames, round(_LASTS_S / dt)), seed))[0]
