"""Saved policies: an agent in a folder.

`policy.json` holds everything that is text or a number, `policy.safetensors` the tensors: neither
can hold code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from torch import Tensor

from cfx.core import registry
from cfx.core.files import atomic_write
from cfx.core.job_folder import examine, parse_json
from cfx.errors import ConfigError, DataError, ParameterError
from cfx.models.base import DrivingModel
from cfx.policies.agent import Agent, TrainedOn
from cfx.policies.base import Policy
from cfx.policies.context import ContextRule, ExpectedError
from cfx.policies.core import AgentCore, features_read, network_with_weights
from cfx.policies.features import Scaler
from cfx.policies.heads import head_class
from cfx.policies.heads.base import ParameterHead
from cfx.policies.population import DriverPopulation
from cfx.policies.valid_range import RANGE_SIGNALS, ValidRange
from cfx.simulation.windows import WindowSettings

_FORMAT = 3
"""Of `policy.json`; it is raised when files of before can no longer be read, which are refused."""

_DESCRIPTION = "policy.json"
_TENSORS = "policy.safetensors"

_RANGE = "valid_range."
"""Prefix of the names of the valid range's tensors."""

_DRIVERS = "drivers."
"""Prefix of the names of the tensors of the drivers that were learned from."""


def save_agent(agent: Agent, folder: Path) -> None:
    """Writes `policy.safetensors` and `policy.json`; each appears whole.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.contiguous() for name, value in _tensors(agent).items()}
    with atomic_write(folder / _TENSORS) as temporary:
        temporary.write_bytes(safetensors.torch.save(tensors))
    with atomic_write(folder / _DESCRIPTION) as temporary:
        text = json.dumps(_Description.of(agent).model_dump(mode="json"), indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")


def load_agent(folder: Path | str) -> Agent:
    """Reads what `save` wrote, on the CPU.

    Raises:
        DataError: the folder holds no policy, or one of another format.
        PluginError: the model or the policy is not installed.
    """
    folder = Path(folder)
    examine(folder)
    description, weights = _read(folder)
    try:
        policy = registry.create("policy", description.policy)
        model = registry.create("model", description.model)
    except (ConfigError, ParameterError) as error:
        raise DataError(f"{folder}/{_DESCRIPTION}: {error}") from None
    assert isinstance(policy, Policy)
    assert isinstance(model, DrivingModel)
    policy = policy.for_model(model, description.dt, description.windows)
    if description.head not in registry.names("head"):
        raise DataError(
            f"{folder}/{_DESCRIPTION}: this version of cfx has no head '{description.head}'; it has"
            f" {', '.join(registry.names('head'))}"
        )
    head = head_class(description.head).for_model(model)
    try:
        return _agent(description, weights, policy, head)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RuntimeError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise DataError(f"{folder}: the weights do not fit the description ({reason})") from error


class _Description(BaseModel):
    """Schema of `policy.json`: a field for each of its keys."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    format: int = _FORMAT
    policy: dict[str, Any]
    model: dict[str, Any]
    parameters: tuple[str, ...] = Field(min_length=1)
    head: str
    windows: WindowSettings
    dt: float = Field(gt=0, le=100)
    names: tuple[str, ...] = Field(min_length=1)
    ensemble_size: int = Field(ge=1, le=64)
    shrinkage: float = Field(ge=0, le=1)
    own: bool
    history: float | None = Field(ge=0)
    combines: bool = False
    learned_from: dict[str, str]
    expected_error: ExpectedError | None = None
    recorded: dict[str, tuple[float, ...]]

    @classmethod
    def of(cls, agent: Agent) -> _Description:
        """Returns what is said of an agent."""
        rule, trained_on = agent.context_rule, agent.trained_on
        return cls(
            policy=dict(agent.policy_node),
            model=dict(agent.model_node),
            parameters=agent.space.names,
            head=agent.core.head.name,
            windows=agent.windows,
            dt=agent.dt,
            names=agent.names,
            ensemble_size=agent.core.ensemble_size,
            shrinkage=rule.shrinkage,
            own=rule.driver_specific,
            history=rule.history_s,
            combines=rule.combines,
            learned_from=dict(trained_on.pairs),
            expected_error=trained_on.expected_error,
            recorded=dict(trained_on.quantiles),
        )


def _agent(
    description: _Description,
    weights: Mapping[str, Tensor],
    policy: Policy,
    head: ParameterHead,
) -> Agent:
    """Puts an agent together.

    Raises:
        ValueError, KeyError, RuntimeError and others: the weights do not fit.
    """
    scaler = Scaler(weights["scaler.mean"], weights["scaler.scale"])
    expected = features_read(policy, head, description.windows.length)
    networks, features = scaler.mean.shape
    if features != expected:
        raise ValueError(
            f"the weights read {features} features, the policy's settings give {expected}"
        )
    if networks != len(description.names) or scaler.scale.shape != scaler.mean.shape:
        raise ValueError(f"there are weights of {networks} networks")
    if head.needs_base and "base" not in weights:
        raise ValueError(f"the head '{head.name}' needs 'base'")
    signals, shape = len(RANGE_SIGNALS), (networks,)
    shapes = {
        "base": (*shape, len(head.space)),
        "pooled": (*shape, len(head.model_space)),
        "dispersion": shape,
        f"{_RANGE}mean": (*shape, signals),
        f"{_RANGE}precision": (*shape, signals, signals),
        f"{_RANGE}distance": shape,
        f"{_RANGE}low": (*shape, signals),
        f"{_RANGE}high": (*shape, signals),
    }
    for name, value in weights.items():
        if value.shape != shapes.get(name, value.shape):
            raise ValueError(f"'{name}' has the shape {tuple(value.shape)}")
        if not bool(value.isfinite().all()):
            raise ValueError(f"'{name}' holds a number that is not finite")
    valid_range = None
    tensors_of_range = _named(weights, _RANGE)
    if tensors_of_range:
        valid_range = ValidRange(**tensors_of_range)
    drivers = None
    tensors_of_drivers = _named(weights, _DRIVERS)
    if tensors_of_drivers:
        drivers = DriverPopulation(**tensors_of_drivers)
        count = len(drivers.weight)
        if drivers.features.shape != (count, len(policy.driver_features)):
            raise ValueError(f"'{_DRIVERS}features' has the shape {tuple(drivers.features.shape)}")
    trained = _named(weights, "network.")
    network = network_with_weights(policy, trained, description.ensemble_size, scaler, head.answers)
    return Agent(
        core=AgentCore(policy, network, scaler, head),
        model_node=description.model,
        policy_node=description.policy,
        windows=description.windows,
        dt=description.dt,
        names=description.names,
        base=weights.get("base"),
        context_rule=ContextRule(
            driver_specific=description.own,
            shrinkage=description.shrinkage,
            history_s=description.history,
            combines=description.combines,
        ),
        pooled=weights.get("pooled"),
        trained_on=TrainedOn(
            description.learned_from, description.recorded, description.expected_error, drivers
        ),
        valid_range=valid_range,
        dispersion=weights.get("dispersion"),
    )


def _tensors(agent: Agent) -> dict[str, Tensor]:
    tensors = {}
    for name, value in agent.core.network.state_dict().items():
        tensors[f"network.{name}"] = value.cpu()
    for name, value in agent.core.scaler.state_dict().items():
        tensors[f"scaler.{name}"] = value.cpu()
    for name in ("base", "pooled", "dispersion"):
        value = getattr(agent, name)
        if value is not None:
            tensors[name] = value.cpu()
    if agent.valid_range is not None:
        for name, value in agent.valid_range._asdict().items():
            tensors[f"{_RANGE}{name}"] = value.cpu()
    if agent.trained_on.drivers is not None:
        for name, value in agent.trained_on.drivers._asdict().items():
            tensors[f"{_DRIVERS}{name}"] = value.cpu()
    return tensors


def _named(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Returns the tensors whose names have a prefix, without it."""
    named = {}
    for name, value in weights.items():
        if name.startswith(prefix):
            named[name.removeprefix(prefix)] = value
    return named


def _read(folder: Path) -> tuple[_Description, dict[str, Tensor]]:
    try:
        text = (folder / _DESCRIPTION).read_text(encoding="utf-8")
        written = parse_json(text)
        if not isinstance(written, dict):
            raise ValueError(f"{_DESCRIPTION} is no JSON object")
        weights = safetensors.torch.load((folder / _TENSORS).read_bytes())
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise DataError(
            f"{folder} holds no policy that can be read ({error}); give a job's folder"
        ) from error
    if written.get("format") != _FORMAT:
        raise DataError(
            f"{folder}/{_DESCRIPTION} has format {written.get('format')}; this version of cfx reads"
            f" format {_FORMAT}"
        )
    try:
        return _Description.model_validate(written), weights
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataError(
            f"{folder}/{_DESCRIPTION}: {key}: {first['msg']}; give a folder that a job has written"
        ) from None
