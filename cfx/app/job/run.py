"""One job, from its recordings to its results."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, cast

from cfx.app.job.surroundings import with_signals_of_inputs
from cfx.core import registry
from cfx.core.processes import raise_if_signalled
from cfx.data.base import load_pairs
from cfx.results.config import JobConfig

if TYPE_CHECKING:
    from rich.console import Console

    from cfx.app.job.results import JobResult
    from cfx.data.base import Dataset
    from cfx.data.pairs import PairSet

log = logging.getLogger(__name__)


def run_job(config: JobConfig, folder: Path, console: Console | None = None) -> JobResult:
    """Runs one job and writes its results into `folder`, which is made if it is not there.

    Raises:
        CfxError: the user's mistake, in one sentence; nothing half-written is left.
    """
    log.info("%s: starting", config.in_words())
    # An engine that is not installed is named at once too; it connects to nothing yet.
    registry.create("engine", config.engine)
    config = with_signals_of_inputs(config)
    pairs = load_pairs(cast("Dataset", registry.create("dataset", config.data)))

    # These take seconds to import: a wrong path or column has been answered by now.
    from rich.console import Console

    from cfx.app.job import results, steps
    from cfx.app.job.console import described, report, report_places
    from cfx.results.tracker import tracked

    raise_if_signalled()  # imports swallow Ctrl-C
    data = config.data
    console = console or Console()
    config, parts = steps.prepare(config)
    results.begin(folder, config)
    upload = None if config.output.url is None else results.Upload(config.output.url, folder)
    with tracked(config, folder) as tracker:
        if config.data != data:  # the protocol has determined other data
            pairs = load_pairs(parts.dataset)
        pairs, style = steps.select_pairs(pairs, config)
        if parts.demo is not None:
            parts.demo.check(pairs)
        tracker.set_tags(
            {
                "dataset.fingerprint": pairs.fingerprint,
                "dataset.source": pairs.source,
                "dataset.pairs": str(len(pairs)),
            }
        )
        context = steps.compose(config, parts, pairs, style)
        findings = steps.find(context, parts, config.calibration)
        # Figures take seconds: the numbers are there before them.
        kept = results.write_job(
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
    report_places(kept.folder, console, tracker, None if upload is None else upload.url)
    return results.JobResult(
        metrics=kept.metrics,
        pairs=findings.evaluation.table,
        policy=findings.protocol_result.policy,
        figures=tuple(kept.figures),
        folder=folder,
        run_id=tracker.run_id,
        computed=results.Computed(config, parts, findings),
    )


def compute(config: JobConfig, pairs: PairSet) -> JobResult:
    """Runs a job on pairs that are read already; writes nothing, caches nothing, tracks nothing.

    Raises:
        CfxError: as `run_job`.
    """
    from cfx.app.job import results, steps

    config, parts, context = steps.without_files(config, pairs)
    findings = steps.find(context, parts, config.calibration)
    return results.JobResult(
        metrics=results.measured(findings, results.tables_of(findings, parts.tables)),
        pairs=findings.evaluation.table,
        policy=findings.protocol_result.policy,
        figures=(),
        folder=None,
        computed=results.Computed(config, parts, findings),
    )
