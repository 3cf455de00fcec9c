"""cfx: calibrate car-following models, train policies that adapt them, measure whether it helps.

    result = cfx.run(["data=tidy", "data.path=pairs.parquet", "model=w99", "policy=gru"])
    result.metrics["rmse_improvement/mean"]

The names below, `cfx.errors` and `cfx.contracts` are the public API; everything else may change.
Importing cfx imports nothing heavy: each name is loaded when it is first used.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfx import errors as errors
    from cfx.application import run as run
    from cfx.commands.base import Command as Command
    from cfx.component import API_VERSION as API_VERSION
    from cfx.component import Settings as Settings
    from cfx.datasets.base import Dataset as Dataset
    from cfx.datasets.base import DatasetSettings as DatasetSettings
    from cfx.engine.base import Engine as Engine
    from cfx.job import JobResult as JobResult
    from cfx.job import load as load
    from cfx.learners.base import Learner as Learner
    from cfx.learners.base import TrainingData as TrainingData
    from cfx.learners.base import TrainingResult as TrainingResult
    from cfx.metrics.base import Metric as Metric
    from cfx.metrics.base import Trajectories as Trajectories
    from cfx.models.base import DrivingModel as DrivingModel
    from cfx.models.base import Follower as Follower
    from cfx.models.base import Leader as Leader
    from cfx.models.base import ModelSettings as ModelSettings
    from cfx.models.base import bumper_gap as bumper_gap
    from cfx.objectives.base import FrameValues as FrameValues
    from cfx.objectives.base import Objective as Objective
    from cfx.optimizers.base import CandidateLosses as CandidateLosses
    from cfx.optimizers.base import Optimizer as Optimizer
    from cfx.pairs import Pair as Pair
    from cfx.pairs import PairBatch as PairBatch
    from cfx.pairs import PairSet as PairSet
    from cfx.parameters import Parameter as Parameter
    from cfx.parameters import ParameterSpace as ParameterSpace
    from cfx.policies.base import Policy as Policy
    from cfx.policies.base import PolicyNetwork as PolicyNetwork
    from cfx.policies.base import PolicySettings as PolicySettings
    from cfx.protocols.base import Protocol as Protocol
    from cfx.protocols.base import ProtocolContext as ProtocolContext
    from cfx.protocols.base import ProtocolResult as ProtocolResult
    from cfx.registry import get as get
    from cfx.simulation.base import Stepper as Stepper
    from cfx.simulation.rollout import simulate as simulate
    from cfx.simulation.trajectory import Start as Start
    from cfx.simulators.base import Simulator as Simulator
    from cfx.simulators.base import SimulatorSettings as SimulatorSettings

    __version__: str

# MLflow reports its use to its makers unless told not to; nothing goes to the network unasked.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

_HOMES = {
    "run": "cfx.application",
    "get": "cfx.registry",
    "simulate": "cfx.simulation.rollout",
    "load": "cfx.job",
    "JobResult": "cfx.job",
    "Dataset": "cfx.datasets.base",
    "DatasetSettings": "cfx.datasets.base",
    "DrivingModel": "cfx.models.base",
    "Follower": "cfx.models.base",
    "Leader": "cfx.models.base",
    "ModelSettings": "cfx.models.base",
    "bumper_gap": "cfx.models.base",
    "Start": "cfx.simulation.trajectory",
    "Simulator": "cfx.simulators.base",
    "SimulatorSettings": "cfx.simulators.base",
    "Stepper": "cfx.simulation.base",
    "Engine": "cfx.engine.base",
    "Optimizer": "cfx.optimizers.base",
    "CandidateLosses": "cfx.optimizers.base",
    "Objective": "cfx.objectives.base",
    "FrameValues": "cfx.objectives.base",
    "Policy": "cfx.policies.base",
    "PolicySettings": "cfx.policies.base",
    "PolicyNetwork": "cfx.policies.base",
    "Learner": "cfx.learners.base",
    "TrainingData": "cfx.learners.base",
    "TrainingResult": "cfx.learners.base",
    "Protocol": "cfx.protocols.base",
    "ProtocolContext": "cfx.protocols.base",
    "ProtocolResult": "cfx.protocols.base",
    "Metric": "cfx.metrics.base",
    "Trajectories": "cfx.metrics.base",
    "Command": "cfx.commands.base",
    "Parameter": "cfx.parameters",
    "ParameterSpace": "cfx.parameters",
    "Settings": "cfx.component",
    "API_VERSION": "cfx.component",
    "Pair": "cfx.pairs",
    "PairSet": "cfx.pairs",
    "PairBatch": "cfx.pairs",
}

__all__ = [  # noqa: PLE0604 - the public names, from the one table that also says where they live
    *_HOMES,
    "errors",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    elif name in {"errors", "sumo"}:
        value = import_module(f"cfx.{name}")
    elif name == "__version__":
        value = _version()
    else:
        raise AttributeError(f"module 'cfx' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("cfx-driving")
    except PackageNotFoundError:  # a checkout that nobody installed
        return "0+unknown"
