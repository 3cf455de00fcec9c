"""The contracts that every component and every plugin holds.

With pytest, a plugin's whole test is a subclass with one fixture (`ModelContract`,
`OptimizerContract`, ...). Without pytest, `contract_for(kind)` gives the same statements as plain
functions, and `violations` runs them:

    for name, sentence in violations(contract_for("model"), MyModel()):
        print(name, sentence)

Importing this package imports nothing heavy; pytest is needed by the suites alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cfx.errors import PluginError, nearest

if TYPE_CHECKING:
    from cfx.testing.checks.models import Equilibrium as Equilibrium
    from cfx.testing.checks.optimizers import Problems as Problems
    from cfx.testing.contract import Contract as Contract
    from cfx.testing.contract import NotApplicable as NotApplicable
    from cfx.testing.contract import violations as violations
    from cfx.testing.datasets import DatasetContract as DatasetContract
    from cfx.testing.engines import EngineContract as EngineContract
    from cfx.testing.learners import LearnerContract as LearnerContract
    from cfx.testing.metrics import MetricContract as MetricContract
    from cfx.testing.models import ModelContract as ModelContract
    from cfx.testing.objectives import ObjectiveContract as ObjectiveContract
    from cfx.testing.optimizers import OptimizerContract as OptimizerContract
    from cfx.testing.policies import PolicyContract as PolicyContract
    from cfx.testing.protocols import ProtocolContract as ProtocolContract
    from cfx.testing.simulators import SimulatorContract as SimulatorContract

_HOMES = {
    "DatasetContract": "cfx.testing.datasets",
    "ModelContract": "cfx.testing.models",
    "SimulatorContract": "cfx.testing.simulators",
    "ObjectiveContract": "cfx.testing.objectives",
    "OptimizerContract": "cfx.testing.optimizers",
    "PolicyContract": "cfx.testing.policies",
    "EngineContract": "cfx.testing.engines",
    "LearnerContract": "cfx.testing.learners",
    "ProtocolContract": "cfx.testing.protocols",
    "MetricContract": "cfx.testing.metrics",
    "Equilibrium": "cfx.testing.checks.models",
    "Problems": "cfx.testing.checks.optimizers",
    "Contract": "cfx.testing.contract",
    "NotApplicable": "cfx.testing.contract",
    "violations": "cfx.testing.contract",
}

_CHECKS = {
    "dataset": "cfx.testing.checks.datasets",
    "model": "cfx.testing.checks.models",
    "simulator": "cfx.testing.checks.simulators",
    "optimizer": "cfx.testing.checks.optimizers",
    "objective": "cfx.testing.checks.objectives",
    "policy": "cfx.testing.checks.policies",
    "engine": "cfx.testing.checks.engines",
    "learner": "cfx.testing.checks.learners",
    "protocol": "cfx.testing.checks.protocols",
    "metric": "cfx.testing.checks.metrics",
}

__all__ = [  # noqa: PLE0604 - the public names, from the one table that also says where they live
    *_HOMES,
    "contract_for",
]


def contract_for(kind: str) -> Contract:
    """Returns the contract of a kind of component: its `checks` and, of them, the `quick` ones.

    Raises:
        PluginError: there is no such kind.
    """
    if kind not in _CHECKS:
        raise PluginError(
            f"there is no contract for '{kind}'.{nearest(kind, _CHECKS)}"
            f" Known: {', '.join(_CHECKS)}."
        )
    found: Contract = import_module(_CHECKS[kind]).CONTRACT
    return found


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cfx.testing' has no attribute '{name}'")
    try:
        return getattr(import_module(_HOMES[name]), name)
    except ModuleNotFoundError as error:
        if error.name != "pytest":
            raise
        raise ModuleNotFoundError(
            f"cfx.testing.{name} is a pytest suite and pytest is not installed: pip install pytest;"
            " without it, cfx.testing.contract_for(kind) and cfx.testing.violations check a"
            " component",
            name="pytest",
        ) from error


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
