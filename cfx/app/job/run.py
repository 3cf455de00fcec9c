"""A job from its start: what it is, its pairs, then `cfx.app.job.steps`.

PyTorch, Lightning and MLflow take seconds to import. So a job first says what it does and reads its
recordings, which needs none of them: a wrong path or column is answered at once.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, cast

from cfx.core import registry
from cfx.data.base import load_pairs
from cfx.results.config import JobConfig

if TYPE_CHECKING:
    from rich.console import Console

    from cfx.app.job.results import JobResult
    from cfx.data.base import Dataset

log = logging.getLogger(__name__)


def run_job(config: JobConfig, folder: Path, console: Console | None = None) -> JobResult:
    """Runs one job and writes its results into `folder`.

    Args:
        config: the validated configuration.
        folder: the job's output folder; made if it is not there.
        console: where the table goes; stdout unless given.

    Raises:
        CfxError: the user's mistake, in one sentence; nothing half-written is left.
    """
    log.info(
        "Model %s, policy %s, learner %s, protocol %s, data %s: starting",
        *[node.get("name") for node in _chosen(config)],
    )
    # An engine that is not installed is named at once too; it connects to nothing yet.
    registry.create("engine", config.engine)
    pairs = load_pairs(cast("Dataset", registry.create("dataset", config.data)))
    from cfx.app.job.steps import take_steps

    return take_steps(config, folder, pairs, console)


def _chosen(config: JobConfig) -> list[dict[str, object]]:
    return [config.model, config.policy, config.learner, config.protocol, config.data]
