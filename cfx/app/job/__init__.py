"""One job, from the data to the figures.

A dataset gives pairs. An optimizer calibrates a driving model on them. A learner trains a policy
on the result. A protocol evaluates it. Tracking keeps what came out.

`steps` makes the components, `run` takes the steps, `output` writes the folder, `results` reads it
back, and `console` prints the table. This module imports none of them before a name is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfx.app.job.results import JobResult as JobResult
    from cfx.app.job.results import load as load
    from cfx.app.job.run import run_job as run_job

_HOMES = {
    "JobResult": "cfx.app.job.results",
    "load": "cfx.app.job.results",
    "run_job": "cfx.app.job.run",
}

__all__ = ["JobResult", "load", "run_job"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cfx.app.job' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
