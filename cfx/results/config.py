"""The configuration of a job as one frozen object.

Nothing below the command line knows where it came from.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from cfx.calibration.settings import CalibrationSettings
from cfx.core.component import Distinct, Settings, each_once, validate
from cfx.core.storage import is_url
from cfx.data.style import StyleSettings
from cfx.errors import ConfigError, without_passwords
from cfx.simulation.settings import WindowSettings

Node = dict[str, Any]
"""A component's node, `{name: ..., settings...}`: `cfx.core.registry.create` validates it against
the component's own schema."""


class CacheSettings(Settings):
    """Where calibrations are kept, so that each is done once."""

    enabled: bool = Field(True, description="read and write the cache")
    folder: Path | str = Field(
        Path("outputs/cache"), description="where it lies: a path, or a URL such as s3://bucket/cfx"
    )

    @field_validator("folder", mode="before")
    @classmethod
    def _path_or_url(cls, folder: Any) -> Any:
        if not isinstance(folder, str | Path) or not str(folder).strip():
            raise ValueError("write a folder or a URL; cache.enabled=false keeps nothing")
        if isinstance(folder, str) and not is_url(folder):
            return Path(folder)
        return folder


SAYS_TOO_MUCH = (
    "holds a password, and a job's configuration is written to files and to MLflow; put the URI"
    " into the environment variable MLFLOW_TRACKING_URI instead"
)
"""What is said of a tracking URI that holds one."""


class OutputSettings(Settings):
    """What a job prints, and where its folder is copied to."""

    verbose: bool = Field(
        False,
        description="print all that was measured, not one table and one sentence; --verbose says"
        " the same",
    )

    url: str | None = Field(
        None,
        description="the job's folder is copied below this URL when it is done, such as"
        " s3://bucket/jobs; null: it stays on this machine alone",
    )

    @field_validator("url")
    @classmethod
    def _is_url(cls, url: str | None) -> str | None:
        if url is None:
            return None
        if not is_url(url):
            raise ValueError("write a URL such as s3://bucket/jobs; hydra.run.dir names a folder")
        if without_passwords(url) != url:
            raise ValueError("holds a password, and a job's configuration is written to files")
        return url


class TrackingSettings(Settings):
    """Where a job is tracked."""

    enabled: bool = Field(True, description="log the job")
    name: str = Field("mlflow", description="where: mlflow, or a plugin's")
    uri: str | None = Field(
        None,
        description="this job's tracking store; null: MLFLOW_TRACKING_URI, or SQLite beside the"
        " outputs",
    )
    experiment: str = Field("cfx", min_length=1, description="MLflow's experiment")

    @field_validator("uri")
    @classmethod
    def _no_password(cls, uri: str | None) -> str | None:
        if uri is not None and without_passwords(uri) != uri:
            raise ValueError(SAYS_TOO_MUCH)
        return uri

    sweep: str | None = Field(
        None, description="name that the jobs of a multirun share: they get a common parent run"
    )


_CONSTANT = ("fixed", "default")
"""Policies of cfx that keep parameters constant: such a job is a calibration."""


Chosen = Literal["own", "all"] | tuple[str, ...]
"""Which metrics, tables or figures of those that are installed."""


class JobNodes(Settings):
    """The components that a job is made of, each by its node."""

    data: Node = Field(description="the dataset's node")
    model: Node = Field(description="the driving model's node")
    policy: Node = Field(description="the policy's node")
    optimizer: Node = Field(description="the optimizer's node")
    objective: Node = Field({"name": "speed_rmse"}, description="the objective's node")
    learner: Node = Field(description="the learner's node")
    protocol: Node = Field(description="the protocol's node")
    simulator: Node = Field({"name": "memory"}, description="the simulator's node")
    engine: Node = Field({"name": "local"}, description="the engine's node")
    demo: Node | None = Field(None, description="the demonstration's node; null: there is none")
    metrics: Chosen = Field(
        "own",
        description="what is measured: own: cfx's own; all: all that are installed; or a list of"
        " names, in which own may stand",
    )
    tables: Chosen = Field(
        "own",
        description="which tables are written: own: cfx's own, and those of the plugins whose"
        " components the job has; all: all that are installed; or a list of names, in which own may"
        " stand",
    )

    figures: Literal["none"] | Chosen = Field(
        "own",
        description="which figures are drawn: own: the usual ones of cfx, and those of the plugins"
        " whose components the job has; all: all that are installed; none; or a list of names, in"
        " which own may stand",
    )

    @field_validator("figures", mode="before")
    @classmethod
    def _figures(cls, chosen: Any) -> Any:
        return chosen if chosen == "none" else cls._several(chosen)

    @field_validator("metrics", "tables", mode="before")
    @classmethod
    def _several(cls, chosen: Any) -> Any:
        if isinstance(chosen, str) and chosen not in {"own", "all"}:
            chosen = (chosen,)
        if not chosen or not isinstance(chosen, str | list | tuple):
            raise ValueError("write own, all, or a list of names such as [own, NAME]")
        return chosen if isinstance(chosen, str) else each_once(chosen)


class JobResources(Settings):
    """What a job computes with."""

    seed: int = Field(0, ge=0, lt=2**32, description="seed of everything random")
    device: str = Field("auto", description="auto, cpu, cuda or cuda:N")
    dtype: Literal["float32", "float64"] = Field("float64", description="precision of simulations")
    cores: int | None = Field(
        None,
        ge=1,
        description="cores that calibration and training share their work among; null: all",
    )
    threads: int | None = Field(1, ge=1, description="torch's threads; null: torch's own choice")
    cache: CacheSettings = Field(CacheSettings(), description="cache of calibrations")

    @field_validator("device")
    @classmethod
    def _known(cls, device: str) -> str:
        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", device):
            raise ValueError("choose auto, cpu, cuda or cuda:N")
        return device


class JobRecords(Settings):
    """Where a job's results go."""

    output: OutputSettings = Field(OutputSettings(), description="where results go")
    tracking: TrackingSettings = Field(TrackingSettings(), description="where jobs are tracked")
    figure_formats: Distinct[tuple[Literal["png", "pdf", "svg"], ...]] = Field(
        ("png",), min_length=1, description="files of each figure; pdf and svg for a paper"
    )
    failed_value: Annotated[float, Field(ge=float("-inf"), allow_inf_nan=True)] | None = Field(
        None,
        description="what a sweeper that optimises is told if this job fails, such as inf; null:"
        " that it failed",
    )


class JobConfig(JobNodes, JobResources, JobRecords):
    """Everything that one job needs to know; `conf/config.yaml` says the same in YAML."""

    preset: str | None = Field(
        None, description="the experiment that these settings come from; a report reads it"
    )
    split: float = Field(
        0.8,
        gt=0,
        le=1,
        description="share of each pair that is calibrated and learned on; 1: all of it, of a"
        " calibration alone",
    )
    windows: WindowSettings = Field(WindowSettings(), description="how trajectories are cut")
    calibration: CalibrationSettings = Field(
        CalibrationSettings(), description="how constant parameters are calibrated"
    )
    style: StyleSettings = Field(StyleSettings(), description="driving style")

    @property
    def is_calibration(self) -> bool:
        """Whether its policy is one of cfx's that keep parameters constant."""
        return self.policy.get("name") in _CONSTANT

    def in_words(self) -> str:
        """Returns which components the job is made of, "Model idm, policy gru, ..."."""
        groups = ("model", "policy", "learner", "protocol", "data")
        if self.is_calibration:
            groups = ("model", "objective", "optimizer", "protocol", "data")
        components = []
        for group in groups:
            name = getattr(self, group).get("name")
            components.append(f"{group} {name}")
        text = ", ".join(components)
        return f"{text[:1].upper()}{text[1:]}"

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> JobConfig:
        """Validates a resolved configuration.

        Raises:
            ConfigError: one sentence for each key that is wrong, with its full path.
        """
        if not isinstance(values, Mapping):
            raise ConfigError(
                f"a configuration is a mapping of keys to values, not {type(values).__name__}"
            )
        return validate(cls, values, where="")
