"""The nouns of cfx, for authors of plugins: base classes, records, and the functions they call.

    from cfx.plugin import DrivingModel, Parameter, ParameterSpace, canvas

A plugin imports from `cfx`, `cfx.plugin`, `cfx.errors` and `cfx_contracts` alone; everything else
may change. `plugin.pyi` lists the names, by what they are for. Each is imported when it is first
used, so that importing this module imports nothing heavy. Where a name is a module, its `__all__`
says what a plugin may use of it.
"""

from importlib import import_module
from typing import Any

import lazy_loader

MODULES = {
    "canvas": "cfx.figures.canvas",
    "colours": "cfx.figures.colours",
    "composed": "cfx.models.composed",
    "comparison": "cfx.results.comparison",
    "console": "cfx.core.console",
    "distributions": "cfx.core.distributions",
    "drawing": "cfx.figures.drawing",
    "engine": "cfx.core.engine",
    "files": "cfx.core.files",
    "folds": "cfx.evaluation.protocols.folds",
    "forecasts": "cfx.evaluation.forecasts",
    "headline": "cfx.evaluation.headline",
    "identifiability": "cfx.calibration.identifiability",
    "improvement_bars": "cfx.results.figures.improvement_bars",
    "job_folder": "cfx.core.job_folder",
    "names": "cfx.data.names",
    "pair_lines": "cfx.results.figures.pair_lines",
    "parameter_spread": "cfx.results.figures.parameter_spread",
    "regimes": "cfx.models.regimes",
    "registry": "cfx.core.registry",
    "roads": "cfx.evaluation.roads",
    "statements": "cfx.data.statements",
    "statistics": "cfx.evaluation.statistics",
    "steady": "cfx.data.steady",
    "storage": "cfx.core.storage",
    "style": "cfx.data.style",
    "threads": "cfx.core.threads",
    "tracks": "cfx.data.tracks",
    "traffic": "cfx.evaluation.traffic",
    "traffic_table": "cfx.policies.ready.traffic_table",
    "valid_range": "cfx.policies.valid_range",
    "waves": "cfx.evaluation.waves",
    "wording": "cfx.figures.wording",
}
"""The names that are modules: `lazy_loader` finds attributes of modules alone."""

_attribute, __dir__, __all__ = lazy_loader.attach_stub("cfx", __file__)


def __getattr__(name: str) -> Any:
    """Imports what is asked for.

    Raises:
        AttributeError: there is no such name.
    """
    return import_module(MODULES[name]) if name in MODULES else _attribute(name)
