"""The contracts as pytest suites: one test per statement.

Subclass the suite of a kind and fill in its fixture; pytest does the rest. The whole test module of
a plugin:

    class TestMine(ModelContract):
        @pytest.fixture
        def model(self):
            return MyModel()
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any, ClassVar

import pytest

from cfx.calibration.objectives.base import Objective
from cfx.calibration.optimizers.base import Optimizer
from cfx.contracts import (
    commands,
    datasets,
    demos,
    engines,
    learners,
    metrics,
    models,
    objectives,
    optimizers,
    policies,
    protocols,
    simulators,
    tables,
)
from cfx.contracts.contract import Check, Contract, NotApplicable
from cfx.core.engine.base import Engine
from cfx.data.base import Dataset
from cfx.evaluation.demo import Demo
from cfx.evaluation.metrics.base import Metric
from cfx.evaluation.protocols.base import Protocol
from cfx.learners.base import Learner
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy
from cfx.results.table import ResultTable
from cfx.simulation.simulator import Simulator

if TYPE_CHECKING:
    from cfx.core.command import Command


def _statements(contract: Contract) -> pytest.MarkDecorator:
    """Makes a test of every statement; each is named as its function."""
    return pytest.mark.parametrize("check", contract.checks, ids=lambda check: check.__name__)


def hold(check: Check, component: object, **further: Any) -> None:
    """Checks one statement; skips it where the component claims nothing of the kind.

    Args:
        check: the statement.
        component: what must hold it.
        further: other arguments by name; the check is given those that it takes.
    """
    wanted = inspect.signature(check).parameters
    given = {name: value for name, value in further.items() if name in wanted}
    try:
        check(component, **given)
    except NotApplicable as reason:
        pytest.skip(str(reason))


def _undefined(suite: object, fixture: str) -> NotImplementedError:
    return NotImplementedError(f"{type(suite).__name__} must define the fixture `{fixture}`")


class DatasetContract:
    """What every dataset must hold: each statement of `cfx.contracts.datasets` is a test."""

    @pytest.fixture
    def dataset(self) -> Dataset:
        """Returns the dataset under test, with settings that find at least two pairs."""
        raise _undefined(self, "dataset")

    @_statements(datasets.CONTRACT)
    def test_contract(self, check: Check, dataset: Dataset) -> None:
        hold(check, dataset)


class ModelContract:
    """What every model must hold: each statement of `cfx.contracts.models` is a test."""

    @pytest.fixture
    def model(self) -> DrivingModel:
        """Returns the model under test."""
        raise _undefined(self, "model")

    @pytest.fixture
    def equilibrium(self) -> models.Equilibrium | None:
        """Returns the closed form of the equilibrium gap, where the model has one."""
        return None

    @pytest.fixture
    def leader_deceleration(self) -> float:
        """Returns how hard the leader brakes, m/s2, if the model claims to avoid collisions."""
        return 4.5

    @_statements(models.CONTRACT)
    def test_contract(
        self,
        check: Check,
        model: DrivingModel,
        equilibrium: models.Equilibrium | None,
        leader_deceleration: float,
    ) -> None:
        hold(check, model, equilibrium=equilibrium, leader_deceleration=leader_deceleration)


class SimulatorContract:
    """What every simulator must hold: each statement of `cfx.contracts.simulators` is a test."""

    @pytest.fixture
    def simulator(self) -> Simulator:
        """Returns the simulator under test."""
        raise _undefined(self, "simulator")

    @pytest.fixture
    def model(self) -> DrivingModel | None:
        """Returns the model to drive; None: the first of cfx's own that the simulator can drive."""
        return None

    @_statements(simulators.CONTRACT)
    def test_contract(self, check: Check, simulator: Simulator, model: DrivingModel | None) -> None:
        hold(check, simulator, model=model)


class ObjectiveContract:
    """What every objective must hold: each statement of `cfx.contracts.objectives` is a test."""

    @pytest.fixture
    def objective(self) -> Objective:
        """Returns the objective under test."""
        raise _undefined(self, "objective")

    @_statements(objectives.CONTRACT)
    def test_contract(self, check: Check, objective: Objective) -> None:
        hold(check, objective)


class OptimizerContract:
    """What every optimizer must hold: each statement of `cfx.contracts.optimizers` is a test.

    Attributes:
        tolerance: how far in unit space from a known optimum of two parameters the optimizer may
            end.
    """

    tolerance: ClassVar[float] = optimizers.TOLERANCE

    @pytest.fixture
    def optimizer(self) -> Optimizer:
        """Returns the optimizer under test; choose few evaluations: it runs some fifty times."""
        raise _undefined(self, "optimizer")

    @_statements(optimizers.CONTRACT)
    def test_contract(self, check: Check, optimizer: Optimizer) -> None:
        hold(check, optimizer, tolerance=self.tolerance)


class PolicyContract:
    """What every policy must hold: each statement of `cfx.contracts.policies` is a test."""

    @pytest.fixture
    def policy(self) -> Policy:
        """Returns the policy under test."""
        raise _undefined(self, "policy")

    @_statements(policies.CONTRACT)
    def test_contract(self, check: Check, policy: Policy) -> None:
        hold(check, policy)


class EngineContract:
    """What every engine must hold: each statement of `cfx.contracts.engines` is a test."""

    @pytest.fixture
    def engine(self) -> Engine:
        """Returns the engine under test."""
        raise _undefined(self, "engine")

    @_statements(engines.CONTRACT)
    def test_contract(self, check: Check, engine: Engine) -> None:
        hold(check, engine)


class LearnerContract:
    """What every learner must hold: each statement of `cfx.contracts.learners` is a test."""

    @pytest.fixture
    def learner(self) -> Learner:
        """Returns the learner under test, with a short training; a module-level one saves time."""
        raise _undefined(self, "learner")

    @_statements(learners.CONTRACT)
    def test_contract(self, check: Check, learner: Learner) -> None:
        hold(check, learner)


class ProtocolContract:
    """What every protocol must hold: each statement of `cfx.contracts.protocols` is a test."""

    @pytest.fixture
    def protocol(self) -> Protocol:
        """Returns the protocol under test; it gets six drivers, each behind their own leader."""
        raise _undefined(self, "protocol")

    @_statements(protocols.CONTRACT)
    def test_contract(self, check: Check, protocol: Protocol) -> None:
        hold(check, protocol)


class MetricContract:
    """What every metric must hold: each statement of `cfx.contracts.metrics` is a test."""

    @pytest.fixture
    def metric(self) -> Metric:
        """Returns the metric under test."""
        raise _undefined(self, "metric")

    @_statements(metrics.CONTRACT)
    def test_contract(self, check: Check, metric: Metric) -> None:
        hold(check, metric)


class TableContract:
    """What every table of results must hold: each statement of `cfx.contracts.tables` is a test."""

    @pytest.fixture
    def table(self) -> ResultTable:
        """Returns the table under test."""
        raise _undefined(self, "table")

    @_statements(tables.CONTRACT)
    def test_contract(self, check: Check, table: ResultTable) -> None:
        hold(check, table)


class DemoContract:
    """What every demonstration must hold: each statement of `cfx.contracts.demos` is a test."""

    @pytest.fixture
    def demo(self) -> Demo:
        """Returns the demonstration under test; it shows two simulated drivers."""
        raise _undefined(self, "demo")

    @_statements(demos.CONTRACT)
    def test_contract(self, check: Check, demo: Demo) -> None:
        hold(check, demo)


class CommandContract:
    """What every sub-command must hold: each statement of `cfx.contracts.commands` is a test."""

    @pytest.fixture
    def command(self) -> Command:
        """Returns the sub-command under test."""
        raise _undefined(self, "command")

    @_statements(commands.CONTRACT)
    def test_contract(self, check: Check, command: Command) -> None:
        hold(check, command)
