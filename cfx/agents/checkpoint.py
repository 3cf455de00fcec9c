"""Saved policies: an agent in a folder.

`policy.json` holds everything that is text or a number, `policy.pt` the tensors (a state dict that
is read with `weights_only=True`, so no code runs). Format 2 names the head; format 1 did not, and
what it saved loads too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cfx import registry, renamed
from cfx.agents.agent import Agent
from cfx.agents.context import ContextRule
from cfx.agents.core import AgentCore, features_read, network_with_weights
from cfx.agents.heads import HEADS, head_name
from cfx.agents.heads.base import ParameterHead
from cfx.agents.scaler import Scaler
from cfx.calibration.windows import WindowSettings
from cfx.errors import DataError
from cfx.files import atomic_write
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy

_FORMAT = 2
_READABLE = (1, 2)


def save(agent: Agent, folder: Path) -> None:
    """Writes `policy.pt` and `policy.json`; each appears whole.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "policy.pt") as temporary:
        torch.save(_tensors(agent), temporary)
    with atomic_write(folder / "policy.json") as temporary:
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
    return tensors


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
    }


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        description = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
        weights = torch.load(folder / "policy.pt", weights_only=True, map_location="cpu")
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(
            f"{folder} holds no policy that can be read ({error}); give a job's folder"
        ) from error
    if description.get("format") not in _READABLE:
        raise DataError(
            f"{folder}/policy.json has format {description.get('format')}; this version of cfx"
            f" reads formats {_READABLE[0]} to {_READABLE[-1]}"
        )
    return description, weights


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
