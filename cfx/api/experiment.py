"""Jobs from Python: configurations as the command line composes them, policies, own models."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

from cfx.api.pairs import Pairs, PairsLike, pairs_from, without_data
from cfx.app.job.run import compute
from cfx.app.overrides import command_of, config_of
from cfx.core import registry
from cfx.core.files import IN_MEMORY
from cfx.core.guest import visit
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.results.config import JobConfig
from cfx.results.folder import read_config
from cfx.results.result import Result
from cfx.results.tracker import folder_of


class HasPolicy(Protocol):
    """What has a policy in memory: a fit, whose policy is its pooled parameters."""

    @property
    def policy(self) -> Agent:
        """The policy, ready for another trajectory."""


PolicyLike = HasPolicy | Result | Agent | str | Path
"""A policy: a result that has one, the policy itself, a job's folder, or `cfx://NAME`."""

M = TypeVar("M", bound=DrivingModel)


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

    def run(self) -> Result:
        """Runs it in this process; writes nothing (`Result.save` does).

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
            and settings (`seed=1`); those within a component as `**{"learner.epochs": 20}`, those
            of reading a file as `**{"data.max_pairs": 20}`.

    Raises:
        CfxError: a name or a value is wrong, in one sentence.

    Examples:
        >>> import cfx
        >>> experiment = cfx.config(model="krauss", policy="fixed", seed=3)
        >>> experiment.command
        'python -m cfx model=krauss policy=fixed seed=3'
    """
    with visit():
        if pairs is None:
            return Experiment(config_of(settings))
        recording = pairs_from(pairs, settings)
        composed = config_of(without_data(settings))
        node = {"data": dict(recording.node)}
        return Experiment(JobConfig.of({**composed.model_dump(), **node}), recording)


def from_config(job: Result | str | Path) -> Experiment:
    """Reads the configuration of a finished job, to look at it, change it or run it again.

    Args:
        job: a result, a job's folder or the URL of its copy, the id of its MLflow run, or a
            `config.yaml`.

    Raises:
        DataError: there is no such job, or it has no configuration that this version knows.
    """
    if isinstance(job, Result):
        return Experiment(JobConfig.of(job.config))
    path = Path(job)
    if path.suffix not in {".yaml", ".yml"}:
        path = folder_of(job) / "config.yaml"
    return Experiment(read_config(path))


def train(
    pairs: PairsLike,
    model: str = "idm",
    *,
    for_: str = "unseen_drivers",
    seed: int = 0,
    **settings: Any,
) -> Result:
    """Trains a policy that adapts a model's parameters, as `experiment=FOR_ model=MODEL` does.

    It takes minutes. The drivers are divided into folds, and each is tested by a network that
    learned nothing from them. So the result says how well the policy drives unseen drivers; its
    `policy` holds one more network, which learned from all, for others. Nothing is written:
    `result.save("outputs/mine")` does, and `cfx.load` reads it back.

    Args:
        pairs: as `cfx.read` takes them.
        model: as after `model=`.
        for_: whom it is for, as after `experiment=`: `unseen_drivers`, `with_history`,
            `stochastic` and so on.
        seed: the same seed gives the same policy.
        settings: others of the command line: `policy="lstm"`, `**{"learner.epochs": 20}`.

    Raises:
        CfxError: the pairs or a setting are wrong, in one sentence.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=4, frames=300)
        >>> small = {"learner.epochs": 1, "learner.ensemble_size": 1, "protocol.folds": 2}
        >>> small |= {"optimizer": "random", "optimizer.samples": 64, "calibration.prior": "weak"}
        >>> result = cfx.train(pairs, "idm", **small)
        >>> sorted(result.pairs["method"].unique())
        ['default', 'driver_specific', 'policy', 'pooled']
        >>> result.improvement(over="pooled").index[0]
        'geometric'
    """
    refuse_unused(settings, {**NOTHING_KEPT, "experiment": "give it as for_=NAME"})
    recording, others = pairs_from(pairs, settings), without_data(settings)
    return config(recording, experiment=for_, model=model, seed=seed, **others).run()


def evaluate(policy: PolicyLike, pairs: PairsLike, *, seed: int = 0, **settings: Any) -> Result:
    """Tests a policy on drivers that it has not learned from, as `protocol=transfer` does.

    It is compared with the model's default parameters, with the pooled ones that it brings, and
    with each driver's own, calibrated on the first part of their trajectory here.

    Args:
        policy: what `cfx.train`, `cfx.calibrate` or `cfx.load` returned, a job's folder, or
            `cfx://NAME`. Of a fit its pooled parameters drive, the same for every driver.
        pairs: as `cfx.read` takes them; pairs that the policy learned from are refused.
        seed: of calibration and of intervals.
        settings: others of the command line: `protocol="forecast"`, `optimizer="random"`;
            `objective` is that of the fit or the job, if it is left out.

    Returns:
        `pairs` has a row per pair and method; `improvement()` and `plot()` summarise them.

    Raises:
        CfxError: the policy has learned from these pairs or drives in other time steps, or a
            setting is wrong.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=300)
        >>> result = cfx.evaluate("cfx://idm", pairs, optimizer="random")
        >>> result.pairs.shape[0]
        8
    """
    objective = {} if "objective" in settings else _objective_of(policy)
    with in_folder(policy) as folder:
        chosen = {"protocol": "transfer", "seed": seed, **settings_of(settings, folder)}
        return config(pairs_from(pairs, settings), **objective, **without_data(chosen)).run()


def _objective_of(policy: PolicyLike) -> dict[str, Any]:
    """Returns the settings of the objective of a fit, a result or a job; {} if it is not known."""
    if isinstance(policy, str | Path):
        file = folder_of(policy) / "config.yaml"
        node = read_config(file).objective if file.is_file() else {}
    elif isinstance(policy, Result):
        node = policy.config.get("objective", {})
    else:
        of_fit: Experiment | None = getattr(policy, "experiment", None)
        node = {} if of_fit is None else of_fit.config.objective
    objective: dict[str, Any] = {}
    for key, value in node.items():
        objective["objective" if key == "name" else f"objective.{key}"] = value
    return objective


NOTHING_KEPT = {
    "cache": "calibrations are kept by jobs alone",
    "tracking": "MLflow is told of jobs alone",
    "output": "nothing is written or printed",
    "hydra": "nothing is written, and no jobs are started",
    "failed_value": "it is what a multirun is told",
    "demo": "it is what a job on the command line shows",
}
"""Settings that do nothing in a call of Python, and why."""


def refuse_unused(settings: Mapping[str, Any], unused: Mapping[str, str]) -> None:
    """Refuses settings of a call that would do nothing.

    Args:
        settings: of the call.
        unused: groups and settings, and why they do nothing.

    Raises:
        ConfigError: one of them is given.
    """
    for key, value in settings.items():
        reason = unused.get(key) or unused.get(key.partition(".")[0])
        if reason is not None:
            raise ConfigError(f"{key}={value} does nothing here: {reason}; leave it out")


def settings_of(settings: Mapping[str, Any], folder: str) -> dict[str, Any]:
    """Returns the settings of a call that tests the policy in a folder.

    Raises:
        ConfigError: one of them is the policy's own, or does nothing.
    """
    for key in settings:
        if key.partition(".")[0] in {"model", "policy", "windows"}:
            raise ConfigError(
                f"{key}: the policy brings its model, its network and its windows; leave it out"
            )
    refuse_unused(settings, {**NOTHING_KEPT, "learner": "the policy has been trained already"})
    return {**settings, "protocol.run": folder}


@contextmanager
def in_folder(policy: PolicyLike) -> Iterator[str]:
    """Gives the block the folder of a policy; one that is in memory alone is written for it.

    Raises:
        DataError: there is no such policy.
    """
    if isinstance(policy, Result) and policy.folder is not None:
        policy = policy.folder
    if isinstance(policy, str | Path):
        folder_of(policy)  # says that it is not there
        yield str(policy)
        return
    agent = policy if isinstance(policy, Agent) else policy.policy
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, IN_MEMORY)
        checkpoint.save_agent(agent, folder / "policy")
        yield str(folder)


def model(name: str) -> Callable[[type[M]], type[M]]:
    """Makes a class a driving model that this process knows by a name, until it ends.

    It then is a model like all others: `cfx.calibrate(pairs, "mine")`, `cfx.run(["model=mine"])`.
    Defining it again replaces it. To share it, write a package: `cfx plugins new model mine`.

    Args:
        name: as after `model=`; not that of an installed model.

    Raises:
        PluginError: an installed model has that name, or the class does not say what a model says
            (`cfx.plugin.DrivingModel`).

    Examples:
        >>> import cfx
        >>> @cfx.model("constant_gap")
        ... class ConstantGap(cfx.plugin.DrivingModel):
        ...     "Approaches a gap that does not depend on speed."
        ...     parameters = cfx.plugin.ParameterSpace.of(
        ...         cfx.plugin.Parameter("s0", "m", 1.0, 50.0, 20.0, "gap"),
        ...         cfx.plugin.Parameter("k", "1/s2", 0.01, 1.0, 0.1, "stiffness"),
        ...     )
        ...
        ...     def next_speed(self, follower, leader, p, dt):
        ...         gap = cfx.plugin.bumper_gap(follower, leader)
        ...         approach = leader.speed - follower.speed
        ...         acceleration = p["k"] * (gap - p["s0"]) + approach
        ...         return (follower.speed + acceleration * dt).clamp(min=0.0)
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=200)
        >>> cfx.calibrate(pairs, "constant_gap", optimizer="random").parameters.columns.tolist()
        ['s0', 'k']
    """

    def register(cls: type[M]) -> type[M]:
        registry.add("model", name, cls)
        return cls

    return register
