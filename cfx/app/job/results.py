"""What a job leaves behind, and how it is read back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from cfx.app.job import output
from cfx.app.overrides import command_of
from cfx.core.errors import ConfigError, DataError, listed
from cfx.core.guest import guest, visit
from cfx.core.job_folder import examine, parse_yaml, read_metrics
from cfx.data.style import StyleResult
from cfx.evaluation.headline import headline, improvement_key
from cfx.evaluation.result import METHODS, Evaluation
from cfx.evaluation.statistics import STATISTICS
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.ready import is_ready_made
from cfx.results.config import JobConfig
from cfx.results.table import Findings, read_tables
from cfx.results.tracker import Origin, folder_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cfx.app.job.steps import Parts
    from cfx.figures.figure import Results


@dataclass(frozen=True)
class Computed:
    """What a job has computed in this process.

    Attributes:
        config: its configuration, with what the protocol determined.
        parts: its components.
        findings: what it has found.
    """

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
        from cfx.figures.write import drawn

        return drawn(name, self._results)

    @cached_property
    def _results(self) -> Results:
        """What figures are drawn from."""
        from cfx.figures.figure import Results
        from cfx.figures.job import read_job

        if self.computed is None:
            assert self.folder is not None
            return read_job(self.folder, Origin(str(self.folder))).results
        findings = self.computed.findings
        rows = {}
        for table in output.tables_of(findings):
            if table.rows is not None:
                rows[table.about.name] = table.rows
        return Results.of(
            findings.evaluation, style=findings.style, tables=rows, metrics=self.metrics
        )

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
        with visit():
            output.begin(Path(folder), config)
            kept = output.write_job(Path(folder), config, parts, findings)
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
        from cfx.figures.write import as_html

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


@guest()
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
    policy = checkpoint.load(folder / "policy")
    return JobResult(metrics, pairs, policy, figures, folder)
