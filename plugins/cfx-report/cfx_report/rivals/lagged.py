"""Regressions of scikit-learn on lagged states: what a follower does next, given what was seen.

One regression says the mean acceleration of the next half second, and drives with it in closed
loop. For forecasts there is one more for each horizon, which sees what the leader will do: it says
the change of speed at once, and is not simulated.

To be even between roads, equally many moments of each site are learned from.

Shapes: P pairs, T frames, N moments, f features. SI units.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from cfx.plugin import Pair, PairBatch, PairSet, Settings
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver

Floats = NDArray[np.float64]

LAGS_S: tuple[tuple[float, ...], ...] = ((0.0,), (0.0, 0.5, 1.0, 2.0))
"""Before now, at which states are seen: a driver sees either now alone, or the last two seconds."""

FORECAST_LAGS_S = LAGS_S[1]
"""What forecasts see: nothing that they say comes back to them, so that lags do no harm."""

HOLD_S = 0.5
"""How long an acceleration holds."""

HORIZONS_S = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
"""After a moment, for which there is a regression each; between them speeds are interpolated."""

_FAR_M = 100.0
"""Beyond it a gap says nothing more; a linear model would drive by it."""

_BRAKES, _ACCELERATES = 8.0, 4.0
"""m/s2: what a car can do."""

_VALIDATED = 0.2
"""Share of a fold's own training drivers whom a driver is chosen by."""


class LaggedSettings(Settings):
    """Settings of regressions on lagged states."""

    moments: int = Field(
        4000, ge=100, description="moments of each site that are learned from at most"
    )


class LaggedRival(Rival):
    """Base of rivals that are a regression of scikit-learn."""

    schema: ClassVar[type[Settings]] = LaggedSettings
    settings: LaggedSettings

    @abstractmethod
    def regression(self, seed: int) -> Any:
        """Returns what is fitted: an estimator of scikit-learn with `fit` and `predict`."""

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        """Learns to drive with the lags that drive best, and to forecast.

        A regression that says well what happens next may drive badly: what it does changes what it
        sees, and lagged states let it go on with whatever it began (P. de Haan, D. Jayaraman and S.
        Levine 2019, *Causal confusion in imitation learning*). So training drivers who were left
        out are driven, and say what it may see.
        """
        learned, kept = divided(pairs, seed)
        errors = {}
        for lags in LAGS_S:
            driver = LaggedDriver(self._follower(learned, lags, seed), [], lags, pairs.dt)
            errors[lags] = mean_error(driver, kept)
        chosen = min(LAGS_S, key=lambda lags: errors[lags])
        follower = self._follower(pairs, chosen, seed)
        return LaggedDriver(follower, self._ends(pairs, seed), chosen, pairs.dt)

    def _follower(self, pairs: PairSet, lags: Sequence[float], seed: int) -> Any:
        """Returns a regression of the mean acceleration of the next half second."""
        states, actions = [], []
        for pair, moments in zip(pairs, _drawn(pairs, self.settings.moments, seed), strict=True):
            ahead = moments + round(HOLD_S / pair.dt)
            inside = moments[ahead < len(pair)]
            speed = np.asarray(pair.follower_speed)
            states.append(_states(pair, inside, lags))
            actions.append((speed[inside + round(HOLD_S / pair.dt)] - speed[inside]) / HOLD_S)
        return _fitted(self.regression(seed), states, actions)

    def _ends(self, pairs: PairSet, seed: int) -> list[Any]:
        """Returns a regression of the change of speed for each horizon."""
        ends = []
        drawn = _drawn(pairs, self.settings.moments, seed)
        for horizon in HORIZONS_S:
            inputs, changes = [], []
            for pair, moments in zip(pairs, drawn, strict=True):
                steps = round(horizon / pair.dt)
                inside = moments[moments + steps < len(pair)]
                speed, leader = np.asarray(pair.follower_speed), np.asarray(pair.leader_speed)
                future = _future(leader, inside, horizon, pair.dt)
                inputs.append(np.hstack([_states(pair, inside, FORECAST_LAGS_S), future]))
                changes.append(speed[inside + steps] - speed[inside])
            ends.append(_fitted(self.regression(seed), inputs, changes))
        return ends


class LaggedDriver(StepDriver):
    """Drives by a regression, and forecasts by one for each horizon.

    Args:
        follower: says the mean acceleration of the next half second.
        ends: of each of `HORIZONS_S`, says the change of speed.
        lags: s, at which the follower sees.
        dt: time step, s.
    """

    def __init__(
        self, follower: Any, ends: Sequence[Any], lags: Sequence[float], dt: float
    ) -> None:
        self._follower = follower
        self._ends = ends
        self._offsets = [round(lag / dt) for lag in lags]
        self.lags = max(self._offsets) + 1
        self.every = round(HOLD_S / dt)

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        predicted = self._follower.predict(_features(seen, self._offsets))
        chosen = torch.as_tensor(np.asarray(predicted)).to(seen.gap)
        return chosen.clamp(-_BRAKES, _ACCELERATES), memory

    def forecast(self, batch: PairBatch, first: Tensor, seed: int, samples: int) -> Tensor:
        """Returns speeds by the regression of each horizon, `(1, P, T)`."""
        offsets = [round(lag / batch.dt) for lag in FORECAST_LAGS_S]
        states = _features(_seen(batch, first, max(offsets) + 1), offsets)
        speed = batch.follower_speed.gather(1, first[:, None])[:, 0].numpy()
        rows = np.arange(len(first))
        leader = batch.leader_speed.numpy()
        knots = [speed]
        for horizon, model in zip(HORIZONS_S, self._ends, strict=True):
            future = _future_of_each(leader, rows, first.numpy(), horizon, batch.dt)
            change = np.asarray(model.predict(np.hstack([states, future])))
            knots.append(np.maximum(speed + change, 0.0))
        return torch.as_tensor(between_horizons(np.stack(knots, 1), batch, first))[None]


class RidgeRival(LaggedRival):
    """Ridge regression; its strength is chosen by generalised cross-validation of the moments."""

    reference = "Hoerl and Kennard (1970), Technometrics 12(1); scikit-learn's RidgeCV"

    def regression(self, seed: int) -> Any:
        from sklearn.linear_model import RidgeCV
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        return make_pipeline(StandardScaler(), RidgeCV(alphas=np.logspace(-2, 4, 13)))


class BoostingRival(LaggedRival):
    """Gradient-boosted trees; a tenth of the moments says when to stop."""

    reference = "Friedman (2001), Annals of Statistics 29(5); scikit-learn's histogram trees"

    def regression(self, seed: int) -> Any:
        from sklearn.ensemble import HistGradientBoostingRegressor

        return HistGradientBoostingRegressor(early_stopping=True, random_state=seed)


class NeighboursSettings(LaggedSettings):
    """Settings of nearest neighbours."""

    neighbours: int = Field(30, ge=1, description="moments whose mean counts")


class NeighboursRival(LaggedRival):
    """What drivers did in the most similar moments, in the mean."""

    reference = "He, Zheng and Guan (2015), Transp. Res. B 80, 185-201"
    schema: ClassVar[type[Settings]] = NeighboursSettings
    settings: NeighboursSettings

    def regression(self, seed: int) -> Any:
        from sklearn.neighbors import KNeighborsRegressor
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        return make_pipeline(StandardScaler(), KNeighborsRegressor(self.settings.neighbours))


class GaussianProcessSettings(LaggedSettings):
    """Settings of a Gaussian process."""

    moments: int = Field(
        120,
        ge=20,
        description="moments of each site that are learned from at most: the cost grows"
        " with the cube of their number",
    )


class GaussianProcessRival(LaggedRival):
    """A Gaussian process; its one length scale and its noise are those of most likelihood."""

    reference = "Rasmussen and Williams (2006), Gaussian Processes for Machine Learning"
    schema: ClassVar[type[Settings]] = GaussianProcessSettings
    settings: GaussianProcessSettings

    def regression(self, seed: int) -> Any:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, WhiteKernel
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        kernel = 1.0 * RBF(3.0, (0.1, 1e4)) + WhiteKernel(0.1, (1e-4, 10.0))
        process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed)
        return make_pipeline(StandardScaler(), process)


def _fitted(model: Any, inputs: Sequence[Floats], answers: Sequence[Floats]) -> Any:
    """Fits a regression to moments of several pairs."""
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # A Gaussian process of few moments may need no noise, and says that it has none.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(np.vstack(inputs), np.concatenate(answers))


def _drawn(pairs: PairSet, moments: int, seed: int) -> list[NDArray[np.int64]]:
    """Draws moments of each pair, so that no site has more than `moments`."""
    random = np.random.default_rng(seed)
    sites = np.array([pair.site for pair in pairs])
    lengths = np.array([len(pair) for pair in pairs])
    drawn = []
    for pair in pairs:
        share = min(1.0, moments / float(lengths[sites == pair.site].sum()))
        count = max(1, round(share * len(pair)))
        drawn.append(
            np.sort(random.choice(len(pair) - 1, min(count, len(pair) - 1), replace=False))
        )
    return drawn


def divided(pairs: PairSet, seed: int) -> tuple[PairSet, PairSet]:
    """Divides pairs by driver into those that are learned from, and those that are driven."""
    drivers = np.array(sorted(set(pairs.drivers)), dtype=object)
    count = max(1, round(_VALIDATED * len(drivers)))
    chosen = set(np.random.default_rng(seed).permutation(drivers)[:count].tolist())
    is_kept = [driver in chosen for driver in pairs.drivers]
    kept = pairs.take(np.flatnonzero(is_kept).tolist())
    learned = pairs.take(np.flatnonzero(np.logical_not(is_kept)).tolist())
    return (learned, kept) if len(learned) else (pairs, pairs)


def mean_error(driver: Driver, pairs: PairSet) -> float:
    """Returns the mean RMSE of speed over full trajectories."""
    batch = PairBatch.of(pairs)
    speed = driver.drive(batch, torch.zeros(len(batch), dtype=torch.int64), None)
    squares = torch.where(batch.mask, speed - batch.follower_speed, 0.0).square()
    return float((squares.sum(1) / batch.mask.sum(1)).sqrt().mean())


def _seen(batch: PairBatch, first: Tensor, lags: int) -> Seen:
    """Returns the last frames up to `first`, `(P, lags)`."""
    index = (first[:, None] + torch.arange(1 - lags, 1)).clamp(min=0)
    signals = (
        batch.leader_speed,
        batch.leader_acceleration,
        batch.follower_speed,
        batch.follower_acceleration,
        batch.gap,
    )
    return Seen(*[signal.gather(1, index) for signal in signals])


def _states(pair: Pair, moments: NDArray[np.int64], lags: Sequence[float]) -> Floats:
    """Returns what a follower sees at moments of a pair, `(N, f)`."""
    offsets = [round(lag / pair.dt) for lag in lags]
    index = (moments[:, None] + np.arange(-max(offsets), 1)).clip(min=0)
    signals = (
        pair.leader_speed,
        pair.leader_acceleration,
        pair.follower_speed,
        pair.follower_acceleration,
        pair.gap,
    )
    return _features(Seen(*[torch.as_tensor(np.asarray(one)[index]) for one in signals]), offsets)


def _features(seen: Seen, offsets: Sequence[int]) -> Floats:
    """Returns speed, relative speed, gap and time gap at each lag, and accelerations now."""
    columns = [seen.leader_acceleration[:, -1], seen.follower_acceleration[:, -1]]
    for offset in offsets:
        at = -1 - offset
        speed, gap = seen.follower_speed[:, at], seen.gap[:, at].clamp(0.0, _FAR_M)
        columns += [speed, seen.leader_speed[:, at] - speed, gap, gap / (speed + 1.0)]
    stacked: Floats = torch.stack(columns, 1).double().numpy()
    return stacked


def _future(leader: Floats, moments: NDArray[np.int64], horizon: float, dt: float) -> Floats:
    """Returns what a leader does after moments, `(N, 4)`: changes of speed on the way."""
    rows = np.zeros(len(moments), dtype=np.int64)
    return _future_of_each(leader[None], rows, moments, horizon, dt)


def _future_of_each(
    leader: Floats, rows: NDArray[np.int64], moments: NDArray[np.int64], horizon: float, dt: float
) -> Floats:
    """As `_future`, of leaders `(P, T)`."""
    columns = []
    for share in (0.25, 0.5, 0.75, 1.0):
        at = np.minimum(moments + round(share * horizon / dt), leader.shape[1] - 1)
        columns.append(leader[rows, at] - leader[rows, moments])
    return np.stack(columns, 1)


def between_horizons(knots: Floats, batch: PairBatch, first: Tensor) -> Floats:
    """Interpolates speeds linearly at all frames of their pairs, `(P, T)`.

    Args:
        knots: speeds now and at each of `HORIZONS_S`, `(P, 1 + H)`, m/s.
        batch: the P pairs.
        first: the frame that is now, `(P,)`.
    """
    times = (0.0, *HORIZONS_S)
    frames = torch.arange(batch.mask.shape[1])
    at = (frames - first[:, None]).clamp(min=0).numpy() * batch.dt
    place = np.clip(np.searchsorted(times, at, side="right"), 1, len(times) - 1)
    grid = np.asarray(times)
    share = np.clip((at - grid[place - 1]) / (grid[place] - grid[place - 1]), 0.0, 1.0)
    before = np.take_along_axis(knots, place - 1, 1)
    after = np.take_along_axis(knots, place, 1)
    mixed: Floats = (1.0 - share) * before + share * after
    return mixed
