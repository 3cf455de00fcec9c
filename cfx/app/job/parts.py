"""The components of a job, made from its configuration and checked against each other."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import cast

import torch

from cfx.calibration.objectives.base import Objective
from cfx.calibration.optimizers.base import Optimizer
from cfx.core import registry
from cfx.core.engine.base import Engine
from cfx.core.errors import ConfigError
from cfx.core.storage import is_url
from cfx.data.base import Dataset
from cfx.evaluation.demo import Demo
from cfx.evaluation.metrics.installed import MetricSet
from cfx.evaluation.protocols.base import Protocol
from cfx.learners.base import Learner
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy
from cfx.policies.ready import is_ready_made
from cfx.results.config import JobConfig
from cfx.results.store import folder_of, is_run_id
from cfx.simulation.simulator import Simulator

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """The components of a job; making them checks the whole configuration before any work begins.

    The registry has checked that each is what its kind promises.
    """

    dataset: Dataset
    model: DrivingModel
    simulator: Simulator
    optimizer: Optimizer
    objective: Objective
    policy: Policy
    learner: Learner
    protocol: Protocol
    metrics: MetricSet
    engine: Engine
    demo: Demo | None = None

    @classmethod
    def of(cls, config: JobConfig, protocol: Protocol) -> Parts:
        """Makes the components of a configuration around a protocol that is there already.

        Raises:
            ConfigError: a setting is wrong, or two components do not fit each other.
            PluginError: a component cannot be loaded.
            CfxError: the simulator needs what is not installed, such as SUMO.
        """
        model = cast(DrivingModel, registry.create("model", config.model))
        if "model" not in protocol.determines():  # else the policy has been trained already
            model.refuse_unused()
        simulator = cast(Simulator, registry.create("simulator", config.simulator))
        simulator.require(model)
        learner = cast(Learner, registry.create("learner", config.learner))
        policy = cast(Policy, registry.create("policy", config.policy))
        if policy.adapts:
            learner.require_gradients(model, simulator.differentiable)
        if "policy" not in protocol.determines():  # else the policy has been trained already
            learner.require_no_driver_features(policy)
        demo = None
        if config.demo is not None:
            demo = cast(Demo, registry.create("demo", config.demo))
        return cls(
            dataset=cast(Dataset, registry.create("dataset", config.data)),
            model=model,
            simulator=simulator,
            optimizer=cast(Optimizer, registry.create("optimizer", config.optimizer)),
            objective=cast(Objective, registry.create("objective", config.objective)),
            policy=policy,
            learner=learner,
            protocol=protocol,
            metrics=MetricSet.of(config.metrics),
            engine=cast(Engine, registry.create("engine", config.engine)),
            demo=demo,
        )


def reported_objectives(config: JobConfig, objective: Objective) -> dict[str, Objective]:
    """Returns the objectives whose values a calibration reports: cfx's own and the chosen one.

    Args:
        config: names the chosen objective.
        objective: the chosen objective.
    """
    reported = {}
    for entry in registry.entries("objective"):
        if entry.distribution == registry.OWN:
            made = registry.create("objective", {"name": entry.name})
            reported[entry.name] = cast(Objective, made)
    reported[config.objective["name"]] = objective
    return reported


def make_protocol(config: JobConfig) -> Protocol:
    """Returns the protocol, for which ids of MLflow runs, and URLs, have become folders.

    Raises:
        ConfigError: a setting is wrong.
        TrackingError: there is no such run.
    """
    node = dict(config.protocol)
    name = node.get("name")
    if isinstance(name, str):
        protocol = cast(type[Protocol], registry.get("protocol", name))
        for setting in protocol.jobs:
            given = str(node.get(setting))
            if is_run_id(given) or is_ready_made(given) or is_url(given):
                node[setting] = folder_of(given, config.tracking.uri)
    return cast(Protocol, registry.create("protocol", node))


def complete(config: JobConfig, protocol: Protocol) -> JobConfig:
    """Returns the configuration with the nodes that the protocol determines."""
    determined = protocol.determines()
    if not determined:
        return config
    named = []
    for key, value in determined.items():
        if "name" in value:
            named.append(f"{key}={value['name']}")
        else:
            named.append(key)
    log.info("The protocol determines %s", ", ".join(named))
    return JobConfig.of({**config.model_dump(), **determined})


def choose_device(name: str) -> torch.device:
    """Returns the device that `device=NAME` asks for.

    Raises:
        ConfigError: the machine has no such device.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("cpu")
    device = torch.device(name)
    found = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= found:
        raise ConfigError(
            f"device={name}: PyTorch finds {found} CUDA devices here;"
            " write device=cpu or device=auto"
        )
    return device
