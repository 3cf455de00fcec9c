"""Policies from Python: trained, and tested on drivers that nothing was learned from."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cfx.api.experiment import config
from cfx.api.pairs import PairsLike, pairs_from
from cfx.app.job.results import JobResult
from cfx.app.overrides import IN_MEMORY
from cfx.core.errors import ConfigError
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.results.tracker import folder_of

PolicyLike = JobResult | Agent | str | Path
"""A policy: a result that has one, the policy itself, a job's folder, or `cfx://NAME`."""


def train(
    pairs: PairsLike,
    model: str = "idm",
    *,
    for_: str = "unseen_drivers",
    seed: int = 0,
    **settings: Any,
) -> JobResult:
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
        >>> result = cfx.train(pairs, "idm", optimizer="random", **small)
        >>> sorted(result.pairs["method"].unique())
        ['default', 'fixed', 'policy', 'population']
        >>> result.improvement(over="population").index[0]
        'mean'
    """
    return config(pairs_from(pairs), experiment=for_, model=model, seed=seed, **settings).run()


def evaluate(policy: PolicyLike, pairs: PairsLike, *, seed: int = 0, **settings: Any) -> JobResult:
    """Tests a policy on drivers that it has not learned from, as `protocol=transfer` does.

    It is compared with the model's default parameters, with the pooled ones that it brings, and
    with each driver's own, calibrated on the first part of their trajectory here.

    Args:
        policy: what `cfx.train` or `cfx.load` returned, a job's folder, or `cfx://NAME`.
        pairs: as `cfx.read` takes them; pairs that the policy learned from are refused.
        seed: of calibration and of intervals.
        settings: others of the command line: `protocol="forecast"`, `optimizer="random"`.

    Returns:
        `pairs` has a row per pair and method; `improvement()` and `plot()` summarise them.

    Raises:
        CfxError: the policy has learned from these pairs or drives in other time steps, or a
            setting is wrong.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=300)
        >>> result = cfx.evaluate("cfx://i80-idm", pairs, optimizer="random")
        >>> result.pairs.shape[0]
        8
    """
    with in_folder(policy) as folder:
        chosen = {"protocol": "transfer", "seed": seed, **settings_of(settings, folder)}
        return config(pairs_from(pairs), **chosen).run()


def settings_of(settings: Mapping[str, Any], folder: str) -> dict[str, Any]:
    """Returns the settings of a call that tests the policy in a folder.

    Raises:
        ConfigError: one of them is the policy's own.
    """
    for key in settings:
        if key.partition(".")[0] in {"model", "policy", "windows"}:
            raise ConfigError(
                f"{key}: the policy brings its model, its network and its windows; leave it out"
            )
    return {**settings, "protocol.run": folder}


@contextmanager
def in_folder(policy: PolicyLike) -> Iterator[str]:
    """Gives the block the folder of a policy; one that is in memory alone is written for it.

    Raises:
        DataError: there is no such policy.
    """
    if isinstance(policy, JobResult) and policy.folder is not None:
        policy = policy.folder
    if isinstance(policy, str | Path):
        folder_of(policy)  # says that it is not there
        yield str(policy)
        return
    agent = policy.policy if isinstance(policy, JobResult) else policy
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, IN_MEMORY)
        checkpoint.save(agent, folder / "policy")
        yield str(folder)
