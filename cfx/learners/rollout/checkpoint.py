"""The file from which interrupted training goes on."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from cfx.component import content_key, folder_hash
from cfx.learners import base
from cfx.learners.base import TrainingData
from cfx.policies.base import Policy


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
        "drivers": training_data.drivers,
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
        training_data.pair,
        training_data.split.frame,
        training_data.fixed,
        training_data.network,
    ]
    if training_data.base is not None:
        tensors.append(training_data.base)
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
