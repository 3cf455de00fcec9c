"""A job from its start: what it is, its pairs, then `cfx.job.steps`.

PyTorch, Lightning and MLflow take seconds to import. So a job first says what it does and reads its
recordings, which needs none of them: a wrong path or column is answered at once.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, cast

from cfx import registry
from cfx.collector import importing
from cfx.config import JobConfig

if TYPE_CHECKING:
    from rich.console import Console

    from cfx.datasets.base import Dataset
    from cfx.job.results import JobResult
    from cfx.pairs import PairSet

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
    with importing():
        from cfx.job.steps import take_steps

    return take_steps(config, folder, pairs, console)


def load_pairs(dataset: Dataset) -> PairSet:
    """Returns all pairs of a dataset, and says what they are."""
    pairs = dataset.load()
    drivers = len({pair.driver for pair in pairs})
    log.info("%d pairs of %d drivers from %s", len(pairs), drivers, pairs.source)
    return pairs


def _chosen(config: JobConfig) -> list[dict[str, object]]:
    return [config.model, config.policy, config.learner, config.protocol, config.data]
