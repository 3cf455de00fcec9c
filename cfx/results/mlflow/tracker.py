"""A job's run in MLflow."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import re
import shlex
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import quote, urlencode

import numpy as np
import pandas as pd

from cfx.core.distributions import OWN
from cfx.data.pairs import PairSet
from cfx.errors import CfxError, TrackingError
from cfx.evaluation.headline import (
    DEFAULT_ERROR,
    ERROR,
    RESULT,
    TESTED,
    fitted_errors,
    headline,
    with_unit,
)
from cfx.evaluation.result import Purpose
from cfx.learners.curves import over_networks
from cfx.results import provenance
from cfx.results.folder import CONFIG, DATA, METRICS, typed_overrides
from cfx.results.mlflow.store import Store, open_store, tracking_uri, translate_errors
from cfx.results.table import file_of, installed
from cfx.results.tracker import Tracker

if TYPE_CHECKING:
    from cfx.results.config import JobConfig
    from cfx.results.result import Result

log = logging.getLogger(__name__)

CURVE_POINTS = 200
"""Most points that a learning curve has in MLflow; its first and last epoch are among them."""

_PARAMETER_LENGTH = 6000  # MLflow's limit for a parameter's value
_TAG_LENGTH = 5000  # what MLflow's servers of every version take
_KEY_LENGTH = 250
_DATASET_NAME = 500  # MLflow's limit for a dataset's name
_EXAMPLE_FRAMES = 50
"""Frames of a model's input example."""

_NAMED = ("data", "model", "policy", "optimizer", "objective", "learner", "protocol")
"""Groups whose choices are tags of a run."""

_SERVED = Path(__file__).with_name("served_policy.py")


class MlflowTracker(Tracker):
    """Keeps everything in one MLflow run.

    Attributes:
        store: the opened store.
        run_id: MLflow's id of the run.
        link: of the run's page, behind the server's address.
        model_uri: address of the logged policy, "" before there is one.
    """

    def __init__(
        self,
        store: Store,
        run_id: str,
        name: str,
        sweep: str | None,
        parent_id: str | None,
        plugins: Mapping[str, str],
        data: str,
    ) -> None:
        self.store = store
        self.run_id = run_id
        self.model_uri = ""
        self.link = (
            f"#/experiments/{store.experiment_id}/runs/{run_id}?workflowType=machine_learning"
        )
        self._sweep = sweep
        self._parent_id = parent_id
        self._plugins = plugins
        self._model_name = re.sub(r"[^\w -]", "-", name) or "policy"
        self._data = data

    @classmethod
    @contextmanager
    def of_job(cls, config: JobConfig, folder: Path) -> Iterator[Self]:
        """Opens the run of a job; as `cfx.results.tracker.Tracking.run`."""
        values = config.model_dump(mode="json")
        names = {kind: str(values[kind].get("name", "")) for kind in _NAMED}
        plugins = provenance.distributions(values)
        every_plugin = {**plugins, **provenance.named_distributions(values)}
        tags = {
            **provenance.plugin_tags(every_plugin),
            **names,
            "style.cluster": config.style.cluster,
            "seed": str(config.seed),
            "cfx.folder": str(folder.absolute()),
        }
        with cls.run(
            tracking_uri(config.tracking.uri),
            experiment=config.tracking.experiment,
            run_name=_run_name(config, names),
            parameters=_parameters(values, _compared(config, names), folder),
            whole=values,
            tags=tags,
            plugins=plugins,
            sweep=config.tracking.sweep,
        ) as tracker:
            yield tracker

    @classmethod
    @contextmanager
    def run(
        cls,
        uri: str,
        *,
        experiment: str = "cfx",
        run_name: str,
        parameters: Mapping[str, str],
        whole: Mapping[str, Any] | None = None,
        tags: Mapping[str, str] | None = None,
        plugins: Mapping[str, str] | None = None,
        sweep: str | None = None,
    ) -> Iterator[Self]:
        """Opens a run and closes it however its body ends.

        Its status is FINISHED, KILLED on Ctrl-C or exit, else FAILED; the reason is a tag.

        Args:
            uri: of the store, absolute.
            parameters: what the run is compared by; too long values are cut, and marked as cut.
            whole: the whole configuration, by which the same job is known; None: `parameters`.
            tags: shown in the table of runs, which can be grouped by them.
            plugins: distribution -> version.
            sweep: name that the jobs of a multirun share; they get a common parent run.

        Raises:
            TrackingError: the store cannot be used.
        """
        store = open_store(uri, experiment)
        cleaned = _clean_parameters(parameters)
        all_tags = {
            **provenance.git_state(Path.cwd()),
            **provenance.plugin_tags(plugins or {}),
            **provenance.process_tags(),
            "cfx.version": provenance.version(),
            "cfx.app.job": _fingerprint(whole or cleaned, tags or {}),
            "mlflow.source.name": "cfx",
            "mlflow.source.type": "LOCAL",
            "mlflow.user": provenance.user(),
            **(tags or {}),
        }
        with store.locked(), translate_errors("begin the run"):
            close_abandoned(store)
            parent_id = None
            if sweep is not None:
                parent_id = _sweep_parent(store, sweep)
                all_tags |= {"cfx.sweep": _safe(sweep), "mlflow.parentRunId": parent_id}
            run_id = _begin(store, run_name, cleaned, all_tags)
            if sweep is not None:
                _replace_earlier(store, run_id, all_tags)
        data = (tags or {}).get("data", "")
        tracker = cls(store, run_id, run_name, sweep, parent_id, plugins or {}, data)
        try:
            yield tracker
        except BaseException as error:
            tracker._end_badly(error)
            raise
        tracker._end("FINISHED")

    def set_tags(self, tags: Mapping[str, str]) -> None:
        with translate_errors("log tags"):
            self.store.client.log_batch(self.run_id, tags=_tags(tags))

    def log_job(self, result: Result, description: str) -> None:
        folder, pairs = result.folder, result.evaluation.recorded
        assert folder is not None
        assert pairs is not None
        values, words = headline(result.metrics, result.judge)
        self.log_metrics({**values, **_fitted(result), **_of_plugins(result)})
        tags = {
            RESULT: words,
            ERROR: with_unit(result.judge.name, result.judge.unit),
            TESTED: _tested(result),
            "mlflow.note.content": description,
        }
        is_calibration = result.purpose is Purpose.CALIBRATION
        if is_calibration:
            tags["learner"] = "none"
        self.set_tags(tags)
        self.log_data(pairs)
        self.log_curves(result.evaluation.tables["curves"])
        self.log_files(result.figures, "figures")
        if is_calibration:
            self.log_files(sorted((folder / "policy").iterdir()), "policy")
        else:
            self.log_policy(folder / "policy", pairs)
        files = [folder / CONFIG, folder / METRICS, folder / DATA, *result.demo]
        for table in installed():
            if table.name in result.tables and table.component.tracked:
                files.append(folder / file_of(table))
                if table.component.tracked == "table" and not table.component.large:
                    self.log_table(result.tables[table.name], f"{table.name}.json")
        self.log_files(files)

    def log_metrics(self, metrics: Mapping[str, float]) -> None:
        """Logs metrics without steps."""
        self._log_metrics([(name, value, 0) for name, value in metrics.items()])

    def log_data(self, pairs: PairSet) -> None:
        """Logs which recordings the job used, as MLflow's dataset of the run."""
        from mlflow.entities import Dataset, DatasetInput, InputTag

        profile = {
            "pairs": len(pairs),
            "drivers": len(set(pairs.drivers)),
            "frames": pairs.frames,
            "time_step_s": pairs.dt,
            "fingerprint": pairs.fingerprint,
        }
        dataset = Dataset(
            name=_dataset_name(self._data, Path(pairs.source).name),
            digest=pairs.fingerprint[:8],
            source_type="local",
            source=json.dumps({"uri": pairs.source}),
            profile=json.dumps(profile),
        )
        tags = [InputTag("mlflow.data.context", "calibration and test")]
        with translate_errors("log the dataset"):
            self.store.client.log_inputs(self.run_id, [DatasetInput(dataset, tags)])

    def log_curves(self, curves: pd.DataFrame) -> None:
        """Logs `train_loss` and `validation_loss`, means over the networks, by epoch.

        At most `CURVE_POINTS` of each are logged.

        Args:
            curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; may be empty.
        """
        points = []
        for column in ("train_loss", "validation_loss") if len(curves) else ():
            means = over_networks(curves, column).mean(axis=1)
            logged = np.unique(
                np.linspace(0, len(means) - 1, min(CURVE_POINTS, len(means))).round().astype(int)
            )
            for k in logged:
                points.append((column, float(means.iloc[k]), int(means.index[k])))
        self._log_metrics(points)

    def log_table(self, table: pd.DataFrame, name: str) -> None:
        """Logs a table that MLflow's pages show as one; one of the same name is replaced.

        Args:
            name: ends in `.json`.
        """
        client = self.store.client
        with translate_errors(f"log the table {name}"):
            if name in {file.path for file in client.list_artifacts(self.run_id)}:
                # MLflow would append the rows to those of a job that was broken off.
                text = table.to_json(orient="split", index=False)
                client.log_text(self.run_id, text, name)
            else:
                client.log_table(self.run_id, table, name)

    def log_files(self, paths: Sequence[Path], place: str | None = None) -> None:
        """Logs files at the top of the run's artifacts, or in a folder there."""
        for path in paths:
            with translate_errors(f"log {path}"):
                self.store.client.log_artifact(self.run_id, str(path), place)

    def log_policy(self, folder: Path, example: PairSet | None = None) -> None:
        """Logs a saved policy as a model.

        `mlflow.pyfunc.load_model(tracker.model_uri).predict(frame)` uses it.

        Args:
            folder: what `Agent.save` wrote.
            example: pairs of which a few seconds show what the model takes; with them the model has
                a signature and an input example.
        """
        if not folder.is_dir():
            raise TrackingError(f"{folder} holds no policy to log")
        self.log_files(sorted(folder.iterdir()), "policy")
        with (
            translate_errors("log the policy as a model"),
            tempfile.TemporaryDirectory() as temporary,
        ):
            import mlflow
            from mlflow.entities import LoggedModelOutput
            from mlflow.models import Model

            client = self.store.client
            model = client.create_logged_model(
                self.store.experiment_id,
                name=self._model_name,
                source_run_id=self.run_id,
                model_type="cfx policy",
            )
            path = Path(temporary) / "model"
            mlflow.pyfunc.save_model(
                path,
                python_model=str(_SERVED),
                artifacts={"policy": str(folder.absolute())},
                **_example(folder, example),
                pip_requirements=[
                    f"cfx-driving=={provenance.version()}",
                    *(f"{name}=={version}" for name, version in self._plugins.items()),
                ],
                mlflow_model=Model(
                    artifact_path=model.artifact_location,
                    run_id=self.run_id,
                    model_uuid=model.model_id,
                    model_id=model.model_id,
                ),
            )
            client.log_model_artifacts(model.model_id, str(path))
            client.finalize_logged_model(model.model_id, "READY")
            client.log_outputs(self.run_id, [LoggedModelOutput(model.model_id, step=0)])
            self.model_uri = f"models:/{model.model_id}"

    def how_to_open(self) -> tuple[str, ...]:
        if self._sweep is not None:
            return ()  # the sweep says it once, at its end
        address, first = _address(self.store.uri)
        if first:
            return (f"{first[0]}, then {address}/{self.link}",)
        return (f"MLflow: {address}/{self.link}",)

    def _log_metrics(self, points: Sequence[tuple[str, float, int]]) -> None:
        from mlflow.entities import Metric

        now = round(1000 * time.time())
        metrics = [Metric(name, value, now, step) for name, value, step in points]
        with translate_errors("log metrics"):
            for first in range(0, len(metrics), 1000):  # MLflow's limit for a batch
                self.store.client.log_batch(self.run_id, metrics=metrics[first : first + 1000])

    def _end_badly(self, error: BaseException) -> None:
        """Closes the run after an error.

        The user must see that error, so a failure to close the run is only logged.
        """
        killed = not isinstance(error, Exception)  # Ctrl-C, SIGTERM, exit
        status = "KILLED" if killed else "FAILED"
        text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
        try:
            self._end(status, text)
        except TrackingError as second:
            log.warning("%s", second)

    def _end(self, status: str, reason: str = "") -> None:
        with translate_errors("close the run"):
            if reason:
                self.store.client.log_batch(self.run_id, tags=_tags({"cfx.failure": reason}))
            if status == "FINISHED" and self._sweep is not None:
                _remove_repeated(self.store, self.run_id)
            self.store.client.set_terminated(self.run_id, status)
            if self._parent_id is not None and self._sweep is not None:
                with self.store.locked():
                    _settle(self.store, self._parent_id, _safe(self._sweep))


def _fitted(result: Result) -> dict[str, float]:
    """Returns the errors of driver-specific parameters where they were calibrated, if known."""
    if "fits" not in result.tables:
        return {}
    fits = result.tables["fits"]
    means = fits[fits["method"] == "driver_specific"].mean(numeric_only=True)
    means.index = means.index.astype(str).str.removeprefix("train_")
    return fitted_errors(dict(means))


def _tested(result: Result) -> str:
    """Returns what names the frames that were tested: jobs with another name do not compare."""
    if not len(result.pairs):
        return ""
    tested = result.pairs.drop_duplicates("pair_id")[["pair_id", "frames"]].sort_values("pair_id")
    digest = hashlib.sha256(tested.to_csv(index=False).encode()).hexdigest()[:8]
    return f"{len(tested)} pairs, {digest}"


def _compared(config: JobConfig, names: Mapping[str, str]) -> dict[str, str]:
    """Returns the chosen components; a calibration has no learner, whatever the group says."""
    return {**names, "learner": "none"} if config.is_calibration else dict(names)


def _parameters(
    values: Mapping[str, Any], names: Mapping[str, str], folder: Path
) -> dict[str, str]:
    """Returns what runs are compared by: the chosen components, the seed and what was typed.

    The whole configuration is a file of the run. What was typed of tracking, and where Hydra
    writes, says nothing of the job.
    """
    parameters = {**names, "seed": str(values.get("seed", ""))}
    flat = provenance.flatten(values)
    for override in typed_overrides(folder) or ():
        key = override.partition("=")[0].lstrip("+~")
        if key in flat and not key.startswith(("tracking.", "output.")):
            parameters[key] = flat[key]
    return parameters


def _of_plugins(result: Result) -> dict[str, float]:
    """Returns the headline metrics that plugins bring, of the method that the job is judged by."""
    values = {}
    for metric in result.known_metrics:
        value = result.metric(metric.name, result.judged)
        is_new = metric.distribution != OWN and metric.name != result.judge.name
        if metric.headline and is_new and math.isfinite(value):
            values[with_unit(metric.name, metric.unit)] = value
    return values


def _run_name(config: JobConfig, names: Mapping[str, str]) -> str:
    """Returns what a run is called: its components; in a sweep, whose jobs have many, its seed.

    What differs most often comes first: MLflow's tables cut names off.
    """
    parts = [names["model"]]
    if not config.is_calibration:
        parts.append(names["policy"])
    if config.tracking.sweep is not None:
        parts.append(f"seed{config.seed}")
    return "-".join([*parts, names["optimizer"], names["data"]])


def _dataset_name(name: str, source: str) -> str:
    """Returns what MLflow calls the recordings: the dataset's name and the file's."""
    if source.startswith(name):
        return source[:_DATASET_NAME]
    return f"{name}: {source}"[:_DATASET_NAME]


def _example(folder: Path, pairs: PairSet | None) -> dict[str, Any]:
    """Returns the signature and the input example of a saved policy; {} without pairs."""
    if pairs is None or not len(pairs):
        return {}
    from mlflow.models import ModelSignature
    from mlflow.types.schema import AnyType, ColSpec, Schema

    from cfx.data.tidy import frame_of
    from cfx.policies import checkpoint
    from cfx.policies.prediction import predict_frame

    first = replace(pairs[0].beginning(_EXAMPLE_FRAMES), truth={}, truth_model="")
    frame = frame_of(PairSet((first,), pairs.source))
    try:
        answer = predict_frame(checkpoint.load_agent(folder), frame)
    except CfxError as error:
        log.info("The policy has no input example in MLflow: %s", error)
        return {}
    # MLflow would refuse a whole number where a signature says a float, and a number where it says
    # a text; the table's own checks convert both.
    anything = AnyType()  # type: ignore[no-untyped-call]  # MLflow's
    inputs: list[Any] = [ColSpec(anything, str(name)) for name in frame]
    outputs: list[Any] = [ColSpec("string", "pair_id")]
    for name in answer.columns[1:]:
        outputs.append(ColSpec("double", str(name)))
    signature = ModelSignature(Schema(inputs), Schema(outputs))
    return {"signature": signature, "input_example": frame}


def common_error(runs: Sequence[Any]) -> str:
    """Returns the metric by which runs are sorted: what all minimised, else the RMSE of speed."""
    errors = {run.data.tags.get(ERROR) for run in runs}
    errors.discard(None)  # of runs that did not end
    return errors.pop() if len(errors) == 1 else DEFAULT_ERROR


def sweep_link(experiment_id: str, sweep: str, error: str = DEFAULT_ERROR) -> str:
    """Returns the part of the address behind the server's that shows the jobs of a sweep.

    They stand side by side, the smallest error first.
    """
    query = {
        "searchFilter": f"tags.`cfx.sweep` = '{_safe(sweep)}'",
        # Sorted by date, MLflow's page would fold the jobs away under their parent, and draw no
        # charts.
        "orderByKey": f"metrics.`{error}`",
        "orderByAsc": "true",
        "compareRunsMode": "CHART",
        "workflowType": "machine_learning",
    }
    return f"#/experiments/{experiment_id}/runs?" + urlencode(query, quote_via=quote)


def end_sweep(uri: str, experiment: str, sweep: str) -> tuple[str, ...]:
    """Closes the runs that killed jobs left open, and settles the status of the sweep's parent run.

    Args:
        uri: of the store, absolute.
        sweep: the name that the jobs share.

    Returns:
        Lines that tell a user where to look; none if no job of the sweep was tracked.

    Raises:
        TrackingError: the store cannot be used.
    """
    store = open_store(uri, experiment)
    with store.locked(), translate_errors("close the sweep"):
        close_abandoned(store)
        parents = store.client.search_runs(
            [store.experiment_id], f"tags.`cfx.sweep_parent` = '{_safe(sweep)}'", max_results=1
        )
        if not parents:
            return ()
        _settle(store, str(parents[0].info.run_id), _safe(sweep))
        chosen = f"tags.`cfx.sweep` = '{_safe(sweep)}'"
        jobs = store.client.search_runs([store.experiment_id], chosen, max_results=1000)
        link = sweep_link(store.experiment_id, sweep, common_error(jobs))
        note = f"[All jobs of this sweep]({link})"
        store.client.set_tag(str(parents[0].info.run_id), "mlflow.note.content", note)
    address, first = _address(store.uri)
    return (*first, f"All jobs of this sweep: {address}/{link}")


def _begin(store: Store, name: str, parameters: Mapping[str, str], tags: Mapping[str, str]) -> str:
    """Makes the run, or takes up the one that the same job left unfinished; returns its id."""
    from mlflow.entities import Param

    client = store.client
    same = f"tags.`cfx.app.job` = '{tags['cfx.app.job']}' and attributes.status != 'FINISHED'"
    unfinished = []
    for run in client.search_runs([store.experiment_id], same, max_results=10):
        if not _is_running(run):
            unfinished.append(run)
    if unfinished:
        run, logged = unfinished[0], unfinished[0].data.params
        client.update_run(run.info.run_id, status="RUNNING", name=name)
        if "cfx.failure" in run.data.tags:
            client.delete_tag(run.info.run_id, "cfx.failure")
    else:
        # With its tags from the start: whoever finds it after a kill knows whose it was.
        cleaned = {tag.key: tag.value for tag in _tags(tags)}
        run, logged = client.create_run(store.experiment_id, run_name=name, tags=cleaned), {}
    run_id = str(run.info.run_id)
    try:
        missing = [Param(key, value) for key, value in parameters.items() if key not in logged]
        client.log_batch(run_id, params=missing, tags=_tags(tags))
        folder = _local(run.info.artifact_uri)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK | os.X_OK):
                raise OSError(f"the folder of its artifacts, {folder}, cannot be written")
    except BaseException:
        client.set_terminated(run_id, "FAILED")
        raise
    return run_id


def _replace_earlier(store: Store, run_id: str, tags: Mapping[str, str]) -> None:
    """Takes earlier runs of the same job out of its sweep: the job overwrites their folder.

    They stay where they are, with the tag `cfx.replaced_by`.
    """
    folder = tags.get("cfx.folder", "")
    mark = '"' if "'" in folder else "'"
    if not folder or mark in folder:
        return
    same = f"tags.`cfx.sweep` = '{tags['cfx.sweep']}' and tags.`cfx.folder` = {mark}{folder}{mark}"
    for run in store.client.search_runs([store.experiment_id], same):
        if run.info.run_id != run_id and not _is_running(run):
            store.client.set_tag(run.info.run_id, "cfx.replaced_by", run_id)
            for tag in ("cfx.sweep", "mlflow.parentRunId"):
                store.client.delete_tag(run.info.run_id, tag)


def _remove_repeated(store: Store, run_id: str) -> None:
    """Moves runs to MLflow's trash that a run replaces as it ends, and that say just the same.

    There is one if a job was killed after its run was closed, and before its folder said so.
    """
    this_run = store.client.get_run(run_id)
    same = f"tags.`cfx.replaced_by` = '{run_id}' and attributes.status = 'FINISHED'"
    for run in store.client.search_runs([store.experiment_id], same):
        if run.data.tags.get("cfx.app.job") != this_run.data.tags.get("cfx.app.job"):
            continue
        if _written(run.data.metrics) == _written(this_run.data.metrics):
            store.client.delete_run(run.info.run_id)


def _written(metrics: Mapping[str, float]) -> dict[str, str]:
    return {name: repr(value) for name, value in metrics.items()}


def _is_running(run: Any) -> bool:
    return run.info.status == "RUNNING" and provenance.is_alive(run.data.tags)


def close_abandoned(store: Store) -> None:
    """Marks an experiment's runs KILLED whose process on this machine is gone.

    A killed process cannot do it itself. Call under the lock.
    """
    host = _safe(provenance.process_tags()["cfx.host"])
    running_here = f"attributes.status = 'RUNNING' and tags.`cfx.host` = '{host}'"
    for run in store.client.search_runs([store.experiment_id], running_here, max_results=1000):
        if not provenance.is_alive(run.data.tags):
            store.client.set_tag(
                run.info.run_id, "cfx.failure", "the process ended without closing the run"
            )
            store.client.set_terminated(run.info.run_id, "KILLED")
            if "mlflow.parentRunId" in run.data.tags and "cfx.sweep" in run.data.tags:
                _settle(store, run.data.tags["mlflow.parentRunId"], run.data.tags["cfx.sweep"])


def _sweep_parent(store: Store, sweep: str) -> str:
    """Returns the id of the sweep's parent run; the first job makes it. Call under the lock."""
    client, name = store.client, _safe(sweep)
    # The parent has not the children's tag: a table filtered by `cfx.sweep` shows the jobs alone,
    # flat, and so do its charts.
    runs = client.search_runs(
        [store.experiment_id], f"tags.`cfx.sweep_parent` = '{name}'", max_results=1
    )
    if runs:
        client.update_run(runs[0].info.run_id, status="RUNNING")
        return str(runs[0].info.run_id)
    note = f"[All jobs of this sweep]({sweep_link(store.experiment_id, sweep)})"
    tags = {
        "cfx.sweep_parent": name,
        "mlflow.note.content": note,
        "mlflow.source.name": "cfx",
        "mlflow.user": provenance.user(),
    }
    return str(
        client.create_run(store.experiment_id, run_name=f"sweep {name}", tags=tags).info.run_id
    )


def _settle(store: Store, parent_id: str, sweep: str) -> None:
    """Gives a sweep's parent the status of its jobs: RUNNING while one runs, else the worst.

    Call under the lock.
    """
    for status in ("RUNNING", "FAILED", "KILLED", "FINISHED"):
        jobs = f"tags.`cfx.sweep` = '{sweep}' and attributes.status = '{status}'"
        if store.client.search_runs([store.experiment_id], jobs, max_results=1):
            if status == "RUNNING":
                store.client.update_run(parent_id, status=status)
            else:
                store.client.set_terminated(parent_id, status)
            return


def _clean_parameters(parameters: Mapping[str, str]) -> dict[str, str]:
    """Returns parameters that MLflow takes.

    Other signs in a key become `_`; values that are too long end in an ellipsis.
    """
    clean = {}
    for key, value in parameters.items():
        name = re.sub(r"[^\w\-. :/]", "_", key)[:_KEY_LENGTH]
        clean[name] = _shortened(value, _PARAMETER_LENGTH)
    return clean


def _tags(tags: Mapping[str, str]) -> list[Any]:
    from mlflow.entities import RunTag

    named = []
    for key, value in tags.items():
        named.append(RunTag(key[:_KEY_LENGTH], _shortened(value, _TAG_LENGTH)))
    return named


def _shortened(text: str, length: int) -> str:
    """Returns a text of at most `length` signs; a longer one ends in an ellipsis."""
    if len(text) <= length:
        return text
    return text[: length - 1] + "…"


def _fingerprint(values: Mapping[str, Any], tags: Mapping[str, str]) -> str:
    """Returns what two starts of the same job in the same folder share."""
    text = json.dumps([values, tags.get("cfx.folder", "")], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _safe(name: str) -> str:
    """Returns a name that needs no quoting in MLflow's search language."""
    return re.sub(r"[^\w./:+=,@-]", "_", name)


def _local(artifact_uri: str) -> Path | None:
    from mlflow.utils.file_utils import local_file_uri_to_path

    path: str = local_file_uri_to_path(artifact_uri)  # type: ignore[no-untyped-call]  # MLflow's
    if not artifact_uri.startswith(("file:", "/")):
        return None
    return Path(path)


def _address(uri: str) -> tuple[str, tuple[str, ...]]:
    """Returns the address of MLflow's pages, and what to do first to have them."""
    if uri.startswith(("http://", "https://")):
        return uri.rstrip("/"), ()
    # A program may have set the environment's URI itself; a shell does not know it then. Other
    # databases' URIs hold passwords.
    is_default = uri == tracking_uri(None)
    if uri.startswith("sqlite"):
        is_default = is_default and "MLFLOW_TRACKING_URI" not in os.environ
    where = "" if is_default else f" --uri {shlex.quote(uri)}"
    return "http://127.0.0.1:5000", (f"To see it in MLflow: python -m cfx ui{where}",)
