"""Several rivals in one: their forecasts are mixed with weights for each horizon.

Which rival says best what happens depends on how far ahead: regressions in the first seconds, what
drives in closed loop after them. The training sites are divided in two halves, and members learn
from one half what they forecast of the other: on a road that is new to them, as in the test. There
the weights of each horizon are found, and what the mix leaves unexplained makes its forecasts
distributions. Then the members learn from everybody.

Differences from the papers: Breiman's folds are two halves of the sites here, since members may
take minutes to learn; the errors that dress a forecast are those of similar moments, as in analog
ensembles (Delle Monache et al. 2013, Monthly Weather Review 141), not of all.

Shapes: Q moments, M members, H horizons, S samples. SI units.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import nnls
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import PairBatch, PairSet, Settings, registry
from cfx_report.benchmark.rival import Driver, Rival
from cfx_report.benchmark.segments import Segments, moments
from cfx_report.rivals.lagged import HORIZONS_S, between_horizons, divided, mean_error

Floats = NDArray[np.float64]

_PAST_S, _EVERY_S = 10.0, 2.0
"""s before a moment that members may read, as the benchmark gives them, and between moments."""


class StackedSettings(Settings):
    """Settings of stacked rivals."""

    members: tuple[str, ...] = Field(
        ("ridge", "boosting", "direct_gru"),
        min_length=1,
        description="rivals that are mixed, with their default settings",
    )
    similar: int = Field(
        200, ge=2, description="moments of the other half, whose errors dress a forecast"
    )


class Stacked(Rival):
    """Rivals whose forecasts are mixed for each horizon; the one that drives best drives."""

    reference = "Breiman (1996), Stacked regressions, Machine Learning 24, 49-64"
    trains = True
    schema: ClassVar[type[Settings]] = StackedSettings
    settings: StackedSettings

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        """Learns weights from one half of the sites and the other, and then each member from all.

        Raises:
            ConfigError: a member is `stacked` itself, or no rival.
        """
        if "stacked" in self.settings.members:
            raise ConfigError("rival.members: stacked is no member of itself; take it out")
        members = []
        for name in self.settings.members:
            members.append(cast(Rival, registry.create("rival", {"name": name})))
        forecasts = []
        for learned, other in halves(pairs, seed):
            drivers = [member.fit(learned, seed) for member in members]
            forecasts.append(Forecasts.of(drivers, other))
        mixing = Mixing.fitted(Forecasts.joined(forecasts), self.settings.similar)
        return StackedDriver([member.fit(pairs, seed) for member in members], mixing)


class Forecasts(NamedTuple):
    """What members that never saw the drivers say of Q moments of theirs.

    Attributes:
        now: speeds at the moments, `(Q, 1)`, m/s.
        predicted: by each member at each horizon, `(M, Q, H)`, m/s.
        measured: `(Q, H)`, m/s.
        evenness: of each moment at each horizon, as `_evenness` returns it, `(Q, H)`.
        situations: what tells moments apart, `(Q, f)`.
        driving: RMSE of speed of each member over full trajectories, `(M,)`, m/s.
    """

    now: Floats
    predicted: Floats
    measured: Floats
    evenness: Floats
    situations: Floats
    driving: Floats

    @classmethod
    def of(cls, drivers: list[Driver], pairs: PairSet) -> Forecasts:
        """Lets members forecast, and drive, drivers whom they have not learned from.

        Raises:
            ConfigError: no pair lasts as long as a past and the longest horizon.
        """
        driving = np.array([mean_error(driver, pairs) for driver in drivers])
        segments = moments(list(pairs), _PAST_S, _EVERY_S, HORIZONS_S[-1])
        if not len(segments):
            raise ConfigError(
                f"rival=stacked: no pair of a half of the sites lasts {_PAST_S + HORIZONS_S[-1]:g}"
                " s; give longer recordings"
            )
        batch = segments.batch()
        now = _at(batch.follower_speed, segments.first, batch.dt, (0.0,))
        measured = _at(batch.follower_speed, segments.first, batch.dt, HORIZONS_S)
        predicted = _predicted(drivers, segments.blanked(), segments.first)
        even = _evenness(segments, measured - now)
        situations = _situation(batch, segments.first)
        return cls(now, predicted, measured, even, situations, driving)

    @classmethod
    def joined(cls, parts: list[Forecasts]) -> Forecasts:
        """Returns the moments of several parts as one; each part's driving counts alike."""
        return cls(
            np.concatenate([part.now for part in parts]),
            np.concatenate([part.predicted for part in parts], axis=1),
            np.concatenate([part.measured for part in parts]),
            np.concatenate([part.evenness for part in parts]),
            np.concatenate([part.situations for part in parts]),
            np.mean([part.driving for part in parts], axis=0),
        )


class Mixing(NamedTuple):
    """How members are mixed.

    Attributes:
        weights: of each member at each horizon, `(H, M)`, none below zero.
        drives: number of the member that drives best.
        similar: finds moments by what `_situation` returns, divided by `scale`.
        scale: of situations, `(f,)`.
        errors: measured less mixed speeds at these moments, `(Q, H)`, m/s.
    """

    weights: Floats
    drives: int
    similar: NearestNeighbors
    scale: Floats
    errors: Floats

    @classmethod
    def fitted(cls, forecasts: Forecasts, similar: int) -> Mixing:
        """Finds the weights of least squares, none below zero, for each horizon."""
        weights = []
        for horizon in range(len(HORIZONS_S)):
            root = forecasts.evenness[:, horizon]
            predicted = (forecasts.predicted[:, :, horizon].T - forecasts.now) * root[:, None]
            measured = (forecasts.measured[:, horizon] - forecasts.now[:, 0]) * root
            weights.append(nnls(predicted, measured)[0])
        mixed = _mixed(np.array(weights), forecasts.predicted, forecasts.now)
        # What never differs, such as a leader who does not change speed, is not divided by zero.
        scale = forecasts.situations.std(0) + 1e-9
        count = min(similar, len(mixed))
        neighbours = NearestNeighbors(n_neighbors=count).fit(forecasts.situations / scale)
        drives = int(np.argmin(forecasts.driving))
        return cls(np.array(weights), drives, neighbours, scale, forecasts.measured - mixed)


class StackedDriver(Driver):
    """Drives as one member does, and forecasts by all of them.

    Args:
        members: M drivers.
        mixing: how they are mixed.
    """

    def __init__(self, members: list[Driver], mixing: Mixing) -> None:
        self.members = members
        self.mixing = mixing
        self.is_stochastic = True

    def drive(self, batch: PairBatch, first: Tensor, seed: int | None) -> Tensor:
        driver = self.members[self.mixing.drives]
        return driver.drive(batch, first, seed if driver.is_stochastic else None)

    def adapted(self, past: PairSet, seed: int) -> Driver:
        return StackedDriver([member.adapted(past, seed) for member in self.members], self.mixing)

    def forecast(self, batch: PairBatch, first: Tensor, seed: int, samples: int) -> Tensor:
        """Returns the mixed forecast with errors of similar moments, `(S, P, T)`."""
        now = _at(batch.follower_speed, first, batch.dt, (0.0,))
        mixed = _mixed(self.mixing.weights, _predicted(self.members, batch, first), now)
        situations = _situation(batch, first) / self.mixing.scale
        nearest = self.mixing.similar.kneighbors(situations, return_distance=False)
        random = np.random.default_rng(seed)
        drawn = random.permuted(nearest, axis=1)[:, np.arange(samples) % nearest.shape[1]]
        knots = np.maximum(mixed[:, None] + self.mixing.errors[drawn], 0.0)
        paths = []
        for sample in range(samples):
            path = np.concatenate([now, knots[:, sample]], 1)
            paths.append(between_horizons(path, batch, first))
        return torch.as_tensor(np.stack(paths))


def _at(signal: Tensor, first: Tensor, dt: float, seconds: tuple[float, ...]) -> Floats:
    """Returns a signal `(Q, T)` so many seconds after moments, `(Q, H)`."""
    steps = torch.tensor([round(horizon / dt) for horizon in seconds])
    index = (first[:, None] + steps).clamp(max=signal.shape[1] - 1)
    values: Floats = signal.gather(1, index).double().numpy()
    return values


def _predicted(drivers: list[Driver], batch: PairBatch, first: Tensor) -> Floats:
    """Returns what each driver forecasts for each horizon, `(M, Q, H)`, without chance."""
    predicted = []
    for driver in drivers:
        if driver.is_stochastic:
            speed = driver.drive(batch, first, None)
        else:
            speed = driver.forecast(batch, first, 0, 1)[0]
        predicted.append(_at(speed, first, batch.dt, HORIZONS_S))
    return np.stack(predicted)


def _mixed(weights: Floats, predicted: Floats, now: Floats) -> Floats:
    """Returns speeds `(Q, H)`: changes of the members' `(M, Q, H)`, by their weights `(H, M)`."""
    mixed: Floats = now + np.einsum("hm,mqh->qh", weights, predicted - now)
    return mixed


def _evenness(segments: Segments, changes: Floats) -> Floats:
    """Returns the roots of the weights of moments, `(Q, H)`: each site counts as another.

    Squares are divided by what speeds change there, so that a motorway is not all that counts.
    """
    sites = np.array([pair.site for pair in segments.pairs])
    roots = np.empty_like(changes)
    for site in np.unique(sites):
        rows = sites == site
        roots[rows] = 1.0 / np.sqrt(rows.sum() * ((changes[rows] ** 2).mean(0) + 1e-6))
    return roots


def _situation(batch: PairBatch, first: Tensor) -> Floats:
    """Returns what tells moments apart, `(Q, f)`: speeds, time gap, and what the leader will do."""
    dt = batch.dt
    speed = _at(batch.follower_speed, first, dt, (0.0,))
    leader = _at(batch.leader_speed, first, dt, (0.0, 3.0, 10.0))
    time_gap = _at(batch.gap, first, dt, (0.0,)).clip(0.0, 100.0) / (speed + 1.0)
    now = leader[:, :1]
    return np.hstack([speed, now - speed, time_gap, leader[:, 1:] - now])


def halves(pairs: PairSet, seed: int) -> list[tuple[PairSet, PairSet]]:
    """Returns twice what is learned from and what is forecast: one half of the sites and the other.

    The sites with most pairs come into different halves. Of a single site some drivers are kept
    instead.
    """
    sites = np.array([pair.site for pair in pairs])
    names, counts = np.unique(sites, return_counts=True)
    if len(names) == 1:
        return [divided(pairs, seed)]
    largest_first = names[np.argsort(-counts, kind="stable")]
    is_first = np.isin(sites, largest_first[::2])
    first = pairs.take(np.flatnonzero(is_first).tolist())
    second = pairs.take(np.flatnonzero(np.logical_not(is_first)).tolist())
    return [(first, second), (second, first)]
