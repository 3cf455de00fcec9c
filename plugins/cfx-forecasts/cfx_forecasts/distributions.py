"""How good sampled forecasts are as distributions: proper scores, coverage, likelihoods.

People do not repeat themselves, so a forecast may say what could happen, by paths that are sampled.
A proper score is smallest, in the mean, for the distribution that reality is drawn from (T.
Gneiting and A. E. Raftery, 2007, *Strictly proper scoring rules, prediction, and estimation*, JASA
102). The scores are those of the library `scoringrules`, with its fair estimators, which do not
depend on how many paths are sampled.

A method that gives one path is scored too: its CRPS is its absolute error.

Shapes: Q origins, S sampled paths, K steps. SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.plugin import PairBatch, PairSet, forecasts

Array = NDArray[np.float64]

LEVEL = 0.9
"""Share of what happens that the interval of `coverage` should hold."""

_OF_SIX = 6
"""Paths of which `min_ade` takes the best, as in Waymo's motion prediction challenge."""

_ENERGY_STEP_S = 0.5
"""Time between the points of a path in its energy score."""

_SCORED_AT_ONCE = 256
"""Origins whose paths are compared with one another at once, which bounds the memory."""

_PSEUDO_COUNT = 0.1
"""Added to each bin of a histogram, so that what was never sampled has some likelihood."""

SCORES = {
    "crps_speed": (
        "m/s",
        "CRPS of speed at the horizon; the absolute error where one path is given",
    ),
    "crps_gap": ("m", "CRPS of the gap at the horizon"),
    "energy_speed": ("m/s", "energy score of the path of speeds up to the horizon, per point"),
    "coverage": ("1", "share of origins whose speed lies in the central 90 % of the sampled ones"),
    "min_ade": ("m", "absolute error of position up to the horizon, the best of six paths"),
}
"""Scores by name: unit and meaning."""

LIKELIHOODS: Mapping[str, tuple[float, float, int]] = {
    "speed": (0.0, 30.0, 30),
    "gap": (0.0, 60.0, 30),
    "acceleration": (-4.0, 4.0, 32),
    "jerk": (-8.0, 8.0, 32),
    "time_to_collision": (0.0, 10.0, 20),
}
"""Signals whose likelihood is measured: range and bins of their histograms. Values beyond the range
count in the outer bins. The ranges are those of car following in congestion, narrower than those
that Waymo's challenge has for all agents: with its bins, of 2.2 m/s2 each, nearly all
accelerations of followers lie in one."""

DISTRIBUTION_COLUMNS = (
    "pair_id",
    "driver",
    "method",
    "horizon_s",
    *SCORES,
    "pit",
    *(f"likelihood_{name}" for name in LIKELIHOODS),
)
"""Columns of the table of scores, which a job writes as `distributions.parquet`. `pit` is the share
of sampled speeds below the one that happened: uniform for a calibrated method. Likelihoods are over
the whole path up to the horizon."""


class Sampled(NamedTuple):
    """Sampled paths of Q origins, frame 0 being the origin.

    Attributes:
        speed: `(S, Q, K + 1)`, m/s.
        travelled: `(S, Q, K + 1)`, m since the origin.
    """

    speed: Array
    travelled: Array

    @classmethod
    def of(cls, paths: forecasts.Paths) -> Sampled:
        """Takes paths `(S, Q, K + 1)`, or single ones `(Q, K + 1)`."""
        speed = np.asarray(paths.speed.double().cpu().numpy())
        travelled = np.asarray(paths.travelled.double().cpu().numpy())
        if speed.ndim == 2:
            speed, travelled = speed[None], travelled[None]
        return cls(speed, travelled)


class Recorded(NamedTuple):
    """What happened after Q origins.

    Attributes:
        speed, travelled: `(Q, K + 1)`.
        gap: at the origin, `(Q,)`, m.
        leader_speed: `(Q, K + 1)`, m/s.
        leader_travelled: `(Q, K + 1)`, m since the origin.
        exists: which frames were recorded, bool `(Q, K + 1)`.
    """

    speed: Array
    travelled: Array
    gap: Array
    leader_speed: Array
    leader_travelled: Array
    exists: NDArray[np.bool_]

    @classmethod
    def of(
        cls, batch: PairBatch, origins: forecasts.Origins, measured: forecasts.Paths, exists: object
    ) -> Recorded:
        """Takes what followers did (`measured_paths`), and looks up their leaders."""
        steps = measured.speed.shape[1]
        frames = np.arange(steps) + origins.frame.cpu().numpy()[:, None]
        index = frames.clip(max=batch.mask.shape[1] - 1)
        pair = origins.pair.cpu().numpy()
        position = batch.leader_position.double().cpu().numpy()[pair[:, None], index]
        return cls(
            speed=np.asarray(measured.speed.double().cpu().numpy()),
            travelled=np.asarray(measured.travelled.double().cpu().numpy()),
            gap=batch.gap.double().cpu().numpy()[pair, index[:, 0]],
            leader_speed=batch.leader_speed.double().cpu().numpy()[pair[:, None], index],
            leader_travelled=position - position[:, :1],
            exists=np.asarray(exists),
        )

    def only(self, chosen: NDArray[np.bool_]) -> Recorded:
        """Returns some of the origins, bool `(Q,)`."""
        return Recorded(
            self.speed[chosen],
            self.travelled[chosen],
            self.gap[chosen],
            self.leader_speed[chosen],
            self.leader_travelled[chosen],
            self.exists[chosen],
        )


def score_distributions(
    pairs: PairSet,
    origins: forecasts.Origins,
    paths: Mapping[str, forecasts.Paths],
    recorded: Recorded,
    horizons: Sequence[float],
    dt: float,
) -> pd.DataFrame:
    """Scores the forecasts of several methods against what happened.

    Args:
        pairs: P pairs.
        origins: Q of them.
        paths: by method, sampled `(S, Q, K + 1)` or single ones `(Q, K + 1)`.
        recorded: what happened.
        horizons: s.
        dt: time step, s.

    Returns:
        A row per origin, method and horizon that the recording lasts to, with the columns
        `DISTRIBUTION_COLUMNS`.
    """
    first = origins.columns(pairs)
    parts = []
    for method, path in paths.items():
        sampled = Sampled.of(path)
        for horizon in horizons:
            step = round(horizon / dt)
            exists = recorded.exists[:, step]
            if not exists.any():  # no recording lasts as long
                continue
            columns: dict[str, object] = {name: column[exists] for name, column in first.items()}
            columns |= {"method": method, "horizon_s": float(horizon)}
            here = Sampled(sampled.speed[:, exists], sampled.travelled[:, exists])
            there = recorded.only(exists)
            columns |= _scores(here, there, step, dt)
            parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)[list(DISTRIBUTION_COLUMNS)]


def summarize_distributions(table: pd.DataFrame) -> pd.DataFrame:
    """Returns the mean over drivers of each driver's mean over origins.

    Args:
        table: as `score_distributions` returns it.

    Returns:
        A row per method and horizon, with a column for each score and likelihood.
    """
    values = [column for column in DISTRIBUTION_COLUMNS[4:] if column != "pit"]
    of_driver = table.groupby(["method", "horizon_s", "driver"], sort=False)[values].mean()
    return of_driver.groupby(["method", "horizon_s"], sort=False).mean().reset_index()


def distribution_metrics(table: pd.DataFrame) -> dict[str, float]:
    """Returns scores under their names in metrics.json, `distribution/SCORE_HORIZON/METHOD`.

    What is not defined is left out, as the coverage of one path.
    """
    metrics = {}
    for row in summarize_distributions(table).to_dict("records"):
        for column, value in row.items():
            if column in ("method", "horizon_s") or not np.isfinite(value):
                continue
            metrics[f"distribution/{column}_{row['horizon_s']:g}s/{row['method']}"] = float(value)
    return metrics


def sampled_methods(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns the methods of which several paths were sampled, the policy last.

    Args:
        table: as `score_distributions` returns it.
    """
    several = table[table["coverage"].notna()]["method"].astype(str).unique().tolist()
    return tuple(sorted(several, key=lambda method: method == "policy"))


def centre_errors(table: pd.DataFrame) -> pd.DataFrame:
    """Returns the absolute error of speed of the policy where nothing is drawn.

    It is what the CRPS of a distribution is that has no width.

    Args:
        table: of single forecasts.

    Returns:
        A row per horizon: horizon_s, crps_speed (m/s; mean over drivers of each driver's mean over
        origins).
    """
    rows = table[table["method"] == "policy"]
    rows = rows.assign(crps_speed=rows["speed_error"].abs())
    of_driver = rows.groupby(["horizon_s", "driver"], sort=True)["crps_speed"].mean()
    return of_driver.groupby("horizon_s").mean().reset_index()


def _scores(sampled: Sampled, recorded: Recorded, step: int, dt: float) -> dict[str, Array]:
    """Returns the scores at one step, `(Q,)` each."""
    speed, truth = sampled.speed[:, :, step], recorded.speed[:, step]
    off = np.abs(sampled.travelled - recorded.travelled)[:_OF_SIX, :, 1 : step + 1]
    scores = {
        "crps_speed": _crps(speed, truth),
        # Behind a given leader an error of the gap is one of the distance travelled.
        "crps_gap": _crps(sampled.travelled[:, :, step], recorded.travelled[:, step]),
        "energy_speed": _energy(sampled.speed, recorded.speed, step, dt),
        "coverage": _covered(speed, truth),
        "min_ade": off.mean(-1).min(0),
        "pit": _pit(speed, truth),
    }
    simulated = _signals(sampled.speed, sampled.travelled, recorded, step, dt)
    happened = _signals(recorded.speed[None], recorded.travelled[None], recorded, step, dt)
    for name, (low, high, bins) in LIKELIHOODS.items():
        edges = np.linspace(low, high, bins + 1)[1:-1]
        scores[f"likelihood_{name}"] = _likelihood(simulated[name], happened[name][0], edges)
    return scores


def _crps(sampled: Array, truth: Array) -> Array:
    """Returns the CRPS `(Q,)` of samples `(S, Q)`."""
    import scoringrules

    if len(sampled) == 1:
        return np.asarray(np.abs(sampled[0] - truth))
    crps = scoringrules.crps_ensemble(truth, sampled, m_axis=0, estimator="fair", backend="numpy")
    return np.asarray(crps)


def _energy(sampled: Array, truth: Array, step: int, dt: float) -> Array:
    """Returns the energy score `(Q,)` of paths `(S, Q, K + 1)`, over the root of their points."""
    import scoringrules

    every = max(1, round(_ENERGY_STEP_S / dt))
    points = np.arange(step, 0, -every)[::-1]
    paths, path = np.moveaxis(sampled[:, :, points], 0, 1), truth[:, points]
    scale = np.sqrt(len(points))
    if len(sampled) == 1:
        return np.asarray(np.linalg.norm(paths[:, 0] - path, axis=-1) / scale)
    parts = []
    for first in range(0, len(path), _SCORED_AT_ONCE):
        rows = slice(first, first + _SCORED_AT_ONCE)
        parts.append(
            scoringrules.es_ensemble(path[rows], paths[rows], estimator="fair", backend="numpy")
        )
    return np.asarray(np.concatenate(parts) / scale)


def _covered(sampled: Array, truth: Array) -> Array:
    """Says whether the truth lies in the central interval of the samples, 1 or 0; NaN for one."""
    if len(sampled) == 1:
        return np.full(truth.shape, np.nan)
    ends = [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL]
    # Of these quantiles a calibrated method's interval holds `LEVEL` with 19 paths or more: the
    # truth has any rank among the samples with the same probability. Others are too narrow.
    low, high = np.quantile(sampled, ends, axis=0, method="weibull")
    return np.asarray((low <= truth) & (truth <= high), dtype=np.float64)


def _pit(sampled: Array, truth: Array) -> Array:
    """Returns the share of samples below the truth, half of those that equal it."""
    if len(sampled) == 1:
        return np.full(truth.shape, np.nan)
    below, equal = (sampled < truth).mean(0), (sampled == truth).mean(0)
    return np.asarray(below + 0.5 * equal)


def _signals(
    speed: Array, travelled: Array, recorded: Recorded, step: int, dt: float
) -> dict[str, Array]:
    """Returns the signals of `LIKELIHOODS` up to a step, `(S, Q, frames)` each."""
    until = slice(1, step + 1)
    acceleration = np.diff(speed[..., : step + 1], axis=-1) / dt
    gap = recorded.gap[:, None] + (recorded.leader_travelled - travelled)[..., until]
    closing = speed[..., until] - recorded.leader_speed[:, until]
    high = LIKELIHOODS["time_to_collision"][1]
    time = np.where(closing > 0, np.maximum(gap, 0.0) / np.maximum(closing, 1e-6), high)
    return {
        "speed": speed[..., until],
        "gap": gap,
        "acceleration": acceleration,
        "jerk": np.diff(acceleration, axis=-1) / dt,
        "time_to_collision": time,
    }


def _likelihood(simulated: Array, happened: Array, edges: Array) -> Array:
    """Returns the likelihood of what happened under histograms of what was simulated, `(Q,)`.

    One histogram for each origin, over all paths and frames; the likelihood is the geometric mean
    over frames, as in Waymo's sim-agents challenge (N. Montali et al., 2023, *The Waymo open sim
    agents challenge*, NeurIPS, section 4.2, with independent time steps).

    Args:
        simulated: `(S, Q, frames)`.
        happened: `(Q, frames)`.
        edges: between bins, without the outer ones.
    """
    origins, bins = happened.shape[0], len(edges) + 1
    places = np.digitize(simulated, edges) + bins * np.arange(origins)[:, None]
    counts = np.bincount(places.ravel(), minlength=origins * bins).reshape(origins, bins)
    smooth = counts + _PSEUDO_COUNT
    share = smooth / smooth.sum(1, keepdims=True)
    of_each = np.take_along_axis(share, np.digitize(happened, edges), axis=1)
    return np.asarray(np.exp(np.log(of_each).mean(1)))
