"""One job, from its recordings to its results."""

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
    from cfx.data.pairs import PairSet

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
    log.info("%s: starting", config.in_words())
    # An engine that is not installed is named at once too; it connects to nothing yet.
    registry.create("engine", config.engine)
    pairs = load_pairs(cast("Dataset", registry.create("dataset", config.data)))

    # These take seconds to import: a wrong path or column has been answered by now.
    from rich.console import Console

    from cfx.app.job import output, steps
    from cfx.app.job.console import described, report, report_places
    from cfx.app.job.output import Upload
    from cfx.app.job.results import Computed, JobResult
    from cfx.results.tracker import tracked

    data = config.data
    console = console or Console()
    config, parts = steps.prepare(config)
    output.begin(folder, config)
    upload = Upload.of(config.output.url, folder)
    with tracked(config, folder) as tracker:
        if config.data != data:  # the protocol has determined other data
            pairs = load_pairs(parts.dataset)
        pairs, style = steps.select_pairs(pairs, config)
        if parts.demo is not None:
            parts.demo.check(pairs)
        tracker.set_tags(steps.tags_of(pairs))
        context = steps.compose(config, parts, pairs, style)
        findings = steps.find(context, parts, config.calibration)
        # Figures take seconds: the numbers are there before them.
        kept = output.write_job(
            folder,
            config,
            parts,
            findings,
            tell=lambda metrics, tables: report(findings, metrics, tables, console),
        )
        # After the folder, so that no failure of MLflow loses it.
        tracker.log_job(findings, kept, described(config, findings, kept.metrics))
        if upload is not None:
            upload.finish()
            tracker.set_tags({"cfx.output_url": upload.url})
    copied_to = None if upload is None else upload.url
    report_places(kept.folder, console, tracker, copied_to)
    return JobResult(
        metrics=kept.metrics,
        pairs=findings.evaluation.table,
        policy=findings.protocol_result.policy,
        figures=tuple(kept.figures),
        folder=folder,
        run_id=tracker.run_id,
        computed=Computed(config, parts, findings),
    )


def compute(config: JobConfig, pairs: PairSet) -> JobResult:
    """Runs a job on pairs that are read already; writes nothing, caches nothing, tracks nothing.

    Args:
        config: the validated configuration.
        pairs: what its dataset reads.

    Raises:
        CfxError: as `run_job`.
    """
    from cfx.app.job import output, steps
    from cfx.app.job.results import Computed, JobResult

    config, parts = steps.prepare(config)
    pairs, style = steps.select_pairs(pairs, config)
    context = steps.compose(steps.uncached(config), parts, pairs, style)
    findings = steps.find(context, parts, config.calibration)
    return JobResult(
        metrics=output.measured(findings, output.tables_of(findings)),
        pairs=findings.evaluation.table,
        policy=findings.protocol_result.policy,
        figures=(),
        folder=None,
        computed=Computed(config, parts, findings),
    )
