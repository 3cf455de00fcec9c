"""The package `cfx.contracts` itself: it offers contracts, and needs pytest for suites alone."""

from __future__ import annotations

import subprocess
import sys

import pytest

import cfx.contracts
from cfx.contracts.contract import NotApplicable
from cfx.contracts.suites import hold
from cfx.core.errors import PluginError
from cfx.core.registry import KINDS
from cfx.models.krauss import Krauss

SUITES = {
    "dataset": cfx.contracts.DatasetContract,
    "model": cfx.contracts.ModelContract,
    "engine": cfx.contracts.EngineContract,
    "simulator": cfx.contracts.SimulatorContract,
    "objective": cfx.contracts.ObjectiveContract,
    "optimizer": cfx.contracts.OptimizerContract,
    "policy": cfx.contracts.PolicyContract,
    "learner": cfx.contracts.LearnerContract,
    "protocol": cfx.contracts.ProtocolContract,
    "metric": cfx.contracts.MetricContract,
    "table": cfx.contracts.TableContract,
    "demo": cfx.contracts.DemoContract,
    "command": cfx.contracts.CommandContract,
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_suite_tests_every_statement_of_its_contract(kind: str) -> None:
    contract = cfx.contracts.contract_for(kind)
    assert contract.kind == kind
    (mark,) = SUITES[kind].test_contract.pytestmark
    assert mark.args == ("check", contract.checks)
    assert set(contract.quick) | contract.slow == set(contract.checks)
    assert contract.quick


def test_everything_it_names_is_there() -> None:
    for name in cfx.contracts.__all__:
        assert getattr(cfx.contracts, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Modelcontract'"):
        _ = cfx.contracts.Modelcontract
    with pytest.raises(PluginError, match="Did you mean 'model'"):
        cfx.contracts.contract_for("modell")


def test_a_check_that_has_nothing_to_verify_is_skipped() -> None:
    def check(model: Krauss) -> None:
        raise NotApplicable("the model claims nothing")

    with pytest.raises(pytest.skip.Exception, match="claims nothing"):
        hold(check, Krauss())


def test_a_check_gets_what_it_asks_for() -> None:
    seen = []

    def check(model: Krauss, tolerance: float = 0.1) -> None:
        seen.append(tolerance)

    hold(check, Krauss(), tolerance=0.2, equilibrium=None)
    assert seen == [0.2]


def test_without_pytest_components_can_be_checked_and_suites_say_what_they_need() -> None:
    code = """
import sys
sys.modules["pytest"] = None
import cfx.contracts
assert "torch" not in sys.modules
from cfx.models.krauss import Krauss
print(list(cfx.contracts.violations(cfx.contracts.contract_for("model"), Krauss())))
try:
    cfx.contracts.ModelContract
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(
        "[]\ncfx.contracts.ModelContract is a pytest suite and pytest is not installed:"
        " pip install pytest"
    )


def test_checks_refuse_to_run_where_assertions_are_removed() -> None:
    code = "import cfx.contracts as t; next(t.violations(t.Contract('model', ()), None))"
    done = subprocess.run(
        [sys.executable, "-O", "-c", code], capture_output=True, text=True, check=False
    )
    assert "start python without -O" in done.stderr
