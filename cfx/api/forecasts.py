"""Forecasts from Python: where drivers will be, from one moment of their trajectories on.

Shapes: P pairs, S paths of each, K steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from cfx.api.experiment import PolicyLike, config, in_folder, settings_of
from cfx.api.pairs import PairIds, PairsLike, chosen_names, pairs_from, without_data
from cfx.core.guest import visit
from cfx.errors import ConfigError
from cfx.policies.known_drivers import base_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch
    from matplotlib.figure import Figure
    from torch import Tensor

    from cfx.evaluation.forecasts import LeaderFuture, Origins, Paths
    from cfx.evaluation.protocols.base import ProtocolContext
    from cfx.policies.agent import Agent


@dataclass(frozen=True, repr=False)
class Forecast:
    """Paths of drivers from one moment on; `cfx.forecast` makes it.

    Attributes:
        paths: a row per pair, path and frame: pair_id, path (from 0), time_s (from the pair's first
            frame), speed (m/s), travelled (m since the moment).
        measured: what the drivers did, as far as it was recorded: pair_id, time_s, speed,
            travelled.
    """

    paths: pd.DataFrame
    measured: pd.DataFrame

    def quantiles(self, levels: Sequence[float] = (0.05, 0.5, 0.95)) -> pd.DataFrame:
        """Returns quantiles of speed and travelled over the paths, by pair and time.

        Returns:
            Index pair_id, time_s and quantile; columns speed (m/s) and travelled (m).
        """
        grouped = self.paths.groupby(["pair_id", "time_s"])[["speed", "travelled"]]
        table: pd.DataFrame = grouped.quantile(np.array(levels))
        return table.rename_axis(index=["pair_id", "time_s", "quantile"])

    def plot(self, pair_ids: PairIds | None = None) -> Figure:
        """Draws fans of paths and what happened; returns the figure.

        Args:
            pair_ids: which; None: the first three.
        """
        from cfx.api.figures import draw_fans
        from cfx.figures.drawing import for_notebooks

        pairs_known = list(self.paths["pair_id"].unique())
        chosen = (
            pairs_known[:3]
            if pair_ids is None
            else chosen_names(pair_ids, pairs_known, "the forecast")
        )
        return for_notebooks(draw_fans(chosen, self.quantiles(), self.measured))

    def __repr__(self) -> str:
        pairs = self.paths["pair_id"].nunique()
        return f"Forecast({pairs} pairs, {self.paths['path'].nunique()} paths each)"

    def _repr_html_(self) -> str:
        from cfx.figures.drawing import as_html

        return as_html(repr(self), self.quantiles())


def forecast(
    policy: PolicyLike,
    pairs: PairsLike,
    *,
    at: float,
    horizon: float = 10.0,
    samples: int = 0,
    leader: LeaderFuture = "given",
    seed: int = 0,
    **settings: Any,
) -> Forecast:
    """Forecasts drivers from one moment of each trajectory, as `protocol=forecast` does from many.

    Of the follower nothing after the moment is read. For errors over many moments, with intervals
    over drivers, call `cfx.evaluate(policy, pairs, protocol="forecast")`.

    Args:
        policy: as for `cfx.evaluate`.
        pairs: as `cfx.read` takes them; pairs that the policy learned from are refused.
        at: the moment, s after each pair's first frame; what was measured before is the history.
        horizon: how far ahead, s.
        samples: paths to draw of each driver, of a stochastic policy; 0: one path, without noise.
        leader: what is known of the leader after the moment: `given` (what they did),
            `constant_speed` or `constant_acceleration`.
        seed: of the draws.
        settings: others of the command line.

    Raises:
        CfxError: a pair is too short, the policy has learned from these pairs, or nothing can be
            drawn of it.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=300)
        >>> policy = "cfx://idm-stochastic"
        >>> future = cfx.forecast(policy, pairs, at=10.0, horizon=2.0, samples=3)
        >>> future
        Forecast(2 pairs, 3 paths each)
        >>> future.quantiles((0.5,)).shape
        (42, 2)
    """
    import torch

    from cfx.app.job import steps
    from cfx.evaluation.closed_loop import Followers
    from cfx.evaluation.forecasts import sample_from_origins

    with in_folder(policy) as folder, visit():
        recording = pairs_from(pairs, settings)
        chosen = {"protocol": "transfer", "seed": seed, **settings_of(settings, folder)}
        experiment = config(recording, **without_data(chosen))
        _, components, context = steps.without_files(experiment.config, recording.selected)
        finished = cast(Any, components.protocol).finished
        finished.check(context.pairs)
        agent: Agent = finished.agent.to(context.batch.lengths.device)
        if samples and not agent.core.head.is_stochastic:
            raise ConfigError(
                f"samples={samples}: this policy leaves nothing to chance; give samples=0, or train"
                " a stochastic one: cfx.train(pairs, for_='stochastic')"
            )
        origins = _origins(context, at)
        frames = round(_seconds("horizon", horizon, "a duration") / context.batch.dt)
        if frames < 1:
            raise ConfigError(f"horizon={horizon}: give one step of {context.batch.dt:g} s or more")
        generators: list[torch.Generator | None] = []
        for number in range(samples):
            generators.append(torch.Generator().manual_seed(seed * 1_000_003 + number))
        base = None  # what the agent brings
        if agent.base is not None and agent.context_rule.driver_specific:
            calibrated = context.calibrator.driver_specific(
                context.pairs, context.batch, origins.frame.cpu()
            )
            base = base_of(agent, calibrated)[:, : calibrated.shape[1]]
        network = torch.zeros_like(origins.pair)
        followers = Followers(context.batch, network, base, agent.context_rule.history_s)
        paths = sample_from_origins(
            context.stepper,
            agent,
            followers,
            origins,
            frames,
            generators or [None],
            leader=leader,
        )
        return _tables(context, origins, paths, known_to_the_end=leader != "given")


def _origins(context: ProtocolContext, at: float) -> Origins:
    """Returns the same moment of each pair."""
    import torch

    from cfx.evaluation.forecasts import Origins

    batch = context.batch
    frame = round(_seconds("at", at, "a moment") / batch.dt)
    for pair in context.pairs:
        if not 1 <= frame < len(pair) - 1:
            raise ConfigError(
                f"at={at:g}: pair '{pair.pair_id}' lasts {(len(pair) - 1) * pair.dt:g} s; give a"
                " moment within every pair, or read longer ones (min_duration)"
            )
    everyone = torch.arange(len(batch), device=batch.lengths.device)
    return Origins(everyone, torch.full_like(everyone, frame))


def _seconds(name: str, value: Any, what: str) -> float:
    """Returns a number of seconds.

    Args:
        name: of the argument.
        value: that was given.
        what: it is, for the message.

    Raises:
        ConfigError: it is no finite number.
    """
    if isinstance(value, Real) and math.isfinite(value):
        return float(value)
    raise ConfigError(f"{name}={value}: give {what} in seconds")


def _tables(
    context: ProtocolContext, origins: Origins, sampled: Paths, *, known_to_the_end: bool
) -> Forecast:
    """Returns paths `(S, P, K + 1)`, and what happened, as tables.

    `known_to_the_end`: there is a leader beyond the end of a recording.
    """
    from cfx.evaluation.forecasts import measured_paths

    steps = sampled.speed.shape[-1] - 1
    happened, recorded = measured_paths(context.batch, origins, steps)
    is_recorded = recorded.cpu().numpy().ravel()
    dt = context.batch.dt
    time = (int(origins.frame[0]) + np.arange(steps + 1)) * dt
    ids = context.pairs.ids
    paths = []
    for number in range(len(sampled.speed)):
        table = _long(ids, time, sampled.speed[number], sampled.travelled[number])
        table.insert(1, "path", number)
        paths.append(table if known_to_the_end else table[is_recorded])
    measured = _long(ids, time, happened.speed, happened.travelled)
    return Forecast(
        pd.concat(paths, ignore_index=True), measured[is_recorded].reset_index(drop=True)
    )


def _long(ids: list[str], time: np.ndarray, speed: Tensor, travelled: Tensor) -> pd.DataFrame:
    """Returns signals `(P, K + 1)` as a row per pair and frame."""
    return pd.DataFrame(
        {
            "pair_id": np.repeat(np.array(ids, dtype=object), len(time)),
            "time_s": np.tile(time, len(ids)),
            "speed": speed.cpu().numpy().ravel(),
            "travelled": travelled.cpu().numpy().ravel(),
        }
    )
