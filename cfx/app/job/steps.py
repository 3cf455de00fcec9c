"""The steps of one job, in the order in which `run_job` calls them, and its components."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.app.job.surroundings import require_signals, with_signals_of_inputs
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.identifiability import slices, training_errors
from cfx.calibration.losses import prior_strength, prior_weight
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import Optimizer
from cfx.calibration.posterior import posterior_method
from cfx.calibration.settings import CalibrationSettings, doubts
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.core.engine import Engine
from cfx.core.memory import require_memory
from cfx.core.storage import is_url
from cfx.core.threads import limit_cores, set_threads
from cfx.data.base import Dataset
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.resampling import COARSE_S
from cfx.data.style import StyleResult, measure_style, select_cluster
from cfx.errors import ConfigError, PluginError
from cfx.evaluation.demo import Demo
from cfx.evaluation.metrics.base import MetricSet
from cfx.evaluation.metrics.objective import judged_by
from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.result import Evaluation, Purpose
from cfx.evaluation.sites import site_table
from cfx.learners.base import Learner
from cfx.learners.curves import learning_curves
from cfx.learners.workspace import Workspace
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy
from cfx.policies.ready import is_ready_made
from cfx.results.config import JobConfig
from cfx.results.provenance import commit, distributions, version
from cfx.results.result import Result
from cfx.results.tables.known_parameters import noise_evidence
from cfx.results.tracker import folder_of, is_run_id
from cfx.simulation.base import Simulator
from cfx.simulation.rollout import MemorySimulator, MemoryStepper
from cfx.simulation.settings import WindowSettings
from cfx.simulation.windows import Split

log = logging.getLogger(__name__)

_CONSTANT = ("default", "pooled", "driver_specific")

_WINDOW_S = 0.5
"""Length of a window in the paper, and with default settings at NGSIM's time step of 0.1 s."""


def calibration_tables(
    context: ProtocolContext, evaluation: Evaluation, settings: CalibrationSettings
) -> dict[str, pd.DataFrame]:
    """Returns the tables of a calibration of driver-specific parameters.

    There are none where nothing was calibrated per driver, nor, but for a posterior that was asked
    for, where another program simulates (`simulator=sumo`): slices would take minutes.

    Returns:
        slices: see `cfx.calibration.identifiability.slices`.
        fits: see `cfx.results.tables.fits.Fits`; with a posterior it has
            `DriverPosteriors.columns`.
        Further ones with a posterior, see `DriverPosteriors.tables`.
    """
    calibrated = "driver_specific" in evaluation.methods and bool(evaluation.names)
    elsewhere = not isinstance(context.stepper, MemoryStepper)
    if not calibrated and settings.posterior != "none":
        log.warning(
            "calibration.posterior=%s has nothing to say: this job has calibrated no"
            " driver-specific parameters",
            settings.posterior,
        )
    if not calibrated or (elsewhere and settings.posterior == "none"):
        return {}
    ids = evaluation.about["pair_id"].drop_duplicates().astype(str).tolist()
    # Where the tested pairs stand among all.
    numbers = pd.Index(context.pairs.ids).get_indexer(pd.Index(ids))
    tested = torch.from_numpy(numbers)
    batch = context.batch[tested.to(context.batch.lengths.device)]
    last = Split.of(context.pairs, context.windows, context.split).frame[tested]
    ends_apart = context.calibrator.apart(context.pairs.take(numbers.tolist()), last)
    fits = []
    tables = {}
    for method in evaluation.methods:
        if method in _CONSTANT:
            parameters = _parameters(evaluation, method, ids, batch.leader_length)
            errors = training_errors(context.calibrator, batch, last, parameters)
            rows = _errors_of_method(evaluation, method, errors, is_tested=context.split < 1)
            if method == "driver_specific" and not all(map(math.isnan, ends_apart)):
                rows["ends_apart"] = ends_apart
            if method == "driver_specific" and settings.posterior != "none":
                solver = context.calibrator.solver
                method_of = posterior_method(settings.posterior)
                posteriors = method_of.find(solver, batch, last, parameters, settings)
                intervals = pd.DataFrame(posteriors.columns(), index=ids)
                intervals["doubt"] = doubts(intervals)
                rows = rows.join(intervals, on="pair_id")
                tables = posteriors.tables(ids)
            fits.append(rows)
    if not elsewhere:
        best = _parameters(evaluation, "driver_specific", ids, batch.leader_length)
        tables["slices"] = slices(context.calibrator, batch, last, best, ids)
    return {**tables, "fits": pd.concat(fits, ignore_index=True)}


def _errors_of_method(
    evaluation: Evaluation, method: str, training: Mapping[str, Tensor], *, is_tested: bool
) -> pd.DataFrame:
    """Returns a row per pair: a method's errors where it was calibrated, and on the test part.

    Args:
        training: by metric `(P,)`, on the part that was calibrated on.
        is_tested: there is a test part; else all of the pair was calibrated on.
    """
    of_method = evaluation.table[evaluation.table["method"] == method]
    rows = of_method[["pair_id", "driver"]].reset_index(drop=True).assign(method=method)
    for name, values in training.items():
        rows[f"train_{name}"] = values.cpu().numpy()
        if is_tested:
            rows[f"test_{name}"] = of_method[name].to_numpy(dtype=np.float64)
    return rows


def _parameters(evaluation: Evaluation, method: str, ids: list[str], reference: Tensor) -> Tensor:
    """Returns a method's constant parameters `(P, n)`, SI units, of `reference`'s dtype."""
    rows = evaluation.about[evaluation.about["method"] == method].set_index("pair_id")
    columns = [f"parameter_{name}" for name in evaluation.names]
    values = np.array(rows.loc[ids, columns], dtype=np.float64)
    return torch.as_tensor(values, dtype=reference.dtype, device=reference.device)


@dataclass(frozen=True)
class JobComponents:
    """The components of a job; making them checks the whole configuration before any work begins.

    The registry has checked that each is what its kind promises.
    """

    dataset: Dataset
    model: DrivingModel
    simulator: Simulator
    optimizer: Optimizer
    objective: Objective
    policy: Policy
    learner: Learner
    protocol: Protocol
    metrics: MetricSet
    engine: Engine
    demo: Demo | None = None

    @classmethod
    def of(cls, config: JobConfig, protocol: Protocol) -> JobComponents:
        """Makes the components of a configuration around a protocol that is there already.

        Raises:
            CfxError: a setting is wrong, two components do not fit each other, or one cannot be
                loaded or needs what is not installed, such as SUMO.
        """
        model = cast(DrivingModel, registry.create("model", config.model))
        if "model" not in protocol.determines():  # else the policy has been trained already
            model.refuse_unused()
        simulator = cast(Simulator, registry.create("simulator", config.simulator))
        simulator.require(model)
        learner = cast(Learner, registry.create("learner", config.learner))
        policy = cast(Policy, registry.create("policy", config.policy))
        if policy.adapts:
            learner.require_gradients(model, simulator.differentiable)
        if "policy" not in protocol.determines():  # else the policy has been trained already
            learner.require_no_driver_features(policy)
        # Tables and figures have no state: each is made when it is written. A name that is none is
        # told now.
        plugins = distributions(config.model_dump())
        registry.chosen("table", config.tables, plugins)
        registry.chosen("figure", config.figures, plugins)
        objective = cast(Objective, registry.create("objective", config.objective))
        demo = None
        if config.demo is not None:
            demo = cast(Demo, registry.create("demo", config.demo))
        return cls(
            dataset=cast(Dataset, registry.create("dataset", config.data)),
            model=model,
            simulator=simulator,
            optimizer=cast(Optimizer, registry.create("optimizer", config.optimizer)),
            objective=objective,
            policy=policy,
            learner=learner,
            protocol=protocol,
            metrics=judged_by(MetricSet.of(config.metrics), objective),
            engine=cast(Engine, registry.create("engine", config.engine)),
            demo=demo,
        )


def make_protocol(config: JobConfig) -> Protocol:
    """Returns the protocol, for which ids of MLflow runs, and URLs, have become folders.

    Raises:
        ConfigError: a setting is wrong.
        TrackingError: there is no such run.
    """
    node = dict(config.protocol)
    name = node.get("name")
    if isinstance(name, str):
        protocol = cast(type[Protocol], registry.get("protocol", name))
        for setting in protocol.jobs:
            place = str(node.get(setting))
            if is_run_id(place) or is_ready_made(place) or is_url(place):
                node[setting] = folder_of(place, config.tracking.uri)
    return cast(Protocol, registry.create("protocol", node))


def complete(config: JobConfig, protocol: Protocol) -> JobConfig:
    """Returns the configuration with the nodes that the protocol determines."""
    determined = protocol.determines()
    if not determined:
        return config
    named = []
    for key, value in determined.items():
        named.append(f"{key}={value['name']}" if "name" in value else key)
    log.info("The protocol determines %s", ", ".join(named))
    return JobConfig.of({**config.model_dump(), **determined})


def choose_device(name: str) -> torch.device:
    """Returns the device that `device=NAME` asks for.

    Raises:
        ConfigError: the machine has no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    gpus = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= gpus:
        raise ConfigError(
            f"device={name}: PyTorch finds {gpus} CUDA devices here;"
            " write device=cpu or device=auto"
        )
    return device


def prepare(config: JobConfig) -> tuple[JobConfig, JobComponents]:
    """Makes the components, and completes the configuration by what the protocol determines.

    Raises:
        CfxError: a setting is wrong, or what a component needs is not there.
    """
    choose_device(config.device)  # one that is not there is named before any work begins
    limit_cores(config.cores)
    if config.threads is not None:
        set_threads(config.threads)
    protocol = make_protocol(config)
    config = with_signals_of_inputs(complete(config, protocol))
    components = JobComponents.of(config, protocol)
    if config.calibration.posterior != "none":
        # One that is not there is named at once.
        method = posterior_method(config.calibration.posterior)
        if not method.any_simulator and not isinstance(components.simulator, MemorySimulator):
            raise ConfigError(
                f"calibration.posterior={config.calibration.posterior} simulates each trajectory"
                " too often for any simulator but simulator=memory alone; take"
                " calibration.posterior=laplace or sbi, or leave one of them out"
            )
        noise = config.calibration.noise
        starts_again = noise not in {"chosen", "trajectory"}
        if starts_again and not isinstance(components.simulator, MemorySimulator):
            raise ConfigError(
                f"calibration.noise={noise} corrects states while it simulates, which"
                " simulator=memory alone can; set calibration.noise=trajectory, or leave one of"
                " them out"
            )
    return config, components


def select_pairs(pairs: PairSet, config: JobConfig) -> tuple[PairSet, StyleResult]:
    """Returns the pairs of the wanted driving style."""
    style = measure_style(pairs, config.style)
    pairs = select_cluster(pairs, style, config.style.cluster)
    for drop in pairs.dropped:
        log.info("Left out: %d %s (%s)", drop.count, drop.unit, drop.reason)
    length = config.windows.length
    usual = 0.5 * _WINDOW_S < length * pairs.dt < 2 * _WINDOW_S
    if length == WindowSettings().length and not usual:
        log.info(
            "A window of %d steps lasts %.3g s in these recordings; settings are made for %g s:"
            " say data.time_step=%g, or change windows.length and windows.stride",
            length,
            length * pairs.dt,
            _WINDOW_S,
            _WINDOW_S / length,
        )
    if pairs.dt > COARSE_S:
        log.warning(
            "The time step is %.3g s: parameters calibrated in such steps are biased, since models"
            " are made for 0.1 s and less (at 1 s IDM's time gap comes out a quarter too short, s0"
            " 72 %% too large); say data.time_step=0.1, or the step of the simulation that they are"
            " for, or compare parameters of the same step only",
            pairs.dt,
        )
    return pairs, style


def compose(
    config: JobConfig, components: JobComponents, pairs: PairSet, style: StyleResult
) -> ProtocolContext:
    """Returns what the protocol works with."""
    bound = components.simulator.settings.memory_mb * 2**20
    require_memory(bound, f"simulator.memory_mb={components.simulator.settings.memory_mb}")
    device = choose_device(config.device)
    require_signals(components.policy, pairs)
    batch = PairBatch.of(pairs, dtype=getattr(torch, config.dtype), device=device)
    cache_folder: Path | str | None = None
    workspace = None
    if config.cache.enabled:
        cache_folder = config.cache.folder
        # Behind a URL there is no place for what a training writes every few seconds.
        folder = Path("outputs") / "training"
        if isinstance(cache_folder, Path):
            cache_folder = cache_folder.expanduser()
            folder = cache_folder / "training"
        workspace = Workspace(folder)
    solver = Solver(
        components.simulator.stepper(components.model, batch.dt),
        components.optimizer.with_effort(
            components.model.search_effort, len(components.model.space)
        ),
        config.seed,
        objective=components.objective,
        memory=bound,
        prior=prior_weight(config.calibration.prior),
        strength=prior_strength(config.calibration.prior),
        pooled_segment_s=config.calibration.pooled_segment_s,
    )
    reported = {}
    for entry in registry.entries("objective"):  # cfx's own and the chosen one
        if entry.distribution == OWN:
            made = registry.create("objective", {"name": entry.name})
            reported[entry.name] = cast(Objective, made)
    reported[config.objective["name"]] = components.objective
    calibrator = Calibrator(
        solver,
        cache=Cache(cache_folder),
        reported=reported,
        engine=components.engine,
    )
    return ProtocolContext(
        pairs=pairs,
        batch=batch,
        style=style,
        model_node=config.model,
        policy_node=config.policy,
        calibrator=calibrator,
        policy=components.policy.for_model(components.model, batch.dt, config.windows),
        learner=components.learner,
        windows=config.windows,
        split=config.split,
        workspace=workspace,
        metrics=components.metrics,
    )


def without_files(
    config: JobConfig, pairs: PairSet
) -> tuple[JobConfig, JobComponents, ProtocolContext]:
    """Returns what a protocol works with, where a job keeps no cache and writes nothing.

    Raises:
        CfxError: a setting is wrong, or what a component needs is not there.
    """
    config, components = prepare(config)
    pairs, style = select_pairs(pairs, config)
    uncached = JobConfig.of({**config.model_dump(), "cache": {"enabled": False}})
    return config, components, compose(uncached, components, pairs, style)


def find(context: ProtocolContext, components: JobComponents, config: JobConfig) -> Result:
    """Runs the protocol; returns what it has delivered, with tables of the calibration.

    Raises:
        PluginError: it delivers no `ProtocolResult`.
    """
    with closing(context.stepper), closing(components.engine):
        delivered: object = components.protocol.run(context)
        if not isinstance(delivered, ProtocolResult):
            raise PluginError(
                f"{registry.origin(components.protocol)}: run must return a"
                f" cfx.plugin.ProtocolResult, but returned a {type(delivered).__name__}"
            )
        purpose = Purpose.of(components.model, components.policy)
        evaluation = replace(delivered.evaluation, purpose=purpose).distinct_methods()
        tables = calibration_tables(context, evaluation, config.calibration)
    if "slices" in tables:
        evaluation = evaluation.with_slices(tables["slices"])
    evaluation = replace(
        evaluation,
        tables={**evaluation.tables, **tables, **job_tables(context, delivered, evaluation)},
        notes=delivered.notes,
        recorded=context.pairs,
        style=context.style,
    )
    metrics = {**evaluation.metrics(), **delivered.calibration}
    if delivered.labels is not None:
        metrics |= delivered.labels.metrics()
    return Result.of(
        evaluation,
        config=config.model_dump(mode="json"),
        data={**description(context, delivered, config, components), **noise_of(tables)},
        metrics=metrics,
        trained=delivered.policy,
    )


def job_tables(
    context: ProtocolContext, delivered: ProtocolResult, evaluation: Evaluation
) -> dict[str, pd.DataFrame]:
    """Returns the tables `curves`, `labels` and `sites`, what there is of them."""
    tables = {"curves": learning_curves(delivered.curves)}
    if delivered.labels is not None:
        tables["labels"] = delivered.labels.to_frame(context.pairs, evaluation.names)
    sites = site_table(context.pairs, evaluation)
    if sites is not None:
        tables["sites"] = sites
    return tables


def noise_of(tables: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Returns what `data.json` says of a posterior's noise: its kind, and the evidence of each."""
    if "noise" not in tables:
        return {}
    chosen = tables["noise"].query("chosen")["noise"].iloc[0]
    return {"noise": {"kind": chosen, "log_evidence": noise_evidence(tables)}}


def description(
    context: ProtocolContext,
    delivered: ProtocolResult,
    config: JobConfig,
    components: JobComponents,
) -> dict[str, Any]:
    """Returns what `data.json` says of the data and the job; the evaluation says the rest."""
    pairs = context.pairs
    dropped = []
    for drop in pairs.dropped:
        dropped.append({"reason": drop.reason, "count": drop.count, "unit": drop.unit})
    return {
        "source": pairs.source,
        "fingerprint": pairs.fingerprint,
        "pairs": len(pairs),
        "protocol": dict(delivered.notes),
        "dropped": dropped,
        "priors": [strength.to_json() for strength in context.calibrator.strengths],
        "objective": {**config.objective, "unit": components.objective.unit},
        "cfx": version(),
        "commit": commit(Path.cwd()),
    }
