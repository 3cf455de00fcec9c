"""One job, from its recordings to its results."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from cfx.app.job.surroundings import with_signals_of_inputs
from cfx.core import registry
from cfx.core.processes import raise_if_signalled
from cfx.data.base import load_pairs
from cfx.results.config import JobConfig

if TYPE_CHECKING:
    from rich.console import Console

    from cfx.data.base import Dataset
    from cfx.data.pairs import PairSet
    from cfx.results.result import Result

log = logging.getLogger(__name__)


def run_job(config: JobConfig, folder: Path, console: Console | None = None) -> Result:
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

    from cfx.app.job import steps
    from cfx.app.job.console import described, report, report_places
    from cfx.results.folder import Upload, begin
    from cfx.results.tracker import tracked

    raise_if_signalled()  # imports swallow Ctrl-C
    data = config.data
    console = console or Console()
    config, components = steps.prepare(config)
    begin(folder, config)
    upload = None if config.output.url is None else Upload(config.output.url, folder)
    with tracked(config, folder) as tracker:
        if config.data != data:  # the protocol has determined other data
            pairs = load_pairs(components.dataset)
        pairs, style = steps.select_pairs(pairs, config)
        if components.demo is not None:
            components.demo.check(pairs)
        tracker.set_tags(
            {
                "dataset.fingerprint": pairs.fingerprint,
                "dataset.source": pairs.source,
                "dataset.pairs": str(len(pairs)),
            }
        )
        context = steps.compose(config, components, pairs, style)
        result = steps.find(context, components, config)
        # Figures take seconds: the numbers are there before them.
        result = result.write(
            folder, config, tell=partial(report, console=console, verbose=config.output.verbose)
        )
        if context.workspace is not None:
            context.workspace.clear()  # the folder has the policy by now
        # After the folder, so that no failure of MLflow loses it.
        tracker.log_job(result, described(result))
        if upload is not None:
            upload.finish()
            tracker.set_tags({"cfx.output_url": upload.url})
    report_places(folder, console, tracker, None if upload is None else upload.url)
    return replace(result, run_id=tracker.run_id)


def compute(config: JobConfig, pairs: PairSet) -> Result:
    """Runs a job on pairs that are read already; writes nothing, caches nothing, tracks nothing.

    Raises:
        CfxError: as `run_job`.
    """
    from cfx.app.job import steps

    config, components, context = steps.without_files(config, pairs)
    return steps.find(context, components, config).with_tables(config)
