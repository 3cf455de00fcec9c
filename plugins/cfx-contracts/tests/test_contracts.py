"""How contracts are found and checked; every registered component keeps the one of its kind."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from cfx.core import registry
from cfx.core.contract import NotApplicable, violations
from cfx.errors import NotInstalledError, PluginError
from cfx.models.krauss import Krauss
from cfx_contracts import check_contract, contract_for

SLOW = {
    ("protocol", "forecast"),
    ("protocol", "traffic"),
    ("engine", "local"),
    ("engine", "dask"),
    ("learner", "best_of"),
}
"""Those that take long even with the settings of their `trial`; `best_of` is checked beside it."""

FURTHER: dict[tuple[str, str], dict[str, Any]] = {("optimizer", "botorch"): {"tolerance": 0.1}}
"""What few evaluations make harder."""


def registered() -> list[Any]:
    """Returns all components that need no settings; those that do are checked in tests of theirs."""
    found = []
    for kind in registry.KINDS:
        for name in registry.names(kind):
            fields = registry.get(kind, name).schema.model_fields.values()
            if not any(registry.is_blank(field) for field in fields):
                marks = [pytest.mark.slow] if (kind, name) in SLOW else []
                found.append(pytest.param(kind, name, marks=marks, id=f"{kind}-{name}"))
    return found


@pytest.mark.parametrize(("kind", "name"), registered())
def test_every_registered_component_keeps_its_contract(kind: str, name: str) -> None:
    cls = registry.get(kind, name)
    component = registry.create(kind, {"name": name, **cls.trial})
    try:
        check_contract(component, **FURTHER.get((kind, name), {}))
    except NotInstalledError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("kind", registry.KINDS)
def test_each_kind_has_a_contract(kind: str) -> None:
    contract = contract_for(kind)
    assert contract.kind == kind
    assert contract.slow < set(contract.checks)
    assert set(contract.first) <= set(contract.quick)
    assert bool(contract.first) == bool(registry.KINDS[kind].first)


def test_there_is_none_for_an_unknown_kind() -> None:
    with pytest.raises(PluginError, match="Did you mean 'model'"):
        contract_for("modell")


def fails(model: Krauss) -> None:
    raise AssertionError("it is wrong")


def breaks(model: Krauss) -> None:
    raise ValueError("no luck")


def skips(model: Krauss) -> None:
    raise NotApplicable("the model claims nothing")


def test_what_does_not_hold_is_told_by_name_and_what_has_nothing_to_verify_is_left_out() -> None:
    found = list(violations(Krauss(), (skips, fails, breaks)))
    assert found == [
        ("fails", "it is wrong"),
        ("breaks", "the component raised ValueError: no luck"),
    ]


def test_all_that_does_not_hold_is_in_one_error() -> None:
    class Unsourced(Krauss):
        reference = ""

        def next_speed(self, *state: Any) -> Any:
            return -super().next_speed(*state)

    with pytest.raises(AssertionError, match="set `reference`") as told:
        check_contract(Unsourced())
    assert "steps_are_finite_and_never_negative: next_speed gives -" in str(told.value)
    assert "\nevery_parameter_says_what_it_is: " in str(told.value)


def test_a_check_gets_what_it_asks_for() -> None:
    seen = []

    def check(model: Krauss, tolerance: float = 0.1) -> None:
        seen.append(tolerance)

    assert not list(violations(Krauss(), (check, skips), tolerance=0.2))
    assert seen == [0.2]
    with pytest.raises(TypeError, match="takes tolerence"):
        list(violations(Krauss(), (check,), tolerence=0.2))


def test_it_needs_no_pytest_and_importing_it_nothing_heavy() -> None:
    code = """
import sys
sys.modules["pytest"] = None
from cfx.core.contract import violations
from cfx_contracts import contract_for
assert "torch" not in sys.modules
from cfx.models.krauss import Krauss
assert not list(violations(Krauss(), contract_for("model").first))
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_checks_refuse_to_run_where_assertions_are_removed() -> None:
    code = "from cfx.core.contract import violations; list(violations(None, ()))"
    done = subprocess.run(
        [sys.executable, "-O", "-c", code], capture_output=True, text=True, check=False
    )
    assert "start python without -O" in done.stderr
