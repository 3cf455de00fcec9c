"""Some of the networks and what they learn from: trained here, in another process or elsewhere.

Networks are independent: each learns from its own loss. So a training is cut into shards of some
networks each, and what a network learns does not depend on where its shard is trained. Interrupted
training goes on from a shard's checkpoint file.

Shapes: N networks (each member of an ensemble counts), D trajectories of each.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from cfx.core.component import content_key, folder_hash
from cfx.core.local_engine import LocalEngine
from cfx.learners import base
from cfx.learners.base import TrainingData, TrainingPairs
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.learners.rollout.loss import BaseErrors
from cfx.learners.rollout.settings import RolloutSettings
from cfx.models.direct import Direct
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.heads.base import ParameterHead
from cfx.policies.heads.offset import OffsetHead
from cfx.simulation.rollout import MemoryStepper


def checkpoint_path(
    learner: dict[str, Any], policy: Policy, training_data: TrainingData
) -> Path | None:
    """Returns the file of this very training, or None without a workspace.

    Args:
        learner: identity of the learner.
        policy: what is trained.
        training_data: what it is trained on.
    """
    if training_data.workspace is None:
        return None
    description = {
        "learner": learner,
        "policy": policy.identity(),
        "model": training_data.simulator.model.identity(),
        "objective": training_data.objective.identity(),
        "windows": training_data.windows.model_dump(),
        "code": folder_hash(base.__file__),
        "trajectories": _digest(training_data),
        "names": training_data.names,
        "drivers": training_data.pairs.drivers,
        "seed": training_data.seed,
    }
    return training_data.workspace / f"{content_key(description)}.ckpt"


def _digest(training_data: TrainingData) -> str:
    """Returns the SHA-256 of all tensors that training reads."""
    batch = training_data.recorded
    tensors = [
        batch.leader_position,
        batch.leader_speed,
        batch.follower_position,
        batch.follower_speed,
        training_data.pairs.index,
        training_data.pairs.split.frame,
        training_data.pairs.fixed,
        training_data.pairs.network,
    ]
    if training_data.pairs.base is not None:
        tensors.append(training_data.pairs.base)
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


_TRAJECTORIES = 3_000
"""Of a shard's gradient step at most. A window costs as much per trajectory with 1,500 of them as
with 6,000, and a tenth more with 700."""

_WORTH_A_PROCESS = 16_000_000
"""Simulated windows of all trajectories and gradient steps from which a training is cut: some fifty
seconds on one core. A process needs five of them to begin, and threads share most of a step."""


@dataclass(frozen=True)
class TrainingShard:
    """Some networks, and all that they learn from.

    Attributes:
        settings: of the learner.
        policy: the component that built the networks.
        training_data: names and seed of these networks, and what simulates them; without pairs.
        dataset: their pairs, placed; it knows which of all networks these are.
        errors: of their bases.
        weights: of the untrained networks.
        expert_weights: of their untrained experts; None: without distillation.
        checkpoint: the file from which interrupted training goes on; None: no such file.
    """

    settings: RolloutSettings
    policy: Policy
    training_data: TrainingData
    dataset: RolloutDataset
    errors: BaseErrors
    weights: dict[str, Tensor]
    expert_weights: dict[str, Tensor] | None
    checkpoint: Path | None


@dataclass(frozen=True)
class TrainedShard:
    """The trained networks of a shard, and their learning curves.

    Attributes:
        weights: of each one's best epoch.
        curves: as `TrainingResult` has them.
        dispersion: of each one's noise, `(N,)`; None for a head without noise.
    """

    weights: dict[str, Tensor]
    curves: pd.DataFrame
    dispersion: Tensor | None = None


def networks_of_shards(settings: RolloutSettings, dataset: RolloutDataset) -> list[slice]:
    """Returns which networks train together, as slices of `range(N)`.

    It follows from the size of the training alone and not from this machine, so that the result
    does not either. Ensembles stay together.
    """
    networks, drivers = dataset.pair.shape
    if settings.drivers is not None:
        drivers = min(drivers, settings.drivers)
    trajectories = networks * drivers * settings.draws
    windows = trajectories * settings.horizon * settings.steps * settings.epochs
    ensembles = networks // dataset.ensemble_size
    count = 1
    if windows >= _WORTH_A_PROCESS and dataset.pair.device.type == "cpu":
        count = _even(ensembles, max(2, math.ceil(trajectories / _TRAJECTORIES)))
    size = math.ceil(ensembles / count) * dataset.ensemble_size
    return [slice(first, min(first + size, networks)) for first in range(0, networks, size)]


def _even(ensembles: int, count: int) -> int:
    """Returns how many shards at least `count` keep two cores busy to the end."""

    def longest(shards: int) -> int:
        size = math.ceil(ensembles / shards)
        return size * math.ceil(math.ceil(ensembles / size) / 2)

    counts = range(min(count, ensembles), min(2 * count, ensembles) + 1)
    return min(counts, key=longest)


def shard_checkpoints(checkpoint: Path | None, shards: Sequence[slice]) -> list[Path | None]:
    """Returns the file of each shard, beside that of the whole training; None: no such file."""
    if checkpoint is None or len(shards) == 1:
        return [checkpoint] * len(shards)
    return [checkpoint.with_suffix(f".{one.start}-{one.stop}.ckpt") for one in shards]


def expert_checkpoint(checkpoint: Path) -> Path:
    """Returns the file of a shard's experts."""
    return checkpoint.with_suffix(".expert.ckpt")


def cut(
    settings: RolloutSettings,
    policy: Policy,
    training_data: TrainingData,
    dataset: RolloutDataset,
    network: PolicyNetwork,
    shards: Sequence[slice],
    checkpoint: Path | None,
) -> Iterator[TrainingShard]:
    """Yields the shards of a training; a training that is not cut is one shard.

    What all shards need is computed once, before the first.

    Args:
        settings: of the learner.
        policy: the component that built the networks.
        training_data: of all networks.
        dataset: of all networks.
        network: all networks, untrained.
        shards: which networks train together (`networks_of_shards`).
        checkpoint: of the whole training.
    """
    errors = BaseErrors.of(training_data, dataset, settings.horizon)
    experts = None
    if settings.distillation_epochs:
        expert_data, expert_dataset = for_experts(training_data, dataset)
        generator = torch.Generator().manual_seed(training_data.seed)
        head = OffsetHead.for_model(expert_data.simulator.model)
        experts = untrained(policy, expert_dataset, head, generator)
    files = shard_checkpoints(checkpoint, shards)
    for networks, file in zip(shards, files, strict=True):
        is_whole = len(shards) == 1
        yield TrainingShard(
            settings=settings,
            policy=policy,
            training_data=_of_networks(training_data, dataset.ensemble_size, networks),
            dataset=dataset if is_whole else dataset.only(networks),
            errors=errors if is_whole else errors.only(networks),
            weights=_weights(network, networks),
            expert_weights=None if experts is None else _weights(experts, networks),
            checkpoint=file,
        )


def _weights(network: PolicyNetwork, networks: slice) -> dict[str, Tensor]:
    """Returns the weights of some of all networks."""
    weights = {}
    for name, value in network.state_dict().items():
        weights[name] = value[networks].clone()
    return weights


def _of_networks(training_data: TrainingData, ensemble_size: int, networks: slice) -> TrainingData:
    """Returns what is said of some networks; their pairs are left to the dataset."""
    names = slice(networks.start // ensemble_size, networks.stop // ensemble_size)
    pairs = training_data.pairs
    return replace(
        training_data,
        recorded=training_data.recorded[:0],
        pairs=TrainingPairs(
            index=pairs.index[:0],
            split=pairs.split[:0],
            network=pairs.network[:0],
            fixed=pairs.fixed[:0],
            base=None if pairs.base is None else pairs.base[:0],
        ),
        names=training_data.names[names],
        workspace=None,
        engine=LocalEngine(),
    )


def epochs(settings: RolloutSettings) -> int:
    """Returns how many epochs a shard trains at most, those of experts among them."""
    if settings.distillation_epochs:
        return settings.epochs + expert_settings(settings).epochs
    return settings.epochs


def untrained(
    policy: Policy,
    dataset: RolloutDataset,
    head: ParameterHead,
    generator: torch.Generator | None = None,
) -> PolicyNetwork:
    """Returns networks that answer no offset, on the device of the dataset.

    Args:
        policy: builds them.
        dataset: what they will read.
        head: makes parameters of their answers.
        generator: of their weights; None: weights that are replaced, always the same.
    """
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    default = head.space.to_unit(head.space.defaults()).float()
    start = head.untrained_answer(default.expand(len(dataset.pair), -1))
    features = dataset.scaler.mean.shape[-1]
    return policy.build(features, default, start, generator).to(dataset.pair.device)


def expert_settings(settings: RolloutSettings) -> RolloutSettings:
    """Returns how the experts of networks are trained."""
    changes = {
        "head": OffsetHead.name,
        "distillation_epochs": 0,
        "epochs": settings.epochs - settings.distillation_epochs,
    }
    return settings.model_copy(update=changes)


def for_experts(
    training_data: TrainingData, dataset: RolloutDataset
) -> tuple[TrainingData, RolloutDataset]:
    """Returns what experts learn from: the same trajectories, to be driven by `Direct`."""
    simulator = MemoryStepper(Direct(), training_data.simulator.dt)
    space, fixed = simulator.model.adaptation_space, training_data.pairs.fixed
    default = space.defaults(dtype=fixed.dtype, device=fixed.device)
    expert_fixed = default.expand(len(fixed), -1)
    expert_data = replace(
        training_data,
        simulator=simulator,
        pairs=replace(
            training_data.pairs,
            fixed=expert_fixed,
            base=None if training_data.pairs.base is None else expert_fixed,
        ),
    )
    return expert_data, dataset.for_base(space.to_unit(default).float())
