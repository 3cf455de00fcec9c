"""The files of a job's folder, each whole or not at all, and the folder's copy behind a URL."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import yaml

from cfx.core import registry
from cfx.core.errors import OutputError
from cfx.core.files import atomic_write, remove_leftovers, write_json
from cfx.core.storage import RemoteFolder
from cfx.data.tidy import write_tidy
from cfx.policies import checkpoint
from cfx.results.config import JobConfig
from cfx.results.provenance import commit, version
from cfx.results.table import Findings, Kept, WrittenTable, file_of, installed, parts_of
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from cfx.app.job.steps import Parts
    from cfx.evaluation.demo import Demo


log = logging.getLogger(__name__)

METRICS = "metrics.json"
"""The file that is written last: a folder that has it is complete."""

_TRACKED = ("config.yaml", METRICS, "data.json")
"""Files that MLflow keeps too, besides tables, figures and the policy."""


def begin(folder: Path, config: JobConfig) -> None:
    """Makes a job's folder, if it is not there, and writes the job's configuration into it.

    Where the folder holds an earlier job's results, these stay as they are until the new ones are
    there, so that the folder never mixes two jobs.

    Raises:
        OutputError: the folder cannot be made, or not be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the output folder {folder}: {error.strerror};"
            " set hydra.run.dir to a place that can be written"
        ) from error
    with _writing(folder):
        remove_leftovers(folder)
        if not (folder / METRICS).is_file():
            _write_config(folder, config)


Told = Callable[[Mapping[str, float], Sequence[WrittenTable]], None]
"""Is told a job's metrics and tables."""


def write_job(
    folder: Path, config: JobConfig, parts: Parts, findings: Findings, tell: Told | None = None
) -> Kept:
    """Writes all that a job leaves behind.

    Args:
        folder: of the job.
        config: of the job.
        parts: its components.
        findings: what was measured.
        tell: is told the results before figures are drawn, which takes seconds.

    Raises:
        CfxError: a demonstration cannot be shown, or a file cannot be written.
    """
    result = findings.protocol_result
    with _writing(folder):
        (folder / METRICS).unlink(missing_ok=True)
        _write_config(folder, config)
        tables = write_tables(folder, findings)
        metrics = measured(findings, tables)
        if tell is not None:
            tell(metrics, tables)
        checkpoint.save(result.policy, folder / "policy")
        figures: list[Path] = []
        if config.figures.enabled:
            figures = _write_figures(folder, config, findings, tables, metrics)
        files = [folder / name for name in _TRACKED]
        if parts.demo is not None:
            files += _write_demo(folder, parts.demo, config, findings)
        objective = {"name": config.objective["name"], "unit": parts.objective.unit}
        write_json(folder / "data.json", _description(findings, objective))
        defined = {}
        for name, value in metrics.items():
            defined[name] = value if math.isfinite(value) else None
        write_json(folder / METRICS, defined)
    return Kept(folder, metrics, tables, figures, files)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Runs a block that writes into a job's folder.

    Raises:
        OutputError: the file system refuses.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot write into {folder}: {error.strerror or error};"
            " the calibration is cached, so run again"
        ) from error


def _write_config(folder: Path, config: JobConfig) -> None:
    values = config.model_dump(mode="json")
    with atomic_write(folder / "config.yaml") as temporary:
        temporary.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def tables_of(findings: Findings) -> list[WrittenTable]:
    """Returns the tables of the results; of those that are large the rows are left out."""
    tables = []
    for about in installed():
        parts = parts_of(about, findings)
        if parts is not None:
            tables.append(WrittenTable(about, None if about.part.large else pd.concat(list(parts))))
    return tables


def measured(findings: Findings, tables: Iterable[WrittenTable]) -> dict[str, float]:
    """Returns all metrics of a job, those of its tables included."""
    metrics = findings.evaluation.metrics() | dict(findings.protocol_result.calibration)
    for table in tables:
        metrics |= table.metrics(findings)
    return metrics


def write_tables(folder: Path, findings: Findings) -> list[WrittenTable]:
    """Writes the tables of the results; those that an earlier job left in the folder go.

    Returns:
        Those that this job has.

    Raises:
        OSError: a file cannot be written.
    """
    written = []
    for about in installed():
        path, parts = folder / file_of(about), parts_of(about, findings)
        if parts is None:
            path.unlink(missing_ok=True)
            continue
        rows = None if about.part.large else pd.concat(list(parts))
        with atomic_write(path) as temporary:
            about.part.write(temporary, parts if rows is None else [rows])
        written.append(WrittenTable(about, rows))
    if any(pair.truth for pair in findings.pairs):
        with atomic_write(folder / "data.parquet") as temporary:
            write_tidy(findings.pairs, temporary)
    return written


def _write_figures(
    folder: Path,
    config: JobConfig,
    findings: Findings,
    tables: list[WrittenTable],
    metrics: Mapping[str, float],
) -> list[Path]:
    from cfx.figures.figure import Results, where_figures_are
    from cfx.figures.write import write_figures

    if not registry.installed("figure"):
        log.warning("No figures are drawn. %s", where_figures_are())
    rows = {table.about.name: table.rows for table in tables if table.rows is not None}
    results = Results.of(findings.evaluation, style=findings.style, tables=rows, metrics=metrics)
    return write_figures(folder / "figures", results, formats=config.figures.formats)


def _write_demo(folder: Path, demo: Demo, config: JobConfig, findings: Findings) -> list[Path]:
    """Writes the demonstration into a folder of its name; the policy is beside it."""
    assert config.demo is not None
    own = folder / config.demo["name"]
    own.mkdir(parents=True, exist_ok=True)
    policy = findings.protocol_result.policy
    return list(demo.write(own, findings.pairs, policy, findings.evaluation, config.protocol))


def _description(findings: Findings, objective: Mapping[str, str]) -> dict[str, Any]:
    """Returns what `data.json` says: where the data came from, and what a report must know.

    Args:
        findings: of the job.
        objective: name and unit of what calibration has minimised; losses of labels have this unit.
    """
    pairs, evaluation = findings.pairs, findings.evaluation
    dropped = []
    for drop in pairs.dropped:
        dropped.append({"reason": drop.reason, "count": drop.count, "unit": drop.unit})
    parameters = []
    for one in evaluation.parameters:
        about = {"name": one.name, "unit": one.unit, "meaning": one.meaning}
        parameters.append({**about, "low": one.low, "high": one.high})
    return {
        "source": pairs.source,
        "fingerprint": pairs.fingerprint,
        "pairs": len(pairs),
        "protocol": dict(findings.protocol_result.notes),
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


_CONFIG = "config.yaml"

_LEFT_OUT = frozenset({".lock", ".lock.lease"})
"""Files that mean something on this machine alone."""


class Upload:
    """Copies a job's folder.

    Args:
        url: what `output.url` says.
        folder: of the job.

    Raises:
        CfxError: nobody knows such URLs, or what they need is not installed.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url = f"{url.rstrip('/')}/{place_of(folder)}"
        self._folder = folder
        self._remote = RemoteFolder(self.url)

    @classmethod
    def of(cls, url: str | None, folder: Path) -> Upload | None:
        """Returns the copy that has begun; None without a URL.

        Raises:
            CfxError: nobody knows such URLs, or the store cannot be read or written.
        """
        if url is None:
            return None
        upload = cls(url, folder)
        upload.begin()
        return upload

    def begin(self) -> None:
        """Copies the configuration, so that a store that cannot be written is known at once.

        Results of an earlier job there stay as they are until the new ones come.

        Raises:
            OutputError: the store cannot be read or written.
        """
        try:
            if self._remote.read(METRICS) is None:
                self._remote.put(_CONFIG, self._folder / _CONFIG)
        except OSError as error:
            raise OutputError(
                f"cannot write to {self.url} ({error}); set output.url to a place"
                " that can be written"
            ) from error

    def finish(self) -> None:
        """Copies all files of the job; those that an earlier job left there go.

        Raises:
            OutputError: the store cannot be written.
        """
        try:
            self._copy()
            log.info("The job's folder was copied to %s", self.url)
        except OSError as error:
            raise OutputError(
                f"the job's results lie in {self._folder}, but cannot be copied to"
                f" {self.url} ({error}); the calibration is cached, so run again"
            ) from error

    def _copy(self) -> None:
        names = self._names()
        there = self._remote.names()
        if {METRICS, _CONFIG} <= set(there):  # a job's; anything else is not ours to remove
            self._remote.remove(METRICS)
            for name in set(there) - set(names):
                self._remote.remove(name)
        for name in names:
            if name != METRICS:
                self._remote.put(name, self._folder / name)
        self._remote.put(METRICS, self._folder / METRICS)

    def _names(self) -> list[str]:
        """Returns the names of the job's files, without those that are being written."""
        names = []
        for path in sorted(self._folder.rglob("*")):
            is_temporary = path.name.startswith(".") and "@" in path.name
            if path.is_file() and path.name not in _LEFT_OUT and not is_temporary:
                names.append(path.relative_to(self._folder).as_posix())
        return names


def place_of(folder: Path) -> str:
    """Returns where a job's folder is copied to, below the URL: its path from `outputs/` on.

    Elsewhere it is its name, in a sweep after the sweep's.
    """
    parts = folder.absolute().parts
    if "outputs" in parts[:-1]:
        last = len(parts) - 1 - parts[::-1].index("outputs")
        return "/".join(parts[last + 1 :])
    if (folder.parent / "sweep.json").is_file():
        return "/".join(parts[-2:])
    return parts[-1]
