"""What a job leaves behind: its folder, each file whole or not at all, a copy, and its result."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import yaml

from cfx.app.overrides import command_of
from cfx.core import registry
from cfx.core.files import atomic_write, remove_leftovers, write_json
from cfx.core.guest import default_torch, guest, in_turn, visit
from cfx.core.job_folder import examine, parse_yaml, read_metrics
from cfx.core.storage import RemoteFolder
from cfx.data.style import StyleResult
from cfx.data.tidy import write_tidy
from cfx.errors import ConfigError, DataError, OutputError, listed
from cfx.evaluation.headline import headline, improvement_key
from cfx.evaluation.result import METHODS, Evaluation
from cfx.evaluation.statistics import STATISTICS
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.ready import is_ready_made
from cfx.results.config import JobConfig
from cfx.results.provenance import commit, version
from cfx.results.table import (
    Findings,
    Kept,
    ResultTable,
    WrittenTable,
    file_of,
    installed,
    parts_of,
    read_tables,
)
from cfx.results.tracker import Origin, folder_of
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cfx.app.job.steps import Parts
    from cfx.figures.figure import Results

log = logging.getLogger(__name__)

METRICS = "metrics.json"
"""The file that is written last: a folder that has it is complete."""

_CONFIG = "config.yaml"


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


def write_job(
    folder: Path,
    config: JobConfig,
    parts: Parts,
    findings: Findings,
    tell: Callable[[Mapping[str, float], Sequence[WrittenTable]], None] | None = None,
) -> Kept:
    """Writes all that a job leaves behind.

    `tell` is told the results before figures are drawn, which takes seconds.

    Raises:
        CfxError: a demonstration cannot be shown, or a file cannot be written.
    """
    result = findings.protocol_result
    with _writing(folder):
        (folder / METRICS).unlink(missing_ok=True)
        _write_config(folder, config)
        tables = tables_of(findings, parts.tables, folder)
        if any(pair.truth for pair in findings.pairs):
            with atomic_write(folder / "data.parquet") as temporary:
                write_tidy(findings.pairs, temporary)
        metrics = measured(findings, tables)
        if tell is not None:
            tell(metrics, tables)
        checkpoint.save_agent(result.policy, folder / "policy")
        figures: list[Path] = []
        if config.figures.enabled:
            figures = _write_figures(folder, config, findings, tables, metrics)
        files = [
            folder / name for name in (_CONFIG, METRICS, "data.json")
        ]  # MLflow keeps these too
        if parts.demo is not None and config.demo is not None:
            own = folder / config.demo["name"]
            own.mkdir(parents=True, exist_ok=True)
            shown = findings.pairs, result.policy, findings.evaluation, config.protocol
            files += parts.demo.write(own, *shown)
        objective = {"name": config.objective["name"], "unit": parts.objective.unit}
        write_json(folder / "data.json", _description(findings, objective))
        defined = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        write_json(folder / METRICS, defined)
    return Kept(folder, metrics, tables, figures, files)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Says in one sentence that the file system refuses what the block writes."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot write into {folder}: {error.strerror or error};"
            " the calibration is cached, so run again"
        ) from error


def _write_config(folder: Path, config: JobConfig) -> None:
    values = config.model_dump(mode="json")
    with atomic_write(folder / _CONFIG) as temporary:
        temporary.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def tables_of(
    findings: Findings,
    chosen: Sequence[registry.Installed[ResultTable]],
    folder: Path | None = None,
) -> list[WrittenTable]:
    """Returns the chosen tables of the results; of those that are large the rows are left out.

    Those that an earlier job left in the folder go, if one is given; these are written there.

    Raises:
        OSError: a file cannot be written.
    """
    tables = []
    names = {one.name for one in chosen}  # installing something makes the tables anew
    for about in installed():
        parts = parts_of(about, findings) if about.name in names else None
        path = None if folder is None else folder / file_of(about)
        if parts is None:
            if path is not None:
                path.unlink(missing_ok=True)
            continue
        rows = None if about.part.large else pd.concat(list(parts))
        if path is not None:
            with atomic_write(path) as temporary:
                about.part.write(temporary, parts if rows is None else [rows])
        tables.append(WrittenTable(about, rows))
    return tables


def measured(findings: Findings, tables: Iterable[WrittenTable]) -> dict[str, float]:
    """Returns all metrics of a job, those of its tables included."""
    metrics = findings.evaluation.metrics() | dict(findings.protocol_result.calibration)
    for table in tables:
        metrics |= table.metrics(findings)
    return metrics


def results_of(
    findings: Findings, tables: Iterable[WrittenTable], metrics: Mapping[str, float]
) -> Results:
    """Returns what figures are drawn from."""
    from cfx.figures.figure import Results

    rows = {table.about.name: table.rows for table in tables if table.rows is not None}
    return Results.of(findings.evaluation, style=findings.style, tables=rows, metrics=metrics)


def _write_figures(
    folder: Path,
    config: JobConfig,
    findings: Findings,
    tables: list[WrittenTable],
    metrics: Mapping[str, float],
) -> list[Path]:
    # In this process, though they take seconds: a second one can be killed, late or absent.
    from cfx.figures.figure import where_figures_are, write_figures

    if not registry.installed("figure"):
        log.warning("No figures are drawn. %s", where_figures_are())
    results = results_of(findings, tables, metrics)
    return write_figures(folder / "figures", results, formats=config.figures.formats)


def _description(findings: Findings, objective: Mapping[str, str]) -> dict[str, Any]:
    """Returns what `data.json` says: where the data came from, and what a report must know.

    `objective`: name and unit of what calibration has minimised.
    """
    pairs, evaluation = findings.pairs, findings.evaluation
    shown = ("name", "unit", "meaning", "low", "high")
    parameters = [{key: getattr(one, key) for key in shown} for one in evaluation.parameters]
    dropped = []
    for drop in pairs.dropped:
        dropped.append({"reason": drop.reason, "count": drop.count, "unit": drop.unit})
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


class Upload:
    """The copy of a job's folder behind a URL.

    At first it has the configuration alone, so that a store that cannot be written is known at
    once. Results of an earlier job there stay as they are until the new ones come.

    Raises:
        CfxError: nobody knows such URLs, what they need is not installed, or the store cannot be
            read or written.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url = f"{url.rstrip('/')}/{place_of(folder)}"
        self._folder = folder
        self._remote = RemoteFolder(self.url)
        try:
            if self._remote.read(METRICS) is None:
                self._remote.put(_CONFIG, folder / _CONFIG)
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
        names = []
        for path in sorted(self._folder.rglob("*")):
            is_temporary = path.name.startswith(".") and "@" in path.name
            is_lock = path.name in {".lock", ".lock.lease"}  # of this machine alone
            if path.is_file() and not is_lock and not is_temporary and path.name != METRICS:
                names.append(path.relative_to(self._folder).as_posix())
        try:
            there = set(self._remote.names())
            if {METRICS, _CONFIG} <= there:  # a job's; anything else is not ours to remove
                self._remote.remove(METRICS)
                for name in there - {METRICS, *names}:
                    self._remote.remove(name)
            for name in (*names, METRICS):
                self._remote.put(name, self._folder / name)
            log.info("The job's folder was copied to %s", self.url)
        except OSError as error:
            raise OutputError(
                f"the job's results lie in {self._folder}, but cannot be copied to"
                f" {self.url} ({error}); the calibration is cached, so run again"
            ) from error


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


@dataclass(frozen=True)
class Computed:
    """What a job has computed in this process; the protocol has completed its configuration."""

    config: JobConfig
    parts: Parts
    findings: Findings


@dataclass(frozen=True, repr=False)
class JobResult:
    """What a job leaves behind; `cfx.load` reads it back from the job's folder.

    Attributes:
        metrics: under their MLflow names; NaN where a metric is not defined.
        pairs: a row per pair and method.
        policy: the policy of the job, ready for another trajectory.
        figures: the figures' files.
        folder: the job's output folder; None if nothing was written (`save` does).
        run_id: MLflow's id of the run; "" if it was not tracked.
        computed: all that was computed; None if the job was read back from its folder.
    """

    metrics: dict[str, float]
    pairs: pd.DataFrame
    policy: Agent
    figures: tuple[Path, ...]
    folder: Path | None
    run_id: str = ""
    computed: Computed | None = field(default=None, repr=False)

    @property
    def evaluation(self) -> Evaluation | None:
        """What was measured; None if the job was read back from its folder."""
        return None if self.computed is None else self.computed.findings.evaluation

    @property
    def style(self) -> StyleResult | None:
        """The driving style of each pair; None if the job was read back from its folder."""
        return None if self.computed is None else self.computed.findings.style

    @property
    def config(self) -> JobConfig:
        """The job's configuration.

        Raises:
            DataError: the folder holds none, as that of a ready-made policy.
        """
        if self.computed is not None:
            return self.computed.config
        assert self.folder is not None
        return read_config(self.folder / "config.yaml")

    @property
    def command(self) -> str:
        """The command line that runs the same.

        Raises:
            DataError: the job used what is in this process alone: a data frame, or a policy that
                was not saved.
        """
        with visit():
            return command_of(self.config)

    def improvement(self, over: str = "fixed", scope: str = "test") -> pd.Series:
        """Returns the policy's improvement of the RMSE of speed over a baseline (0.1 is 10 %).

        Args:
            over: the baseline: `fixed` (driver-specific), `population` (pooled) or `default`.
            scope: `test`; `steady`, after its first seconds; or `full_trajectory`.

        Returns:
            mean, trimmed_mean, median, ci95_low, ci95_high, win_rate, p_value; see
            `cfx.evaluation.statistics.Improvement`.

        Raises:
            DataError: they were not compared.
        """
        prefix = improvement_key(over, scope)
        values = {name: self.metrics.get(f"{prefix}/{name}") for name in STATISTICS}
        if values["mean"] is None:
            known = [
                one for one in METHODS if f"{improvement_key(one, scope)}/mean" in self.metrics
            ]
            raise DataError(
                f"improvement(over={over!r}, scope={scope!r}): the policy was not compared with it;"
                f" known there: {listed(known) or 'nothing'}"
            )
        return pd.Series(values, dtype=float, name=f"improvement over {over}")

    def plot(self, name: str = "improvement_per_driver") -> Figure:
        """Draws one of the job's figures.

        Args:
            name: as their files are called: `drives`, `error_over_time`, `chosen_parameters`, ...

        Raises:
            DataError: there is no such figure, or the job has nothing of what it shows.
        """
        from cfx.figures.figure import drawn

        return drawn(name, self._results)

    @cached_property
    def _results(self) -> Results:
        """What figures are drawn from."""
        if self.computed is None:
            from cfx.figures.job import read_job

            assert self.folder is not None
            return read_job(Origin(str(self.folder), self.folder)).results
        findings = self.computed.findings
        tables = tables_of(findings, self.computed.parts.tables)
        return results_of(findings, tables, self.metrics)

    def save(self, folder: str | Path) -> JobResult:
        """Writes the job's folder, as a job of the command line does; MLflow is not told.

        Args:
            folder: made if it is not there.

        Returns:
            The same result, with its folder and figures.

        Raises:
            DataError: the job was read back from a folder, which can be copied.
            OutputError: it cannot be written.
        """
        if self.computed is None:
            raise DataError(f"this job was read from {self.folder}; copy that folder")
        config, parts, findings = vars(self.computed).values()
        with in_turn(), guest(), default_torch():
            begin(Path(folder), config)
            kept = write_job(Path(folder), config, parts, findings)
        return replace(self, folder=Path(folder), figures=tuple(kept.figures))

    def __repr__(self) -> str:
        """Returns two lines for people: what it is and how well it drives, and where it lies."""
        pairs = self.pairs["pair_id"].nunique() if "pair_id" in self.pairs else 0
        said = [f"model={self.policy.model_node['name']}"]
        said.append(f"policy={self.policy.policy_node['name']}")
        if pairs:
            said.append(f"{pairs} pairs")
        _, words = headline(self.metrics)
        if words:
            said.append(words)
        folder = "not saved" if self.folder is None else f"folder={str(self.folder)!r}"
        return f"JobResult({', '.join(said)},\n  {folder})"

    def _repr_html_(self) -> str:
        from cfx.figures.figure import as_html

        rows = {}
        for method in self.pairs["method"].unique() if "method" in self.pairs else ():
            of_method = self.pairs[self.pairs["method"] == method]
            rows[method] = of_method[["rmse_speed", "rmse_gap"]].mean()
        return as_html(repr(self), pd.DataFrame(rows).T.rename_axis("mean over pairs"))


def read_config(path: Path) -> JobConfig:
    """Reads a job's configuration.

    Raises:
        DataError: there is none that this version knows.
    """
    try:
        return JobConfig.of(parse_yaml(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror}); give the output folder that a job printed"
        ) from None
    except (ValueError, ConfigError) as error:
        raise DataError(f"{path} is no configuration of this version of cfx: {error}") from None


@visit()
def load(folder_or_run: str | Path) -> JobResult:
    """Reads a finished job back.

    Args:
        folder_or_run: a job's output folder or the URL of its copy (`output.url`), the id of its
            MLflow run, or a ready-made policy (`cfx://NAME`), whose table of pairs is empty.

    Raises:
        DataError: there is no finished job, or no such policy.
    """
    folder = folder_of(folder_or_run)
    examine(folder)
    # No recording, and nothing of one, comes with a ready-made policy.
    needed = ["metrics.json"] if is_ready_made(folder_or_run) else ["metrics.json", "pairs.csv"]
    for name in needed:
        if not (folder / name).is_file():
            raise DataError(
                f"{folder} holds no finished job (it has no {name}); give the output folder that a"
                " job printed"
            )
    metrics = read_metrics(folder / "metrics.json")
    pairs = read_tables(folder, "pairs").get("pairs", pd.DataFrame())
    figures = tuple(sorted((folder / "figures").glob("*.*")))
    policy = checkpoint.load_agent(folder / "policy")
    return JobResult(metrics, pairs, policy, figures, folder)
