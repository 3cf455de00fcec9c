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

from cfx.core.errors import PluginError, nearest

if TYPE_CHECKING:
    from cfx.contracts.contract import Contract as Contract
    from cfx.contracts.contract import NotApplicable as NotApplicable
    from cfx.contracts.contract import violations as violations
    from cfx.contracts.models import Equilibrium as Equilibrium
    from cfx.contracts.optimizers import Problems as Problems
    from cfx.contracts.suites import CommandContract as CommandContract
    from cfx.contracts.suites import DatasetContract as DatasetContract
    from cfx.contracts.suites import DemoContract as DemoContract
    from cfx.contracts.suites import EngineContract as EngineContract
    from cfx.contracts.suites import LearnerContract as LearnerContract
    from cfx.contracts.suites import MetricContract as MetricContract
    from cfx.contracts.suites import ModelContract as ModelContract
    from cfx.contracts.suites import ObjectiveContract as ObjectiveContract
    from cfx.contracts.suites import OptimizerContract as OptimizerContract
    from cfx.contracts.suites import PolicyContract as PolicyContract
    from cfx.contracts.suites import ProtocolContract as ProtocolContract
    from cfx.contracts.suites import SimulatorContract as SimulatorContract
    from cfx.contracts.suites import TableContract as TableContract

_CHECKS = {
    "dataset": "cfx.contracts.datasets",
    "model": "cfx.contracts.models",
    "simulator": "cfx.contracts.simulators",
    "optimizer": "cfx.contracts.optimizers",
    "objective": "cfx.contracts.objectives",
    "policy": "cfx.contracts.policies",
    "engine": "cfx.contracts.engines",
    "learner": "cfx.contracts.learners",
    "protocol": "cfx.contracts.protocols",
    "metric": "cfx.contracts.metrics",
    "table": "cfx.contracts.tables",
    "demo": "cfx.contracts.demos",
    "command": "cfx.contracts.commands",
}
"""Where each kind's statements are."""

_HOMES = {
    **{f"{kind.capitalize()}Contract": "cfx.contracts.suites" for kind in _CHECKS},
    "Equilibrium": "cfx.contracts.models",
    "Problems": "cfx.contracts.optimizers",
    "Contract": "cfx.contracts.contract",
    "NotApplicable": "cfx.contracts.contract",
    "violations": "cfx.contracts.contract",
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
        raise AttributeError(f"module 'cfx.contracts' has no attribute '{name}'")
    try:
        return getattr(import_module(_HOMES[name]), name)
    except ModuleNotFoundError as error:
        if error.name != "pytest":
            raise
        raise ModuleNotFoundError(
            f"cfx.contracts.{name} is a pytest suite and pytest is not installed: pip install"
            " pytest; without it, cfx.contracts.contract_for(kind) and cfx.contracts.violations"
            " check a component",
            name="pytest",
        ) from error


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
