"""Saved policies: an agent in a folder.

`policy.json` holds everything that is text or a number, `policy.safetensors` the tensors: neither
can hold code. Formats 1 and 2 kept the tensors in `policy.pt`, a state dict that is read with
`weights_only=True`; format 1 did not name the head. What they saved loads too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from cfx import registry, renamed
from cfx.agents.agent import Agent
from cfx.agents.context import ContextRule
from cfx.agents.core import AgentCore, features_read, network_with_weights
from cfx.agents.heads import HEADS, head_name
from cfx.agents.heads.base import ParameterHead
from cfx.agents.scaler import Scaler
from cfx.agents.valid_range import ValidRange
from cfx.calibration.windows import WindowSettings
from cfx.errors import DataError
from cfx.files import atomic_write
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy

_FORMAT = 3
_READABLE = (1, 2, 3)

_DESCRIPTION = "policy.json"
_TENSORS = "policy.safetensors"
_TENSORS_BEFORE = "policy.pt"
"""Where formats 1 and 2 kept the tensors."""

_LARGEST_MB = 256
"""A policy's files are larger only if they are something else."""

_RANGE = "valid_range."
"""What names of tensors of the valid range begin with."""


def save(agent: Agent, folder: Path) -> None:
    """Writes `policy.safetensors` and `policy.json`; each appears whole.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.contiguous() for name, value in _tensors(agent).items()}
    with atomic_write(folder / _TENSORS) as temporary:
        temporary.write_bytes(safetensors.torch.save(tensors))
    with atomic_write(folder / _DESCRIPTION) as temporary:
        text = json.dumps(_description(agent), indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")


def load(folder: Path | str) -> Agent:
    """Reads what `save` wrote, on the CPU.

    Raises:
        DataError: the folder holds no policy, or one of another format.
        PluginError: the model or the policy is not installed.
    """
    folder = Path(folder)
    description, weights = _read(folder)
    policy_node = renamed.node("policy", description["policy"])
    model_node = renamed.node("model", description["model"])
    policy = registry.create("policy", policy_node)
    model = registry.create("model", model_node)
    assert isinstance(policy, Policy)
    assert isinstance(model, DrivingModel)
    windows = WindowSettings(**description["windows"])
    base = weights.get("base")
    head = _head(folder, description, model, has_base=base is not None)
    scaler = Scaler(weights["scaler.mean"], weights["scaler.scale"])
    expected = features_read(policy, head, windows.length)
    found = scaler.mean.shape[1]
    if found != expected:
        raise DataError(
            f"{folder}: the weights read {found} features, the policy's settings give {expected}"
        )
    trained = {}
    for name, value in weights.items():
        if name.startswith("network."):
            trained[name.removeprefix("network.")] = value
    size = _ensemble_size(description)
    network = network_with_weights(policy, trained, size, scaler, len(head.space))
    return Agent(
        core=AgentCore(policy, network, scaler, head),
        model_node=model_node,
        policy_node=policy_node,
        windows=windows,
        dt=description["dt"],
        names=tuple(description["names"]),
        base=base,
        context_rule=ContextRule(
            driver_specific=description.get("own", True),
            shrinkage=description.get("shrinkage", 0.0),
            history_s=description.get("history"),
        ),
        population=weights.get("population"),
        learned_from=description.get("learned_from", {}),
        valid_range=_valid_range(weights),
        recorded=_recorded(description),
    )


def _tensors(agent: Agent) -> dict[str, Tensor]:
    tensors = {}
    for name, value in agent.network.state_dict().items():
        tensors[f"network.{name}"] = value.cpu()
    for name, value in agent.scaler.state_dict().items():
        tensors[f"scaler.{name}"] = value.cpu()
    if agent.base is not None:
        tensors["base"] = agent.base.cpu()
    if agent.population is not None:
        tensors["population"] = agent.population.cpu()
    if agent.valid_range is not None:
        for name, value in agent.valid_range.state_dict().items():
            tensors[f"{_RANGE}{name}"] = value.cpu()
    return tensors


def _recorded(description: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    found = {}
    for name, values in description.get("recorded", {}).items():
        found[name] = tuple(values)
    return found


def _valid_range(weights: Mapping[str, Tensor]) -> ValidRange | None:
    found = {}
    for name, value in weights.items():
        if name.startswith(_RANGE):
            found[name.removeprefix(_RANGE)] = value
    if not found:
        return None
    return ValidRange(**found)


def _description(agent: Agent) -> dict[str, Any]:
    rule = agent.context_rule
    return {
        "format": _FORMAT,
        "policy": dict(agent.policy_node),
        "model": dict(agent.model_node),
        "parameters": list(agent.space.names),
        "head": agent.head.name,
        "windows": agent.windows.model_dump(),
        "dt": agent.dt,
        "names": list(agent.names),
        "ensemble_size": agent.core.ensemble_size,
        "shrinkage": rule.shrinkage,
        "own": rule.driver_specific,
        "history": rule.history_s,
        "learned_from": dict(agent.learned_from),
        "recorded": {name: list(values) for name, values in agent.recorded.items()},
    }


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        text = _bounded(folder / _DESCRIPTION).read_text(encoding="utf-8")
        description = json.loads(text)
        if not isinstance(description, dict):
            raise ValueError(f"{_DESCRIPTION} is no JSON object")
        weights = _read_tensors(folder)
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise DataError(
            f"{folder} holds no policy that can be read ({error}); give a job's folder"
        ) from error
    if description.get("format") not in _READABLE:
        raise DataError(
            f"{folder}/policy.json has format {description.get('format')}; this version of cfx"
            f" reads formats {_READABLE[0]} to {_READABLE[-1]}"
        )
    return description, weights


def _read_tensors(folder: Path) -> dict[str, Tensor]:
    if (folder / _TENSORS).is_file():
        return safetensors.torch.load(_bounded(folder / _TENSORS).read_bytes())
    before = _bounded(folder / _TENSORS_BEFORE)
    weights: dict[str, Tensor] = torch.load(before, weights_only=True, map_location="cpu")
    return weights


def _bounded(path: Path) -> Path:
    """Returns the path of a file that is not too large to be a policy's."""
    size = path.stat().st_size
    if size > _LARGEST_MB * 2**20:
        raise ValueError(f"{path.name} has {size / 2**20:.0f} MB, at most {_LARGEST_MB} are read")
    return path


def _head(
    folder: Path, description: Mapping[str, Any], model: DrivingModel, *, has_base: bool
) -> ParameterHead:
    name = description.get("head", head_name(has_base=has_base))
    if name not in HEADS:
        raise DataError(
            f"{folder}/policy.json: this version of cfx has no head '{name}'; it has"
            f" {', '.join(HEADS)}"
        )
    return HEADS[name].for_model(model)


def _ensemble_size(description: Mapping[str, Any]) -> int:
    """Returns how many networks answer together; format 1 once called them members."""
    return int(description.get("ensemble_size", description.get("members", 1)))
