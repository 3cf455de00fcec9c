"""The files of a job's folder; each appears whole or not at all."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from cfx.core.errors import OutputError
from cfx.core.files import atomic_write, remove_leftovers
from cfx.data.pairs import PairSet
from cfx.data.tidy import write_tidy
from cfx.evaluation.demo import Demo
from cfx.evaluation.protocols.base import ProtocolResult
from cfx.results.config import JobConfig
from cfx.results.provenance import commit, version
from cfx.results.table import Findings, WrittenTable, file_of, installed, parts_of
from cfx.simulation.trajectory import TRANSIENT_S

TRACKED = ("config.yaml", "metrics.json", "data.json")
"""Files of a job's folder that MLflow keeps too, besides its tables, figures and policy."""


METRICS = "metrics.json"
"""The file that is written last: a folder that has it is complete."""


class Output:
    """Writes a job's files.

    Attributes:
        folder: the job's output folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def make(cls, folder: Path) -> Output:
        """Makes the folder, if it is not there.

        Raises:
            OutputError: it cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot make the output folder {folder}: {error.strerror};"
                " set hydra.run.dir to a place that can be written"
            ) from error
        output = cls(folder)
        output.run(lambda: remove_leftovers(folder))
        return output

    @property
    def is_complete(self) -> bool:
        """Whether the folder holds the results of an earlier job."""
        return (self.folder / METRICS).is_file()

    def begin(self, config: JobConfig) -> None:
        """Writes the configuration of the job that begins.

        Where the folder holds an earlier job's results, these stay as they are until the new ones
        are there (`replace`), so that the folder never mixes two jobs.

        Raises:
            OutputError: the file cannot be written.
        """
        if not self.is_complete:
            write_config(self, config)

    def replace(self, config: JobConfig) -> None:
        """Removes what marks results as complete, and writes the configuration of new ones.

        Raises:
            OutputError: the file cannot be written.
        """
        self.run(lambda: (self.folder / METRICS).unlink(missing_ok=True))
        write_config(self, config)

    def file(self, name: str, write: Callable[[Path], object]) -> None:
        """Writes one file, whole.

        Args:
            write: is given a path to write to; the file takes its name when it returns.

        Raises:
            OutputError: the file cannot be written.
        """

        def write_whole() -> None:
            with atomic_write(self.folder / name) as temporary:
                write(temporary)

        self.run(write_whole)

    def text(self, name: str, text: str) -> None:
        """Writes a text file.

        Raises:
            OutputError: the file cannot be written.
        """
        self.file(name, lambda path: path.write_text(text, encoding="utf-8"))

    def json(self, name: str, values: Mapping[str, Any]) -> None:
        """Writes a JSON file.

        Raises:
            OutputError: the file cannot be written.
        """
        self.text(name, json.dumps(values, indent=2) + "\n")

    def run(self, write: Callable[[], object]) -> None:
        """Calls a function that writes into the folder.

        Raises:
            OutputError: it cannot write.
        """
        try:
            write()
        except OSError as error:
            raise OutputError(
                f"cannot write into {self.folder}: {error.strerror or error};"
                " the calibration is cached, so run again"
            ) from error


def write_config(output: Output, config: JobConfig) -> None:
    """Writes `config.yaml`.

    Raises:
        OutputError: the file cannot be written.
    """
    values = config.model_dump(mode="json")
    output.text("config.yaml", yaml.safe_dump(values, sort_keys=False))


def write_tables(output: Output, findings: Findings) -> list[WrittenTable]:
    """Writes the tables of the results; those that an earlier job left in the folder go.

    Returns:
        Those that this job has.

    Raises:
        OutputError: a file cannot be written.
    """
    written = []
    for about in installed():
        name, parts = file_of(about), parts_of(about, findings)
        if parts is None:
            output.run(functools.partial((output.folder / name).unlink, missing_ok=True))
            continue
        rows = None if about.part.large else pd.concat(list(parts))
        kept = parts if rows is None else [rows]
        output.file(name, functools.partial(about.part.write, parts=kept))
        written.append(WrittenTable(about, rows))
    if any(pair.truth for pair in findings.pairs):
        output.file("data.parquet", lambda path: write_tidy(findings.pairs, path))
    return written


def write_figures(
    output: Output,
    config: JobConfig,
    findings: Findings,
    tables: Mapping[str, pd.DataFrame],
    metrics: Mapping[str, float],
) -> list[Path]:
    """Writes the figures, if the configuration wants any; returns their paths.

    Args:
        output: the job's folder.
        config: of the job.
        findings: what is drawn.
        tables: likewise, by name.
        metrics: of the job.

    Raises:
        OutputError: a file cannot be written.
    """
    paths: list[Path] = []
    if config.figures.enabled:
        from cfx.report.figures.results import Results
        from cfx.report.figures.write import write_figures as write_all_figures

        results = Results.of(
            findings.evaluation, style=findings.style, tables=tables, metrics=metrics
        )

        def write_all() -> None:
            folder, formats = output.folder / "figures", config.figures.formats
            paths.extend(write_all_figures(folder, results, formats=formats))

        output.run(write_all)
    return paths


def write_demo(
    output: Output,
    demo: Demo,
    pairs: PairSet,
    protocol_result: ProtocolResult,
    config: JobConfig,
) -> list[Path]:
    """Writes the demonstration into a folder of its name; returns its paths.

    The policy must have been saved before.

    Raises:
        CfxError: it cannot be shown, or a file cannot be written.
    """
    assert config.demo is not None
    folder = output.folder / config.demo["name"]
    policy, evaluation = protocol_result.policy, protocol_result.evaluation
    paths: list[Path] = []

    def write_all() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        paths.extend(demo.write(folder, pairs, policy, evaluation, config.protocol))

    output.run(write_all)
    return paths


def write_provenance(
    output: Output,
    pairs: PairSet,
    protocol_result: ProtocolResult,
    objective: Mapping[str, str],
) -> None:
    """Writes `data.json`: where the data came from, and what a report must know of the job.

    Args:
        objective: name and unit of what calibration has minimised; losses of labels have this unit.

    Raises:
        OutputError: the file cannot be written.
    """
    evaluation = protocol_result.evaluation
    dropped = []
    for drop in pairs.dropped:
        dropped.append({"reason": drop.reason, "count": drop.count, "unit": drop.unit})
    parameters = []
    for one in evaluation.parameters:
        about = {"name": one.name, "unit": one.unit, "meaning": one.meaning}
        parameters.append({**about, "low": one.low, "high": one.high})
    values = {
        "source": pairs.source,
        "fingerprint": pairs.fingerprint,
        "pairs": len(pairs),
        "protocol": dict(protocol_result.notes),
        "dropped": dropped,
        "parameters": parameters,
        "purpose": evaluation.purpose,
        "objective": dict(objective),
        "transient_s": TRANSIENT_S,
        "metrics": [metric.to_json() for metric in evaluation.measured],
        "outside": dict(evaluation.outside),
        "metrics_left_out": [asdict(one) for one in evaluation.left_out],
        "cfx": version(),
        "commit": commit(Path.cwd()),
    }
    output.json("data.json", values)


def write_metrics(output: Output, metrics: Mapping[str, float]) -> None:
    """Writes `metrics.json`; null stands for a metric that is not defined.

    It is the last file of a job, so that a folder with a `metrics.json` is complete.

    Raises:
        OutputError: the file cannot be written.
    """
    defined: dict[str, float | None] = {}
    for name, value in metrics.items():
        if math.isfinite(value):
            defined[name] = value
        else:
            defined[name] = None
    output.json("metrics.json", defined)
