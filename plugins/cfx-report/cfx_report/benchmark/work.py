"""Makes a row: fold after fold an entry learns and drives, and what it drove is scored.

Every fold is a file when it is done, so that a row that was broken off goes on. Errors are those of
the files of trajectories and forecasts that the row leaves: anybody's files are scored alike.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import psutil  # type: ignore[import-untyped]  # it ships no types

import cfx
from cfx.errors import ConfigError
from cfx.plugin import PairSet, files
from cfx_report.benchmark import predictions
from cfx_report.benchmark.equilibrium import flow_errors
from cfx_report.benchmark.methods import Entry, Training
from cfx_report.benchmark.rival import Driver
from cfx_report.benchmark.row import DRIVES, PAIRS, ROW, Row, values_of
from cfx_report.benchmark.score import errors_of
from cfx_report.benchmark.segments import segments_of
from cfx_report.benchmark.suite import Suite, Task

_COMMAND = "benchmark_command.json"


@dataclass(frozen=True)
class Recordings:
    """What a suite has read.

    Attributes:
        suite: whose pairs they are.
        pairs: all that are learned from or tested.
        source: the folder or file.
        protocol: version and hash, on these pairs.
    """

    suite: Suite
    pairs: PairSet
    source: Path
    protocol: str

    @classmethod
    def read(cls, suite: Suite, source: Path, *, other_data: bool) -> Recordings:
        """Reads them.

        Raises:
            DataError: a file is missing or holds other pairs.
        """
        pairs = suite.load(source, other_data=other_data)
        return cls(suite, pairs, source, suite.protocol_of(pairs.fingerprint))

    @property
    def about(self) -> str:
        """What the pairs are."""
        if self.protocol == self.suite.protocol:
            return self.suite.about
        return f"{self.source.name}, {self.pairs.fingerprint[:12]}"

    def file_for_jobs(self, folder: Path) -> Path:
        """Returns a file of the pairs: the user's own, or one that is written."""
        if len(self.suite.files) == 1:
            return self.suite.paths(self.source)[0]
        path = folder / f"{self.protocol.replace('/', '-')}.parquet"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            cfx.Pairs(self.pairs).save(path)
        return path


def command_of(suite: Suite, words: Sequence[str]) -> str:
    """Returns the command line that gives a row again, without its data."""
    chosen = "" if suite.name == "i80" else f" --suite {suite.name}"
    return f"cfx benchmark{chosen} {shlex.join(words)}"


def make_row(entry: Entry, recordings: Recordings, folder: Path, seed: int) -> Row:
    """Trains and tests an entry, or takes what was finished before, and writes its row.

    Args:
        entry: a model, a policy or a rival.
        recordings: of the suite.
        folder: of the row.
        seed: of training.

    Raises:
        ConfigError: the folder holds another row.
        DataError: a job failed.
    """
    suite = recordings.suite
    _claim(folder, [*entry.words, f"seed={seed}", recordings.protocol])
    if (folder / ROW).is_file():
        print(f"{folder}: was finished before", flush=True)
        return Row.read(folder / ROW)
    recording = recordings.file_for_jobs(folder.parent)
    timings = []
    for scheme in suite.schemes:
        fold = suite.folds_of(recordings.pairs, scheme, seed)
        training = Training(suite, scheme, recordings.pairs, fold, recording, folder, seed)
        for number in range(training.folds):
            timings.append(_fold(entry, training, number))
    tables = {}
    for kind, table in _joined(folder).items():
        predictions.write(table, folder / kind)
        tables[kind] = (folder / kind, predictions.read(folder / kind))
    made = pd.DataFrame([timing["seconds"] for timing in timings]).sum()
    flow = pd.DataFrame([timing["flows"] for timing in timings]).mean()
    return write_row(
        recordings,
        folder,
        tables,
        name=entry.name,
        command=command_of(suite, entry.words),
        seconds={str(name): float(value) for name, value in made.items()},
        flows={str(name): float(value) for name, value in flow.items()},
    )


def write_row(
    recordings: Recordings,
    folder: Path,
    tables: Mapping[str, tuple[Path, pd.DataFrame]],
    *,
    name: str,
    command: str,
    seconds: dict[str, float],
    flows: dict[str, float],
    card: dict[str, str] | None = None,
) -> Row:
    """Scores predictions, and writes their row.

    Args:
        recordings: of the suite.
        folder: of the row; nothing is written there where a prediction is wrong.
        tables: trajectories and forecasts by their kind, each with the file that it was read from.
        name, command, seconds, flows, card: as of `Row`.

    Raises:
        DataError: a prediction is missing or wrong, in one sentence with file, row and column.
    """
    suite, tested = recordings.suite, recordings.suite.tested(recordings.pairs)
    parts, drives = [], None
    for kind in (predictions.TRAJECTORIES, predictions.FORECASTS):
        if kind in tables:
            source, table = tables[kind]
            parts.append(errors_of(suite, tested, table, str(source)))
            if kind == predictions.TRAJECTORIES:
                drives = _drives(suite, tested, table, parts[-1])
    errors = pd.concat(parts, ignore_index=True)
    folder.mkdir(parents=True, exist_ok=True)
    if drives is not None:
        predictions.write(drives, folder / DRIVES)
    errors.insert(0, "protocol", recordings.protocol)
    errors.insert(1, "row", name)
    row = Row(
        name=name,
        protocol=recordings.protocol,
        data=recordings.about,
        command=command,
        cfx=cfx.__version__,
        seconds=sum(seconds.values()),
        pairs=errors["pair_id"].nunique(),
        drivers=errors["driver"].nunique(),
        values=values_of(errors),
        parts=seconds,
        flows=flows,
        card=card or {},
    )
    with files.atomic_write(folder / PAIRS) as temporary:
        errors.to_csv(temporary, index=False)
    row.write(folder / ROW)
    return row


_SHOWN = {"best": 0.0, "median": 0.5, "worst": 1.0}
"""Pairs that a page shows of each row, by the rank of their error in the first task."""


def _drives(
    suite: Suite, pairs: PairSet, table: pd.DataFrame, errors: pd.DataFrame
) -> pd.DataFrame:
    """Returns what three pairs of the first task drove beside the recording.

    Columns: drive, site, rmse_speed (m/s), time_s, leader, recorded, driven (m/s).
    """
    answered = set(errors["task"])
    task = next(task.name for task in suite.tasks if task.name in answered)
    ranked = errors[errors["task"] == task].sort_values("rmse_speed", ignore_index=True)
    by_id = {pair.pair_id: pair for pair in pairs}
    parts = []
    for drive, rank in _SHOWN.items():
        about = ranked.iloc[round(rank * (len(ranked) - 1))]
        rows = table[(table["task"] == task) & (table["pair_id"] == about["pair_id"])]
        pair = by_id[about["pair_id"]]
        frame = np.rint(rows["time_s"].to_numpy() / pair.dt).astype(np.int64)
        columns = {
            "drive": drive,
            "site": about["site"],
            "rmse_speed": about["rmse_speed"],
            "time_s": rows["time_s"],
            "leader": np.asarray(pair.leader_speed)[frame],
            "recorded": np.asarray(pair.follower_speed)[frame],
            "driven": rows["speed_mps"],
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def _claim(folder: Path, command: Sequence[str]) -> None:
    """Keeps a folder for one row.

    Raises:
        ConfigError: it holds another one.
    """
    record = folder / _COMMAND
    if record.is_file():
        if json.loads(record.read_text(encoding="utf-8")) != list(command):
            raise ConfigError(f"{folder}: holds another row; give --output another folder")
        return
    folder.mkdir(parents=True, exist_ok=True)
    files.write_output(record, json.dumps(list(command)), "the row's command")


def _fold(entry: Entry, training: Training, number: int) -> dict[str, dict[str, float]]:
    """Lets an entry learn and drive in one fold, unless that is done; returns times and flows."""
    place = training.folder / "folds" / f"{training.scheme.name}-{number}"
    done = place / "done.json"
    if not done.is_file():
        place.mkdir(parents=True, exist_ok=True)
        began = _cpu_seconds()
        driver = entry.driver(training, number)
        trained = _cpu_seconds()
        for task in training.suite.tasks_of(training.scheme):
            _drive(driver, training, number, task, place)
        driven = _cpu_seconds()
        flows = flow_errors(driver, training.pairs.dt)
        print(
            f"{training.scheme.name}, fold {number + 1} of {training.folds}: learned in"
            f" {trained - began:.0f} CPU s, drove in {driven - trained:.0f} CPU s",
            flush=True,
        )
        seconds = {"train": trained - began, "drive": driven - trained}
        files.write_json(done, {"seconds": seconds, "flows": flows})
    measured: dict[str, dict[str, float]] = json.loads(done.read_text(encoding="utf-8"))
    return measured


def _cpu_seconds() -> float:
    """Returns the CPU time of this process and its workers so far, s.

    Rows are made beside one another and beside other work, which a clock on the wall would count.
    """
    process = psutil.Process()
    used = process.cpu_times()
    spent = used.user + used.system + used.children_user + used.children_system
    for worker in process.children(recursive=True):
        try:
            used = worker.cpu_times()
        except psutil.NoSuchProcess:
            continue  # it has ended meanwhile, and is counted among those that have
        spent += used.user + used.system + used.children_user + used.children_system
    return float(spent)


def _drive(driver: Driver, training: Training, number: int, task: Task, place: Path) -> None:
    """Lets a driver answer a task in a fold, and writes what it drove."""
    suite, seed = training.suite, training.seed
    segments = segments_of(suite, task, list(training.tested(number)))
    if not len(segments):
        return
    batch = segments.blanked()
    if task.kind == "forecast":
        speed = driver.forecast(batch, segments.first, seed, suite.samples)
        table = predictions.forecast_table(segments, speed, suite.horizons)
    else:
        if task.kind == "last_part":
            driver = driver.adapted(segments.past, seed)
        table = predictions.trajectory_table(
            task.name, segments, driver.drive(batch, segments.first, None)
        )
    predictions.write(table, place / f"{task.name}.parquet")


def _joined(folder: Path) -> dict[str, pd.DataFrame]:
    """Returns the trajectories and the forecasts of all folds, by their kind."""
    parts: dict[str, list[pd.DataFrame]] = {}
    for path in sorted((folder / "folds").glob("*/*.parquet")):
        table = pd.read_parquet(path)
        name = predictions.FORECASTS if "horizon_s" in table else predictions.TRAJECTORIES
        parts.setdefault(name, []).append(table)
    return {kind: pd.concat(tables, ignore_index=True) for kind, tables in parts.items()}
