"""Some of the networks and what they learn from: trained here, in another process or elsewhere.

Networks are independent: each learns from its own loss. So a training is cut into shards of some
networks each, and what a network learns does not depend on where its shard is trained. Interrupted
training goes on from a shard's checkpoint file.

Shapes: N networks (each member of an ensemble counts), D trajectories of each.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
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
from cfx.learners.rollout.equilibrium import EquilibriumTargets
from cfx.learners.rollout.loss import BaseErrors
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.workspace import Workspace
from cfx.models.direct import Direct
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.heads import head_class
from cfx.policies.heads.base import ParameterHead
from cfx.policies.heads.offset import OffsetHead
from cfx.simulation.rollout import MemoryStepper


def training_key(learner: dict[str, Any], policy: Policy, training_data: TrainingData) -> str:
    """Returns what tells this very training from others, for the names of its files.

    Args:
        learner: identity of the learner.
        policy: what is trained.
        training_data: what it is trained on.
    """
    digest = hashlib.sha256()
    _add_content(digest, training_data.recorded)
    _add_content(digest, training_data.pairs)
    description = {
        "learner": learner,
        "policy": policy.identity(),
        "model": training_data.stepper.model.identity(),
        "objective": training_data.objective.identity(),
        "windows": training_data.windows.model_dump(),
        "code": folder_hash(base.__file__),
        "data": digest.hexdigest(),
        "dt": training_data.stepper.dt,
        "names": training_data.names,
        "seed": training_data.seed,
    }
    return content_key(description)


def _add_content(digest: hashlib._Hash, record: Any) -> None:
    """Adds all that a dataclass holds to a digest.

    Every field counts, so that a field which is added later changes the key too. The type and shape
    of a tensor count beside its numbers: `(2, 3)` and `(3, 2)` zeros have the same bytes.
    """
    for field in fields(record):
        digest.update(f"\n{field.name}=".encode())
        _add_value(digest, getattr(record, field.name))


def _add_value(digest: hashlib._Hash, value: Any) -> None:
    """Adds a field's value to a digest."""
    if is_dataclass(value):
        _add_content(digest, value)
    elif isinstance(value, Tensor):
        digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    elif isinstance(value, Mapping):
        for key, part in value.items():
            digest.update(f"{key!r}:".encode())
            _add_value(digest, part)
    else:
        digest.update(repr(value).encode())


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
        checkpoint: the file from which interrupted training goes on; None: no such file.
        expert: experts that drive by `Direct`, and learn from the same trajectories before; None:
            without distillation.
        equilibrium: the gaps at which drivers are to settle; None: any.
    """

    settings: RolloutSettings
    policy: Policy
    training_data: TrainingData
    dataset: RolloutDataset
    errors: BaseErrors
    weights: dict[str, Tensor]
    checkpoint: Path | None = None
    expert: TrainingShard | None = None
    equilibrium: EquilibriumTargets | None = None

    @property
    def head(self) -> ParameterHead:
        """Makes parameters of the networks' answers."""
        model, device = self.training_data.stepper.model, self.dataset.pair.device
        return head_class(self.settings.head).for_model(model, device)


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
    dispersion: Tensor | None


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


def shard_checkpoints(
    workspace: Workspace | None, training: str, shards: Sequence[slice]
) -> list[Path | None]:
    """Returns the file of each shard from which its training goes on; None: no such file.

    Args:
        workspace: of the job.
        training: as `training_key` returns it.
        shards: which networks train together.
    """
    if workspace is None:
        return [None] * len(shards)
    files: list[Path | None] = []
    for shard in shards:
        name = training if len(shards) == 1 else f"{training}.{shard.start}-{shard.stop}"
        file = workspace.file(f"{name}.ckpt")
        workspace.file(expert_checkpoint(file).name)  # where there are experts
        files.append(file)
    return files


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
    files: Sequence[Path | None],
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
        files: from which interrupted training goes on (`shard_checkpoints`).
    """
    errors = BaseErrors.of(training_data, dataset, settings.horizon)
    equilibrium = None
    if settings.equilibrium_weight > 0:
        equilibrium = EquilibriumTargets.of(training_data, dataset)
    weights, training_data = network.state_dict(), _without_pairs(training_data)
    whole = TrainingShard(settings, policy, training_data, dataset, errors, weights)
    whole = replace(whole, equilibrium=equilibrium)
    expert_weights = {}
    if settings.distillation_epochs:
        generator = torch.Generator().manual_seed(training_data.seed)
        expert = _expert(whole, {})
        expert_weights = untrained(policy, expert.dataset, expert.head, generator).state_dict()
    for networks, file in zip(shards, files, strict=True):
        shard = replace(whole, weights=_weights(weights, networks), checkpoint=file)
        if len(shards) > 1:
            size = dataset.ensemble_size
            names = training_data.names[networks.start // size : networks.stop // size]
            shard = replace(
                shard,
                training_data=replace(training_data, names=names),
                dataset=dataset.only(networks),
                errors=errors.only(networks),
                equilibrium=equilibrium and equilibrium.only(networks),
            )
        if expert_weights:
            shard = replace(shard, expert=_expert(shard, _weights(expert_weights, networks)))
        yield shard


def _weights(weights: Mapping[str, Tensor], networks: slice) -> dict[str, Tensor]:
    """Returns the weights of some of all networks."""
    return {name: value[networks].clone() for name, value in weights.items()}


def _without_pairs(training_data: TrainingData) -> TrainingData:
    """Returns the training data without its pairs, which a shard's dataset has: it is pickled."""
    pairs, base = training_data.pairs, training_data.pairs.base
    if base is not None:
        base = base[:0]
    return replace(
        training_data,
        recorded=training_data.recorded[:0],
        pairs=TrainingPairs(
            index=pairs.index[:0],
            split=pairs.split[:0],
            network=pairs.network[:0],
            start=pairs.start[:0],
            base=base,
        ),
        workspace=None,
        engine=LocalEngine(),
    )


def _expert(shard: TrainingShard, weights: dict[str, Tensor]) -> TrainingShard:
    """Returns the experts of a shard: the same trajectories, driven by `Direct`."""
    s, stepper = shard.settings, MemoryStepper(Direct(), shard.training_data.stepper.dt)
    epochs = s.epochs - s.distillation_epochs
    changes = {"head": OffsetHead.name, "distillation_epochs": 0, "epochs": epochs}
    space, start = stepper.model.adaptation_space, shard.training_data.pairs.start
    default = space.to_unit(space.defaults(dtype=start.dtype, device=start.device)).float()
    checkpoint = shard.checkpoint
    if checkpoint is not None:
        checkpoint = expert_checkpoint(checkpoint)
    return replace(
        shard,
        settings=s.model_copy(update=changes),
        training_data=replace(shard.training_data, stepper=stepper),
        dataset=shard.dataset.for_base(default),
        weights=weights,
        checkpoint=checkpoint,
        equilibrium=None,
    )


def epochs(settings: RolloutSettings) -> int:
    """Returns how many epochs a shard trains at most, those of experts among them."""
    if settings.distillation_epochs:
        return 2 * settings.epochs - settings.distillation_epochs
    return settings.epochs


def untrained(
    policy: Policy, dataset: RolloutDataset, head: ParameterHead, generator: torch.Generator
) -> PolicyNetwork:
    """Returns networks that answer no offset, on the device of the dataset.

    Args:
        policy: builds them.
        dataset: what they will read.
        head: makes parameters of their answers.
        generator: of their weights.
    """
    default = head.space.to_unit(head.space.defaults()).float()
    start = head.untrained_answer(default.expand(len(dataset.pair), -1))
    features = dataset.scaler.mean.shape[-1]
    return policy.build(features, default, start, generator).to(dataset.pair.device)
