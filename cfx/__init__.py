"""cfx: calibrate car-following models, train policies that adapt them, measure whether it helps.

    pairs = cfx.read("pairs.csv")
    fit = cfx.calibrate(pairs, "idm", objective="gap_rmse")

The verbs are here, for people; `__init__.pyi` lists them. `cfx.plugin` has the nouns, for authors
of plugins, `cfx.errors` what a user is told. These and `cfx_contracts` are the public API;
everything else may change. Importing cfx imports nothing heavy: each name is loaded when it is
first used.
"""

from __future__ import annotations

from typing import Any

import lazy_loader

_load, _names, _exported = lazy_loader.attach_stub(__name__, __file__)

__all__ = [*_exported, "__version__"]  # noqa: PLE0604 - the names that the stub lists


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    return _load(name)


def __dir__() -> list[str]:
    return sorted(__all__)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("cfx-driving")
    except PackageNotFoundError:  # a checkout that nobody installed
        return "0+unknown"
