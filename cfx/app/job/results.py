"""What a job leaves behind, and how it is read back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from cfx.core.errors import DataError
from cfx.core.guest import guest
from cfx.core.job_folder import examine, read_metrics
from cfx.data.style import StyleResult
from cfx.evaluation.headline import headline
from cfx.evaluation.result import Evaluation
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.ready import is_ready_made
from cfx.results.store import folder_of
from cfx.results.table import read_tables


@dataclass(frozen=True, repr=False)
class JobResult:
    """What a job leaves behind; `cfx.load` reads it back from the job's folder.

    Attributes:
        metrics: under their MLflow names; NaN where a metric is not defined.
        pairs: a row per pair and method.
        policy: the policy of the job, ready for another trajectory.
        figures: the figures' files.
        folder: the job's output folder.
        run_id: MLflow's id of the run; "" if it was not tracked.
        evaluation: what was measured; None if the job was read back from its folder.
        style: the driving style of each pair; None if the job was read back from its folder.
    """

    metrics: dict[str, float]
    pairs: pd.DataFrame
    policy: Agent
    figures: tuple[Path, ...]
    folder: Path
    run_id: str = ""
    evaluation: Evaluation | None = field(default=None, repr=False)
    style: StyleResult | None = field(default=None, repr=False)

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
        return f"JobResult({', '.join(said)},\n  folder={str(self.folder)!r})"


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
