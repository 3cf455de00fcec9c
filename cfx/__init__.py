"""cfx: calibrate car-following models, train policies that adapt them, measure whether it helps.

    result = cfx.run(["data=tidy", "data.path=pairs.parquet", "model=w99", "policy=gru"])
    result.metrics["rmse_improvement/mean"]

The names below, `cfx.errors` and `cfx_contracts` are the public API; everything else may
change. Importing cfx imports nothing heavy: each name is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfx.api.experiment import Experiment as Experiment
    from cfx.api.experiment import config as config
    from cfx.api.experiment import evaluate as evaluate
    from cfx.api.experiment import from_config as from_config
    from cfx.api.experiment import model as model
    from cfx.api.experiment import train as train
    from cfx.api.fit import Fit as Fit
    from cfx.api.fit import calibrate as calibrate
    from cfx.api.forecasts import Forecast as Forecast
    from cfx.api.forecasts import forecast as forecast
    from cfx.api.pairs import Pairs as Pairs
    from cfx.api.pairs import read as read
    from cfx.api.simulation import simulate as simulate
    from cfx.app.application import run as run
    from cfx.app.job.results import JobResult as JobResult
    from cfx.app.job.results import load as load
    from cfx.calibration.objectives import FrameValues as FrameValues
    from cfx.calibration.objectives import Objective as Objective
    from cfx.calibration.optimizers import CandidateLosses as CandidateLosses
    from cfx.calibration.optimizers import Optimizer as Optimizer
    from cfx.core import errors as errors
    from cfx.core.command import Command as Command
    from cfx.core.component import API_VERSION as API_VERSION
    from cfx.core.component import Settings as Settings
    from cfx.core.engine import Engine as Engine
    from cfx.core.parameters import Parameter as Parameter
    from cfx.core.parameters import ParameterSpace as ParameterSpace
    from cfx.core.registry import get as get
    from cfx.data.base import Dataset as Dataset
    from cfx.data.base import DatasetSettings as DatasetSettings
    from cfx.data.pairs import Pair as Pair
    from cfx.data.pairs import PairBatch as PairBatch
    from cfx.data.pairs import PairSet as PairSet
    from cfx.evaluation.demo import Demo as Demo
    from cfx.evaluation.metrics.base import Metric as Metric
    from cfx.evaluation.metrics.base import Trajectories as Trajectories
    from cfx.evaluation.protocols.base import Protocol as Protocol
    from cfx.evaluation.protocols.base import ProtocolContext as ProtocolContext
    from cfx.evaluation.protocols.base import ProtocolResult as ProtocolResult
    from cfx.learners.base import Learner as Learner
    from cfx.learners.base import TrainingData as TrainingData
    from cfx.learners.base import TrainingResult as TrainingResult
    from cfx.models.base import DrivingModel as DrivingModel
    from cfx.models.base import Follower as Follower
    from cfx.models.base import Leader as Leader
    from cfx.models.base import ModelSettings as ModelSettings
    from cfx.models.base import bumper_gap as bumper_gap
    from cfx.policies.base import Policy as Policy
    from cfx.policies.base import PolicyNetwork as PolicyNetwork
    from cfx.policies.base import PolicySettings as PolicySettings
    from cfx.results.table import Column as Column
    from cfx.results.table import Findings as Findings
    from cfx.results.table import ResultTable as ResultTable
    from cfx.simulation.base import Simulator as Simulator
    from cfx.simulation.base import SimulatorSettings as SimulatorSettings
    from cfx.simulation.base import Stepper as Stepper
    from cfx.simulation.trajectory import Start as Start

    __version__: str

_HOMES = {
    "read": "cfx.api.pairs",
    "Pairs": "cfx.api.pairs",
    "calibrate": "cfx.api.fit",
    "Fit": "cfx.api.fit",
    "simulate": "cfx.api.simulation",
    "train": "cfx.api.experiment",
    "evaluate": "cfx.api.experiment",
    "forecast": "cfx.api.forecasts",
    "Forecast": "cfx.api.forecasts",
    "model": "cfx.api.experiment",
    "config": "cfx.api.experiment",
    "from_config": "cfx.api.experiment",
    "Experiment": "cfx.api.experiment",
    "run": "cfx.app.application",
    "get": "cfx.core.registry",
    "load": "cfx.app.job.results",
    "JobResult": "cfx.app.job.results",
    "Dataset": "cfx.data.base",
    "DatasetSettings": "cfx.data.base",
    "DrivingModel": "cfx.models.base",
    "Follower": "cfx.models.base",
    "Leader": "cfx.models.base",
    "ModelSettings": "cfx.models.base",
    "bumper_gap": "cfx.models.base",
    "Start": "cfx.simulation.trajectory",
    "Simulator": "cfx.simulation.base",
    "SimulatorSettings": "cfx.simulation.base",
    "Stepper": "cfx.simulation.base",
    "Engine": "cfx.core.engine",
    "Optimizer": "cfx.calibration.optimizers",
    "CandidateLosses": "cfx.calibration.optimizers",
    "Objective": "cfx.calibration.objectives",
    "FrameValues": "cfx.calibration.objectives",
    "Policy": "cfx.policies.base",
    "PolicySettings": "cfx.policies.base",
    "PolicyNetwork": "cfx.policies.base",
    "Learner": "cfx.learners.base",
    "TrainingData": "cfx.learners.base",
    "TrainingResult": "cfx.learners.base",
    "Protocol": "cfx.evaluation.protocols.base",
    "ProtocolContext": "cfx.evaluation.protocols.base",
    "ProtocolResult": "cfx.evaluation.protocols.base",
    "Metric": "cfx.evaluation.metrics.base",
    "Trajectories": "cfx.evaluation.metrics.base",
    "ResultTable": "cfx.results.table",
    "Column": "cfx.results.table",
    "Findings": "cfx.results.table",
    "Demo": "cfx.evaluation.demo",
    "Command": "cfx.core.command",
    "Parameter": "cfx.core.parameters",
    "ParameterSpace": "cfx.core.parameters",
    "Settings": "cfx.core.component",
    "API_VERSION": "cfx.core.component",
    "Pair": "cfx.data.pairs",
    "PairSet": "cfx.data.pairs",
    "PairBatch": "cfx.data.pairs",
}

__all__ = [  # noqa: PLE0604 - the public names, from the one table that also says where they live
    *_HOMES,
    "errors",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    elif name == "errors":
        value = import_module("cfx.errors")
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
