"""One job, from the data to the figures.

A dataset gives pairs; an optimizer calibrates a driving model on them; a learner trains a policy on the result; a protocol
evaluates it; tracking keeps what came out.
"""

from __future__ import annotations

import functools
import json
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pandas as pd
import torch
import yaml
from rich.console import Console
from rich.table import Table

from cfx import registry, renamed
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.settings import WindowSettings
from cfx.config import JobConfig
from cfx.datasets.base import Dataset
from cfx.datasets.tidy import write_tidy
from cfx.errors import ConfigError, DataError, OutputError, PluginError
from cfx.evaluation.result import Evaluation, Improvement
from cfx.files import atomic_write
from cfx.learners.base import Learner
from cfx.learners.curves import best_losses
from cfx.models.base import DrivingModel
from cfx.models.vtype import SumoOnly
from cfx.optimizers.base import Optimizer
from cfx.pairs import PairBatch, PairSet
from cfx.policies.base import Policy
from cfx.policies.trained import TrainedPolicy
from cfx.progress import Task
from cfx.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.simulation.base import BaseSimulator
from cfx.simulation.rollout import Simulator
from cfx.simulation.settings import SumoSettings
from cfx.style.entropy import measure_style, select_cluster
from cfx.style.result import StyleResult
from cfx.tracking.provenance import version
from cfx.tracking.store import folder_of, is_run_id

if TYPE_CHECKING:
    from cfx.tracking.tracker import Tracker

log = logging.getLogger(__name__)

_TRACKED = (
    "config.yaml",
    "metrics.json",
    "pairs.csv",
    "style.csv",
    "data.json",
    "trajectories.parquet",
    "curves.parquet",
)
"""Files of a job's folder that MLflow keeps too, besides its figures and its policy."""

_WINDOW_S = 0.5
"""How long a window is in the paper and lasts with default settings at NGSIM's 0.1 s."""


@dataclass(frozen=True)
class JobResult:
    """What a job leaves behind; `cfx.load` reads it back from the job's folder.

    Attributes:
        metrics: under their MLflow names; NaN where a metric is not defined.
        pairs: a row per pair and method.
        policy: the policy that drove, ready to drive again.
        figures: the figures' files.
        folder: the job's output folder.
        run_id: MLflow's id of the run; "" if it was not tracked.
    """

    metrics: dict[str, float]
    pairs: pd.DataFrame
    policy: TrainedPolicy
    figures: tuple[Path, ...]
    folder: Path
    run_id: str = ""
    evaluation: Evaluation | None = field(default=None, repr=False)
    style: StyleResult | None = field(default=None, repr=False)


def run_job(config: JobConfig, folder: Path, console: Console | None = None) -> JobResult:
    """Runs one job and writes its results into `folder`.

    Args:
        config: the validated configuration.
        folder: the job's output folder; made if it is not there.
        console: where the table goes; stdout unless given.

    Raises:
        CfxError: the user's mistake, in one sentence; nothing half-written is left.
    """
    from cfx.tracking.tracker import Tracker

    console = console or Console()
    device = _device(config.device)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    protocol = _protocol(config)
    config = _settled(config, protocol)
    parts = _Parts.of(config, protocol)
    _writable(folder)
    _write(folder / "config.yaml", yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    with Tracker.open(config, folder) as tracker:
        pairs, style = _pairs(parts.dataset, config)
        if config.demo.enabled:
            from cfx.sumo.demo import check_demo

            check_demo(config.demo, pairs)
        tracker.set_tags(
            {
                "dataset.fingerprint": pairs.fingerprint,
                "dataset.source": pairs.source,
                "dataset.pairs": str(len(pairs)),
            }
        )
        context = _context(config, parts, pairs, style, device)
        with closing(context.simulator):
            protocol_result = _protocol_result(parts.protocol, context)
        result = _keep(
            config,
            folder,
            pairs,
            style,
            protocol_result,
            tracker,
            has_constant_baseline=parts.model.has_constant_baseline,
        )
    report(
        result,
        protocol_result.evaluation,
        console,
        tracker,
        has_constant_baseline=parts.model.has_constant_baseline,
    )
    return result


@dataclass(frozen=True)
class _Parts:
    """The components of a job; making them checks the whole configuration before any work begins.

    The registry has checked that each is what its kind promises.
    """

    dataset: Dataset
    model: DrivingModel
    optimizer: Optimizer
    policy: Policy
    learner: Learner
    protocol: Protocol

    @classmethod
    def of(cls, config: JobConfig, protocol: Protocol) -> _Parts:
        model = cast(DrivingModel, registry.create("model", config.model))
        check_simulator(config, model)
        learner = cast(Learner, registry.create("learner", config.learner))
        policy = cast(Policy, registry.create("policy", config.policy))
        learner.require_gradients(model, not isinstance(config.simulator, SumoSettings))
        if "policy" not in protocol.determines():  # or it has learned already
            learner.require_no_driver_features(policy)
        return cls(
            dataset=cast(Dataset, registry.create("dataset", config.data)),
            model=model,
            optimizer=cast(Optimizer, registry.create("optimizer", config.optimizer)),
            policy=policy,
            learner=learner,
            protocol=protocol,
        )


def _protocol(config: JobConfig) -> Protocol:
    """Returns the protocol, for which ids of MLflow runs have become folders.

    Raises:
        ConfigError: a setting is wrong.
        TrackingError: there is no such run.
    """
    node = dict(config.protocol)
    if isinstance(name := node.get("name"), str):
        for setting in cast(type[Protocol], registry.get("protocol", name)).jobs:
            if is_run_id(given := str(node.get(setting))):
                node[setting] = folder_of(given, config.tracking.uri)
    return cast(Protocol, registry.create("protocol", node))


def _settled(config: JobConfig, protocol: Protocol) -> JobConfig:
    """Returns the configuration with what the protocol determines of it."""
    determined = protocol.determines()
    if not determined:
        return config
    named = ", ".join(
        f"{key}={value['name']}" if "name" in value else key for key, value in determined.items()
    )
    log.info("The protocol determines %s", named)
    return JobConfig.of({**config.model_dump(), **determined})


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        found = torch.cuda.device_count()
        raise ConfigError(
            f"device={name}: PyTorch finds {found} CUDA devices here; write device=cpu or device=auto"
        )
    return device


def _pairs(dataset: Dataset, config: JobConfig) -> tuple[PairSet, StyleResult]:
    pairs = dataset.load()
    log.info(
        "%d pairs of %d drivers from %s",
        len(pairs),
        len({pair.driver for pair in pairs}),
        pairs.source,
    )
    style = measure_style(pairs, config.style)
    pairs = select_cluster(pairs, style, config.style.cluster)
    for drop in pairs.dropped:
        log.info("Left out: %d %s (%s)", drop.count, drop.unit, drop.reason)
    length, lasts = config.windows.length, config.windows.length * pairs.dt
    if length == WindowSettings().length and not 0.5 * _WINDOW_S < lasts < 2 * _WINDOW_S:
        log.info(
            "A window of %d steps lasts %.3g s in these recordings; settings are made for %g s: say data.time_step=%g, or change"
            " windows.length and windows.stride",
            length,
            lasts,
            _WINDOW_S,
            _WINDOW_S / length,
        )
    return pairs, style


def _context(
    config: JobConfig, parts: _Parts, pairs: PairSet, style: StyleResult, device: torch.device
) -> ProtocolContext:
    batch = PairBatch.of(pairs, dtype=getattr(torch, config.dtype), device=device)
    simulator = make_simulator(config, parts.model, batch.dt)
    calibrator = Calibrator(
        simulator,
        parts.optimizer,
        seed=config.seed,
        cache=Cache(Path(config.cache.folder).expanduser() if config.cache.enabled else None),
        memory=config.simulation.memory_mb * 2**20,
        progress=Task,
    )
    return ProtocolContext(
        pairs=pairs,
        batch=batch,
        style=style,
        simulator=simulator,
        model_node=config.model,
        policy_node=config.policy,
        calibrator=calibrator,
        policy=parts.policy,
        learner=parts.learner,
        windows=config.windows,
        split=config.split,
        seed=config.seed,
        workspace=Path(config.cache.folder).expanduser() / "training"
        if config.cache.enabled
        else None,
    )


def check_simulator(config: JobConfig, model: DrivingModel) -> None:
    """Checks that the chosen simulator can drive a model, before any work begins.

    Raises:
        ConfigError: it cannot; says what to choose.
        SumoError: SUMO is not installed, or another version.
    """
    if isinstance(config.simulator, SumoSettings):
        from cfx.sumo.simulator import require_in_sumo

        require_in_sumo(model)
    elif isinstance(model, SumoOnly):
        name = config.model.get("name")
        raise ConfigError(
            f"model={name} has no equations in Python, SUMO alone drives it; add simulator=sumo"
        )


def make_simulator(config: JobConfig, model: DrivingModel, dt: float) -> BaseSimulator:
    """Returns the simulator that a configuration chooses."""
    if isinstance(config.simulator, SumoSettings):
        from cfx.sumo.simulator import SumoSimulator

        return SumoSimulator(model, dt, config.simulator)
    return Simulator(model, dt, compile=config.simulation.compile)


def _protocol_result(protocol: Protocol, context: ProtocolContext) -> ProtocolResult:
    protocol_result: object = protocol.run(context)
    if not isinstance(protocol_result, ProtocolResult):
        raise PluginError(
            f"{registry.origin(protocol)}: run must return a cfx.ProtocolResult, but returned a {type(protocol_result).__name__}"
        )
    return protocol_result


def _keep(
    config: JobConfig,
    folder: Path,
    pairs: PairSet,
    style: StyleResult,
    protocol_result: ProtocolResult,
    tracker: Tracker,
    *,
    has_constant_baseline: bool,
) -> JobResult:
    """Writes everything into the folder, then into MLflow."""
    evaluation = protocol_result.evaluation
    of_training = (
        protocol_result.labels.metrics() if protocol_result.labels is not None else {}
    ) | best_losses(protocol_result.curves)
    metrics = renamed.Metrics(evaluation.metrics() | of_training)
    written = _Output(folder)
    written.file("pairs.csv", lambda path: evaluation.table.to_csv(path, index=False))
    written.file(
        "trajectories.parquet",
        lambda path: evaluation.trajectories_table().to_parquet(path, index=False),
    )
    written.file(
        "curves.parquet", lambda path: _curves(protocol_result.curves).to_parquet(path, index=False)
    )
    written.file("style.csv", lambda path: style.table.to_csv(path, index=False))
    if protocol_result.labels is not None:
        labels = protocol_result.labels.to_frame(pairs, evaluation.names)
        written.file("labels.parquet", lambda path: labels.to_parquet(path, index=False))
    if any(pair.truth for pair in pairs):
        written.file("data.parquet", lambda path: write_tidy(pairs, path))
    further = _further(evaluation, written)
    written.run(lambda: protocol_result.policy.save(folder / "policy"))
    figures: list[Path] = []
    if config.figures.enabled:
        from cfx.figures.write import write_figures

        written.run(
            lambda: figures.extend(
                write_figures(folder / "figures", evaluation, style, protocol_result.curves)
            )
        )
    demo: list[Path] = []
    if config.demo.enabled:
        from cfx.sumo.demo import write_demo

        saved = folder / "policy"
        written.run(
            lambda: demo.extend(
                write_demo(
                    folder / "sumo", saved, pairs, protocol_result.policy, evaluation, config
                )
            )
        )
    provenance = {
        "source": pairs.source,
        "fingerprint": pairs.fingerprint,
        "pairs": len(pairs),
        "protocol": dict(protocol_result.notes),
        "dropped": [
            {"reason": drop.reason, "count": drop.count, "unit": drop.unit}
            for drop in pairs.dropped
        ],
        "parameters": [
            {"name": name, "unit": unit, "low": float(low), "high": float(high)}
            for name, unit, low, high in zip(
                evaluation.names, evaluation.units, *evaluation.bounds, strict=True
            )
        ],
        "has_constant_baseline": has_constant_baseline,
        "cfx": version(),
    }
    written.file("data.json", lambda path: _dump(provenance, path))
    defined = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    # Last in the folder, so that a folder with a metrics.json is complete; before MLflow, so that no failure there loses it.
    written.file("metrics.json", lambda path: _dump(defined, path))
    tracker.log_evaluation(evaluation)
    tracker.log_metrics(of_training)
    tracker.log_curves(protocol_result.curves)
    tracker.log_figures(figures)
    tracker.log_policy(folder / "policy")
    tracker.log_files([*(folder / name for name in _TRACKED), *further, *demo])
    return JobResult(
        metrics,
        evaluation.table,
        protocol_result.policy,
        tuple(figures),
        folder,
        tracker.run_id,
        evaluation,
        style,
    )


def _further(evaluation: Evaluation, written: _Output) -> list[Path]:
    """Writes the tables that only some protocols deliver; returns their paths. Those that an earlier job left there go."""
    platoon = evaluation.platoon.table if evaluation.platoon is not None else None
    paths = []
    for name, table in {"platoon.parquet": platoon, "history.parquet": evaluation.history}.items():
        path = written.folder / name
        if table is None:
            written.run(functools.partial(path.unlink, missing_ok=True))
        else:
            written.file(name, functools.partial(table.to_parquet, index=False))
            paths.append(path)
    return paths


def report(
    result: JobResult,
    evaluation: Evaluation,
    console: Console,
    tracker: Tracker,
    *,
    has_constant_baseline: bool = True,
) -> None:
    """Prints the table, where the results are and how to open them; `has_constant_baseline` as `DrivingModel.has_constant_baseline`."""
    table = Table(
        title=f"{len(evaluation.drives)} pair{'s' * (len(evaluation.drives) != 1)}, test part in closed loop",
        title_justify="left",
    )
    m = result.metrics
    columns = {"RMSE speed [m/s]": "rmse_speed", "RMSE gap [m]": "rmse_gap"}
    if evaluation.full_trajectory_improvements:
        columns |= {
            "whole speed [m/s]": "full_trajectory/rmse_speed",
            "whole gap [m]": "full_trajectory/rmse_gap",
        }
    table.add_column("method")
    for heading in (*columns, "collisions"):
        table.add_column(heading, justify="right")
    for method in evaluation.methods:
        values = [
            f"{m[f'{key}/{method}']:.3f}" if f"{key}/{method}" in m else ""
            for key in columns.values()
        ]
        table.add_row(method, *values, f"{m[f'collisions/{method}']:.0f}")
    console.print(table)
    if not has_constant_baseline:
        text = "With constant parameters the model follows no leader: compare the policy's RMSE with other jobs'."
        console.print(text, soft_wrap=True)
    else:
        _tell(evaluation.improvement, "fixed", console)
        if "fixed" in evaluation.steady_improvements:
            _tell(evaluation.steady_improvements["fixed"], "fixed beyond the first 5 s", console)
        if "shrunk" in evaluation.improvements:
            _tell(
                evaluation.improvements["shrunk"],
                "shrunk (own, shrunk towards the default)",
                console,
            )
        if "population" in evaluation.improvements:
            _tell(evaluation.improvements["population"], "population", console)
        if "population" in evaluation.full_trajectory_improvements:
            _tell(
                evaluation.full_trajectory_improvements["population"],
                "population on whole drives",
                console,
            )
    _warn(evaluation, m, console)
    console.print(f"Results: {result.folder}", soft_wrap=True, highlight=False)
    for line in tracker.how_to_open():
        console.print(line, soft_wrap=True, highlight=False)


def _tell(i: Improvement, baseline: str, console: Console) -> None:
    known = math.isfinite(i.ci95_low)
    interval = (
        f"95 % interval {i.ci95_low:+.1%} to {i.ci95_high:+.1%}"
        if known
        else "no interval: it needs two drivers"
    )
    console.print(
        f"Improvement of policy over {baseline}, RMSE of speed: mean {i.mean:+.1%} ({interval}), trimmed mean"
        f" {i.trimmed_mean:+.1%}, median {i.median:+.1%}; better for {i.win_rate:.0%} of {i.pairs}"
        f" {'pair' if i.pairs == 1 else 'pairs'}; Wilcoxon p = {i.p_value:.2g}",
        soft_wrap=True,
        highlight=False,
    )
    if i.undefined:
        console.print(
            f"{i.undefined} pairs have no improvement: a drive diverged, or {baseline} drives without any error."
        )


def _warn(evaluation: Evaluation, metrics: Mapping[str, float], console: Console) -> None:
    """Prints a line about what is not safe or not free in what was driven; nothing if there is nothing."""

    def listed(name: str, least: float, form: str) -> str:
        found = {method: metrics.get(f"{name}/{method}", 0.0) for method in evaluation.methods}
        return ", ".join(
            f"{method} {value:{form}}" for method, value in found.items() if value >= least
        )

    braking, stuck = listed("hard_braking", 1, ".0f"), metrics.get("at_bounds/policy", 0.0) >= 0.01
    said = [f"Frames with an acceleration below -8 m/s2: {braking}."] if braking else []
    said += [f"Parameters at their bounds: {listed('at_bounds', 0.01, '.0%')}."] if stuck else []
    if said:
        console.print(" ".join(said), soft_wrap=True, highlight=False)


def _curves(curves: pd.DataFrame) -> pd.DataFrame:
    """Returns learning curves with the same column types whether anything was learned or not."""
    return curves.astype(
        {"network": str, "epoch": "int64", "train_loss": float, "validation_loss": float}
    )


def load(folder_or_run: str | Path) -> JobResult:
    """Reads a finished job back.

    Args:
        folder_or_run: a job's output folder, or the id of its MLflow run.

    Raises:
        DataError: there is no finished job.
    """
    folder = folder_of(folder_or_run)
    try:
        defined = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        pairs = pd.read_csv(folder / "pairs.csv", dtype={"leader_id": str, "follower_id": str})
        pairs = renamed.results(pairs)
    except (OSError, ValueError, KeyError) as error:
        raise DataError(
            f"{folder} holds no finished job ({error}); give the output folder that a job printed"
        ) from error
    metrics = renamed.metrics(
        {name: math.nan if value is None else float(value) for name, value in defined.items()}
    )
    figures = tuple(sorted((folder / "figures").glob("*.png")))
    return JobResult(metrics, pairs, TrainedPolicy.load(folder / "policy"), figures, folder)


class _Output:
    """Writes a job's files; each appears whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, name: str, write: Callable[[Path], object]) -> None:
        def write_whole() -> None:
            with atomic_write(self.folder / name) as temporary:
                write(temporary)

        self.run(write_whole)

    def run(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            raise OutputError(
                f"cannot write into {self.folder}: {error.strerror or error}; the calibration is cached, so run again"
            ) from error


def _dump(values: Mapping[str, Any], path: Path) -> None:
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _write(path: Path, text: str) -> None:
    _Output(path.parent).file(
        path.name, lambda temporary: temporary.write_text(text, encoding="utf-8")
    )


def _writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the output folder {folder}: {error.strerror}; set hydra.run.dir to a place that can be written"
        ) from error
