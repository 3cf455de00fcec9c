"""Docstrings of the Python interface print what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import cfx.api
from cfx.core import registry

MODULES = [one.name for one in pkgutil.iter_modules(cfx.api.__path__, "cfx.api.")]
MODULES.append("cfx.sklearn")


@pytest.fixture(autouse=True)
def _forgets_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets no other test know the models that these define."""
    monkeypatch.setattr(registry, "_of_this_process", {})


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_say(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.failed == 0


def test_every_function_has_an_example() -> None:
    finder = doctest.DocTestFinder()
    functions = ("read", "calibrate", "simulate", "train", "evaluate", "forecast", "model")
    for name in (*functions, "config"):
        tests = finder.find(getattr(cfx, name), name)
        assert any(test.examples for test in tests), name
