"""The steps of one job, in the order in which `run_job` calls them."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch

from cfx.app.job.calibration_tables import calibration_tables
from cfx.app.job.parts import Parts, choose_device, complete, make_protocol, reported_objectives
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.prior import prior_weight
from cfx.calibration.settings import WindowSettings
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.core.errors import PluginError
from cfx.core.memory import require_memory
from cfx.core.threads import limit_cores, set_threads
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.style import StyleResult, measure_style, select_cluster
from cfx.evaluation.protocols.base import ProtocolContext, ProtocolResult
from cfx.evaluation.result import Purpose
from cfx.results.config import JobConfig
from cfx.results.table import Findings

log = logging.getLogger(__name__)

_COARSE_S = 0.15
"""Time step above which calibrated parameters are biased noticeably (docs/readers.md)."""

_WINDOW_S = 0.5
"""Length of a window in the paper, and with default settings at NGSIM's time step of 0.1 s."""


def tags_of(pairs: PairSet) -> dict[str, str]:
    """Returns what MLflow's run says of the pairs."""
    return {
        "dataset.fingerprint": pairs.fingerprint,
        "dataset.source": pairs.source,
        "dataset.pairs": str(len(pairs)),
    }


def prepare(config: JobConfig) -> tuple[JobConfig, Parts]:
    """Makes the components, and completes the configuration by what the protocol determines.

    Raises:
        CfxError: a setting is wrong, or what a component needs is not there.
    """
    choose_device(config.device)  # one that is not there is named before any work begins
    limit_cores(config.cores)
    if config.threads is not None:
        set_threads(config.threads)
    protocol = make_protocol(config)
    config = complete(config, protocol)
    return config, Parts.of(config, protocol)


def select_pairs(pairs: PairSet, config: JobConfig) -> tuple[PairSet, StyleResult]:
    """Returns the pairs of the wanted driving style."""
    style = measure_style(pairs, config.style)
    pairs = select_cluster(pairs, style, config.style.cluster)
    for drop in pairs.dropped:
        log.info("Left out: %d %s (%s)", drop.count, drop.unit, drop.reason)
    _check_window(config.windows.length, pairs.dt)
    if pairs.dt > _COARSE_S:
        log.warning(
            "The time step is %.3g s: parameters calibrated in such steps are biased, since models"
            " are made for 0.1 s and less (at 1 s IDM's time gap comes out a quarter too short, s0"
            " 72 %% too large); say data.time_step=0.1, or compare parameters of the same step"
            " only",
            pairs.dt,
        )
    return pairs, style


def _check_window(length: int, dt: float) -> None:
    """Says so if the default number of steps makes windows much shorter or longer than usual."""
    lasts = length * dt
    usual = 0.5 * _WINDOW_S < lasts < 2 * _WINDOW_S
    if length == WindowSettings().length and not usual:
        log.info(
            "A window of %d steps lasts %.3g s in these recordings; settings are made for %g s:"
            " say data.time_step=%g, or change windows.length and windows.stride",
            length,
            lasts,
            _WINDOW_S,
            _WINDOW_S / length,
        )


def compose(config: JobConfig, parts: Parts, pairs: PairSet, style: StyleResult) -> ProtocolContext:
    """Returns what the protocol works with."""
    bound = parts.simulator.settings.memory_mb * 2**20
    require_memory(bound, f"simulator.memory_mb={parts.simulator.settings.memory_mb}")
    device = choose_device(config.device)
    batch = PairBatch.of(pairs, dtype=getattr(torch, config.dtype), device=device)
    cache_folder: Path | str | None = None
    workspace = None
    if config.cache.enabled:
        cache_folder = config.cache.folder
        # Behind a URL there is no place for what a training writes every few seconds.
        workspace = Path("outputs") / "training"
        if isinstance(cache_folder, Path):
            cache_folder = cache_folder.expanduser()
            workspace = cache_folder / "training"
    solver = Solver(
        parts.simulator.stepper(parts.model, batch.dt),
        parts.optimizer,
        config.seed,
        objective=parts.objective,
        memory=bound,
        prior=prior_weight(config.calibration.prior),
    )
    calibrator = Calibrator(
        solver,
        cache=Cache(cache_folder),
        reported=reported_objectives(config, parts.objective),
        engine=parts.engine,
    )
    return ProtocolContext(
        pairs=pairs,
        batch=batch,
        style=style,
        model_node=config.model,
        policy_node=config.policy,
        calibrator=calibrator,
        policy=parts.policy.for_model(parts.model, batch.dt, config.windows),
        learner=parts.learner,
        windows=config.windows,
        split=config.split,
        workspace=workspace,
        metrics=parts.metrics,
    )


def found(parts: Parts, context: ProtocolContext, result: object) -> Findings:
    """Returns what a protocol has delivered, with tables of the calibration.

    Raises:
        PluginError: it is no `ProtocolResult`.
    """
    if not isinstance(result, ProtocolResult):
        raise PluginError(
            f"{registry.origin(parts.protocol)}: run must return a cfx.ProtocolResult,"
            f" but returned a {type(result).__name__}"
        )
    purpose = Purpose.of(parts.model, parts.policy)
    evaluation = replace(result.evaluation, purpose=purpose).distinct_methods()
    tables = calibration_tables(context, evaluation)
    if "slices" in tables:
        evaluation = evaluation.with_slices(tables["slices"])
    evaluation = replace(evaluation, tables={**evaluation.tables, **tables})
    result = replace(result, evaluation=evaluation)
    return Findings(context.pairs, context.style, result, context.seed)
