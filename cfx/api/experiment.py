"""The configuration of a call, composed as the command line composes it, and its command."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cfx.api.pairs import Pairs, PairsLike, pairs_from
from cfx.app.job.results import JobResult, read_config
from cfx.app.job.run import compute
from cfx.app.overrides import command_of, config_of
from cfx.core.guest import visit
from cfx.results.config import JobConfig
from cfx.results.tracker import folder_of


@dataclass(frozen=True)
class Experiment:
    """A composed configuration, which Python and the command line run alike.

    `cfx.config` and `cfx.from_config` make it.

    Attributes:
        config: the whole configuration of a job.
        pairs: what it runs on; None: what its dataset reads.
    """

    config: JobConfig
    pairs: Pairs | None = None

    @cached_property
    def command(self) -> str:
        """The command line that runs the same.

        Raises:
            DataError: it uses a data frame, or a policy that was not saved.
        """
        with visit():
            return command_of(self.config)

    def run(self) -> JobResult:
        """Runs it in this process; writes nothing (`JobResult.save` does).

        Raises:
            CfxError: whatever the command line would print and exit 2 for.
        """
        pairs = self.pairs or Pairs.of(self.config.data)
        with visit():
            return compute(self.config, pairs.selected)

    def __repr__(self) -> str:
        chosen = []
        for group in ("data", "model", "policy", "protocol"):
            chosen.append(f"{group}={getattr(self.config, group)['name']}")
        return f"Experiment({', '.join(chosen)}, seed={self.config.seed})"


def config(pairs: PairsLike | None = None, /, **settings: Any) -> Experiment:
    """Composes the configuration of an experiment, without running it.

    Args:
        pairs: what it runs on, as `cfx.read` takes it; None: what `data` says.
        settings: as on the command line: the components (`model="w99"`, `experiment="adaptive"`)
            and settings (`seed=1`); those within a component as `**{"learner.epochs": 20}`.

    Raises:
        CfxError: a name or a value is wrong, in one sentence.

    Examples:
        >>> import cfx
        >>> experiment = cfx.config(model="krauss", policy="fixed", seed=3)
        >>> experiment.command
        'python -m cfx model=krauss policy=fixed seed=3'
    """
    with visit():
        found = config_of(settings)
        if pairs is None:
            return Experiment(found)
        recording = pairs_from(pairs)
        return Experiment(with_data(found, recording), recording)


def from_config(job: str | Path) -> Experiment:
    """Reads the configuration of a finished job, to look at it, change it or run it again.

    Args:
        job: a job's folder or the URL of its copy, the id of its MLflow run, or a `config.yaml`.

    Raises:
        DataError: there is no such job, or it has no configuration that this version knows.
    """
    path = Path(job)
    if path.suffix not in {".yaml", ".yml"}:
        path = folder_of(job) / "config.yaml"
    return Experiment(read_config(path))


def with_data(config: JobConfig, pairs: Pairs) -> JobConfig:
    """Returns a configuration whose dataset is that of pairs."""
    return JobConfig.of({**config.model_dump(), "data": dict(pairs.node)})
