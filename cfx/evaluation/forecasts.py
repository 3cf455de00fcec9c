"""Forecasts: followers simulated from many moments of their trajectories, and their errors.

An *origin* is a moment of a measured trajectory. Everything measured up to it may be read; of what
comes after it the follower is never read, and the leader only where their future is given. From
each origin the follower is simulated for some seconds, all origins in one batch.

Origins of one driver overlap, and are never counted as independent: errors are the RMSE over the
origins of a driver, then the mean over drivers, with the interval over drivers.

Shapes: P pairs, Q origins, K simulated steps, T frames, H horizons, n tuned parameters. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.data.pairs import SIGNALS, PairBatch, PairSet
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.statistics import mean_interval
from cfx.policies.agent import Agent, AgentState
from cfx.policies.context import DriverContext
from cfx.policies.features import measured_history
from cfx.simulation.base import Stepper

LeaderFuture = Literal["given", "constant_speed", "constant_acceleration"]
"""What is known of the leader after an origin.

`given`: what they did; the errors are the follower's alone. `constant_speed`,
`constant_acceleration`: what can be known at the origin, if the leader drives on as they do there.
"""

_CHUNK_BYTES = 1 << 28
"""What one chunk of origins takes at most, for signals and for the state of networks."""

_COPIES = 4
"""How many tensors of the networks' state are alive at once, and of the signals besides."""


@dataclass(frozen=True)
class Origins:
    """Q moments of P pairs, pair after pair.

    Attributes:
        pair: `(Q,)` int64, index of the pair.
        frame: `(Q,)` int64, the last measured frame that may be read.
    """

    pair: Tensor
    frame: Tensor

    @classmethod
    def every(cls, stride: int, first: Tensor, last: Tensor) -> Origins:
        """Returns an origin every `stride` frames of each pair.

        Args:
            stride: in frames.
            first: `(P,)`, the first origin of each pair.
            last: `(P,)`, the latest frame that an origin may be at; a pair that has none gets none.
        """
        counts = ((last - first).div(stride, rounding_mode="floor") + 1).clamp(min=0)
        pair = torch.repeat_interleave(torch.arange(len(first), device=first.device), counts)
        before = torch.cumsum(counts, 0) - counts
        number = torch.arange(len(pair), device=first.device) - before[pair]
        return cls(pair, first[pair] + number * stride)

    def columns(self, pairs: PairSet) -> dict[str, NDArray[np.object_]]:
        """Returns the columns with which a table of them begins: `pair_id` and `driver`."""
        index = self.pair.cpu().numpy()
        ids = np.asarray([pair.pair_id for pair in pairs], dtype=object)
        drivers = np.asarray([pair.driver for pair in pairs], dtype=object)
        return {"pair_id": ids[index], "driver": drivers[index]}

    def __len__(self) -> int:
        """Q."""
        return len(self.pair)

    def __getitem__(self, index: slice) -> Origins:
        """Selects origins."""
        return Origins(self.pair[index], self.frame[index])


class Paths(NamedTuple):
    """Q paths from their origins on, frame 0 being the origin.

    Attributes:
        speed: `(Q, K + 1)`, m/s.
        travelled: `(Q, K + 1)`, m since the origin.
    """

    speed: Tensor
    travelled: Tensor


def measured_paths(batch: PairBatch, origins: Origins, steps: int) -> tuple[Paths, Tensor]:
    """Returns what followers did after origins.

    Args:
        batch: P pairs.
        origins: Q of them.
        steps: K.

    Returns:
        The paths, and which of their frames were recorded, bool `(Q, K + 1)`.
    """
    frames = origins.frame[:, None] + torch.arange(steps + 1, device=origins.frame.device)
    recorded = frames < batch.lengths[origins.pair][:, None]
    index = frames.clamp(max=batch.mask.shape[1] - 1)
    rows = origins.pair[:, None]
    position = batch.follower_position[rows, index]
    return Paths(batch.follower_speed[rows, index], position - position[:, :1]), recorded


def kinematic_paths(batch: PairBatch, origins: Origins, steps: int, *, accelerates: bool) -> Paths:
    """Returns followers that go on as they do at the origin: at constant speed or acceleration.

    Nobody drives backwards: who brakes, stops.

    Args:
        batch: P pairs.
        origins: Q of them.
        steps: K.
        accelerates: the acceleration is constant, not the speed.
    """
    speed = batch.follower_speed[origins.pair, origins.frame]
    acceleration = torch.zeros_like(speed)
    if accelerates:
        acceleration = batch.follower_acceleration[origins.pair, origins.frame]
    return _extrapolated(speed, acceleration, steps, batch.dt)


def _extrapolated(speed: Tensor, acceleration: Tensor, steps: int, dt: float) -> Paths:
    """Returns paths at constant acceleration, `(Q, K + 1)`, in the steps of the simulation."""
    time = dt * torch.arange(steps + 1, dtype=speed.dtype, device=speed.device)
    speeds = (speed[:, None] + acceleration[:, None] * time).clamp(min=0.0)
    moved = speeds * dt
    moved[:, 0] = 0.0
    return Paths(speeds, moved.cumsum(1))


def simulate_from_origins(
    simulator: Stepper,
    agent: Agent,
    followers: Followers,
    origins: Origins,
    steps: int,
    *,
    leader: LeaderFuture = "given",
) -> Paths:
    """Simulates followers from origins on, with an agent in the loop.

    Up to an origin the agent observes what was measured (burn-in, driver features). From there on
    it sees the simulated follower only. All origins are one batch, in chunks that fit the memory.

    Args:
        simulator: the model and its time step.
        agent: chooses the parameters of each window; of any kind.
        followers: P pairs, and what the agent knows of them; it observes their history before each
            origin.
        origins: Q of them.
        steps: K, at least 1.
        leader: what is known of the leader after the origin.
    """
    sampled = sample_from_origins(
        simulator, agent, followers, origins, steps, (None,), leader=leader
    )
    return Paths(sampled.speed[0], sampled.travelled[0])


def sample_from_origins(
    simulator: Stepper,
    agent: Agent,
    followers: Followers,
    origins: Origins,
    steps: int,
    generators: Sequence[torch.Generator | None],
    *,
    leader: LeaderFuture = "given",
) -> Paths:
    """Samples paths of followers from origins on; see `simulate_from_origins`.

    What was measured is observed once for all paths. One path of all origins is one batch.

    Args:
        simulator, agent, followers, origins, steps: as there.
        generators: S of them, on the CPU, one for each path; None: what a stochastic agent does if
            nothing is drawn.
        leader: as there.

    Returns:
        Paths `(S, Q, K + 1)`.
    """
    speeds, travelled = [], []
    batch, base = followers.batch, followers.base
    for chunk in _chunks(agent, batch, origins):
        state = None
        if followers.history is None and not agent.core.driver_features:
            state = _observed(agent, followers, chunk)
        part = _with_future(batch[chunk.pair], chunk.frame, steps, leader)
        own_base = None
        if base is not None:
            own_base = base[chunk.pair]
        known = Followers(part, followers.network[chunk.pair], own_base, followers.history)
        index = chunk.frame[:, None] + torch.arange(steps + 1, device=chunk.frame.device)
        index = index.clamp(max=part.mask.shape[1] - 1)
        leader_position = part.leader_position.gather(1, index)
        speed, moved = [], []
        for generator in generators:
            loop = simulate_closed_loop(
                simulator, agent, known, chunk.frame, state=state, generator=generator
            )
            position = leader_position - loop.gap
            speed.append(loop.speed)
            moved.append(position - position[:, :1])
        speeds.append(torch.stack(speed))
        travelled.append(torch.stack(moved))
    return Paths(torch.cat(speeds, 1), torch.cat(travelled, 1))


@torch.no_grad()
def _observed(agent: Agent, followers: Followers, origins: Origins) -> AgentState:
    """Returns the agent's state at origins, each pair being observed once.

    What was observed up to an origin is the beginning of what is observed up to the next one. Not
    so where driver features condition the networks: each origin has its own.

    Args:
        agent: observes.
        followers: P pairs.
        origins: Q of them.
    """
    pairs, row = torch.unique(origins.pair, return_inverse=True)
    at_origins = _begun(agent, followers, origins.pair)
    state = _begun(agent, followers, pairs)
    stride = agent.windows.stride
    last = torch.zeros_like(pairs).scatter_reduce(0, row, origins.frame, "amax")
    windows = origins.frame.add(stride - 1).div(stride, rounding_mode="floor")
    for window in range(int(windows.max()) + 1):
        due = (windows == window).nonzero()[:, 0]
        places = (at_origins.network[due], at_origins.place[due])
        at_origins.state[places] = state.state[state.network[row[due]], state.place[row[due]]]
        frame = torch.full_like(last, window * stride)
        history = measured_history(followers.batch, pairs, frame, agent.windows.length)
        state = agent.observe(history, state, frame < last)
    return at_origins


def _begun(agent: Agent, followers: Followers, pairs: Tensor) -> AgentState:
    """Returns the state of drivers of some pairs before their first window."""
    own = None
    if followers.base is not None:
        own = followers.base[pairs]
    return agent.begin(followers.network[pairs], DriverContext(own))


def _chunks(agent: Agent, batch: PairBatch, origins: Origins) -> Iterator[Origins]:
    """Cuts origins into parts whose signals and states fit the memory."""
    frames = batch.mask.shape[1]
    per_origin = _COPIES * (len(SIGNALS) + 2) * frames
    states = agent.network.initial_state(len(agent.names), 1)
    per_origin += _COPIES * math.prod(states.shape[2:])
    size = max(1, _CHUNK_BYTES // (8 * per_origin))
    for first in range(0, len(origins), size):
        yield origins[first : first + size]


def _with_future(batch: PairBatch, origin: Tensor, steps: int, leader: LeaderFuture) -> PairBatch:
    """Returns pairs that last to the end of their forecasts, with what is known of their leaders.

    Frames after a recording's end hold something, and are in no error (`measured_paths`).

    Args:
        batch: Q pairs, one for each origin.
        origin: `(Q,)`, frames.
        steps: K.
        leader: what is known of the leader after the origin.
    """
    frames = torch.arange(batch.mask.shape[1], device=origin.device)
    after = frames - origin[:, None]
    lasting = replace(batch, lengths=origin + steps + 1, mask=after <= steps)
    if leader == "given":
        return lasting
    rows = torch.arange(len(origin), device=origin.device)
    speed = batch.leader_speed[rows, origin]
    acceleration = torch.zeros_like(speed)
    if leader == "constant_acceleration":
        acceleration = batch.leader_acceleration[rows, origin]
    ahead = _extrapolated(speed, acceleration, steps, batch.dt)
    step = after.clamp(min=0, max=steps)
    position = batch.leader_position[rows, origin][:, None] + ahead.travelled.gather(1, step)
    speeds = ahead.speed.gather(1, step)
    known = after <= 0
    return replace(
        lasting,
        leader_position=torch.where(known, batch.leader_position, position),
        leader_speed=torch.where(known, batch.leader_speed, speeds),
        leader_acceleration=torch.where(
            known, batch.leader_acceleration, _while_moving(speeds, acceleration)
        ),
    )


def _while_moving(speed: Tensor, acceleration: Tensor) -> Tensor:
    """Returns accelerations `(Q, T)`: constant `(Q,)` while moving, and 0 once standing."""
    standing = (speed <= 0.0) & (acceleration < 0.0)[:, None]
    return torch.where(standing, 0.0, acceleration[:, None])


FORECAST_METHODS = (
    "constant_speed",
    "constant_acceleration",
    "default",
    "population",
    "population_residual",
    "fixed",
    "fixed_residual",
    "policy",
)
"""What forecasts compare, in the order in which it is shown."""

SCOPE = "forecast"
"""The scope of forecasts in the long table, and what their metrics begin with."""

ERRORS = {
    "rmse_speed": ("m/s", "RMSE of speed at the horizon"),
    "rmse_position": ("m", "RMSE of position at the horizon"),
    "ade": ("m", "absolute error of position, mean over the way to the horizon"),
    "fde": ("m", "absolute error of position at the horizon"),
}
"""Errors of a forecast by name: unit and meaning."""

_QUADRATIC = {"rmse_speed": "speed_error", "rmse_position": "position_error"}

_SPANS = 6
"""Most spans of history that errors are told apart by."""

FORECAST_COLUMNS = (
    "pair_id",
    "driver",
    "method",
    "history_s",
    "horizon_s",
    "speed_error",
    "position_error",
    "ade",
)
"""Columns of the table of single forecasts, which a job writes as `forecasts.parquet`.

It has a row per origin, method and horizon that the recording lasts to. history_s: measured history
up to the origin; speed_error (m/s) and position_error (m): simulated minus measured at the horizon;
ade: m.
"""


def forecast_values(table: pd.DataFrame) -> pd.DataFrame:
    """Returns rows of the long table: pair_id, driver, method, scope, metric, value.

    Args:
        table: of single forecasts.
    """
    by_pair = errors_by(table, ["pair_id", "driver", "method", "horizon_s"])
    parts = []
    for error in ERRORS:
        metric = [metric_name(error, horizon) for horizon in by_pair["horizon_s"]]
        part = by_pair[["pair_id", "driver", "method"]].assign(
            scope=SCOPE, metric=metric, value=by_pair[error].to_numpy()
        )
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def forecast_columns(values: pd.DataFrame, places: pd.DataFrame) -> pd.DataFrame:
    """Returns the columns `forecast_METRIC` of `pairs.csv`; none without forecasts.

    Args:
        values: the long table.
        places: pair_id and method of each row.
    """
    index = pd.MultiIndex.from_frame(places)
    columns = {}
    of_forecasts = values[values["scope"] == SCOPE]
    for metric, rows in of_forecasts.groupby("metric", sort=False, observed=True):
        column = rows.set_index(["pair_id", "method"])["value"]
        columns[f"{SCOPE}_{metric}"] = column.reindex(index).to_numpy()
    return pd.DataFrame(columns, index=places.index)


def forecast_metrics(table: pd.DataFrame, seed: int) -> dict[str, float]:
    """Returns the metrics of forecasts under their names in metrics.json and MLflow.

    `forecast/ERROR_HORIZON/METHOD`, such as `forecast/rmse_speed_0.5s/policy`, is the mean over
    drivers; ERROR is one of `ERRORS`. `forecast/ERROR_HORIZON/METHOD/ci95_low` and `ci95_high` are
    its 95 % bootstrap interval over drivers, of `rmse_speed` and `rmse_position`.

    Args:
        table: of single forecasts.
        seed: of the bootstrap.
    """
    found = {}
    for row in summarize_forecasts(table, seed).to_dict("records"):
        for error in ERRORS:
            key = f"{SCOPE}/{metric_name(error, row['horizon_s'])}/{row['method']}"
            found[key] = float(row[error])
            for end in ("low", "high"):
                if error in _QUADRATIC:
                    found[f"{key}/ci95_{end}"] = float(row[f"{error}_{end}"])
    return found


def metric_name(error: str, horizon: float) -> str:
    """Returns the name of an error at a horizon in s, such as `rmse_speed_0.5s`."""
    return f"{error}_{horizon:g}s"


def forecast_methods(table: pd.DataFrame) -> tuple[str, ...]:
    """Returns the methods of a table of forecasts in the order in which they are shown."""
    present = table["method"].astype(str).unique().tolist()
    known = [method for method in FORECAST_METHODS if method in present]
    return (*known, *(method for method in present if method not in known))


def forecast_errors(
    pairs: PairSet,
    origins: Origins,
    paths: Mapping[str, Paths],
    measured: Paths,
    recorded: Tensor,
    horizons: Sequence[float],
    dt: float,
) -> pd.DataFrame:
    """Compares forecasts with what was measured.

    Args:
        pairs: P pairs.
        origins: Q of them.
        paths: by method.
        measured: what the followers did.
        recorded: which frames of it there are, bool `(Q, K + 1)`.
        horizons: s.
        dt: time step, s.

    Returns:
        A table with `FORECAST_COLUMNS`.
    """
    first, frame = origins.columns(pairs), origins.frame.cpu().numpy()
    parts = []
    for method, path in paths.items():
        off = path.travelled - measured.travelled
        so_far = off[:, 1:].abs().cumsum(1)
        for horizon in horizons:
            step = round(horizon / dt)
            exists = recorded[:, step].cpu().numpy()
            columns = {
                **first,
                "method": method,
                "history_s": frame * dt,
                "horizon_s": float(horizon),
                "speed_error": _array(path.speed[:, step] - measured.speed[:, step]),
                "position_error": _array(off[:, step]),
                "ade": _array(so_far[:, step - 1] / step),
            }
            parts.append(pd.DataFrame(columns)[exists])
    table = pd.concat(parts, ignore_index=True)
    return table[list(FORECAST_COLUMNS)]


def errors_by(table: pd.DataFrame, groups: Sequence[str]) -> pd.DataFrame:
    """Returns a row per group with a column per error and `origins`, how many there are.

    Args:
        table: of single forecasts.
        groups: columns whose values make a group.
    """
    squares = table.assign(
        rmse_speed=table["speed_error"] ** 2,
        rmse_position=table["position_error"] ** 2,
        fde=table["position_error"].abs(),
    )
    grouped = squares.groupby(list(groups), sort=False, observed=True)
    found = grouped[list(ERRORS)].mean()
    for error in _QUADRATIC:
        found[error] = np.sqrt(found[error])
    found["origins"] = grouped.size()
    return found.reset_index()


def summarize_forecasts(table: pd.DataFrame, seed: int, by: str = "horizon_s") -> pd.DataFrame:
    """Returns the mean over drivers of the errors over each driver's origins.

    Args:
        table: of single forecasts.
        seed: of the bootstrap.
        by: column that tells the forecasts of a method from one another.

    Returns:
        A row per method and value of `by`, with columns for each error; `rmse_speed_low`,
        `rmse_speed_high`, `rmse_position_low` and `rmse_position_high`, the 95 % bootstrap interval
        over drivers; drivers and origins, how many there are.
    """
    rows = []
    of_driver = errors_by(table, ["method", by, "driver"])
    for (method, value), found in of_driver.groupby(["method", by], sort=False, observed=True):
        row: dict[str, object] = {"method": method, by: value}
        row |= {error: float(found[error].mean()) for error in ERRORS}
        drivers = found["driver"].astype(str).tolist()
        for error in _QUADRATIC:
            _, low, high = mean_interval(found[error].tolist(), drivers, seed=seed)
            row |= {f"{error}_low": low, f"{error}_high": high}
        row |= {"drivers": len(found), "origins": int(found["origins"].sum())}
        rows.append(row)
    return pd.DataFrame(rows)


def errors_by_history(table: pd.DataFrame) -> pd.DataFrame:
    """Returns errors by how much of a driver had been measured up to the origin.

    Histories are cut into spans of whole seconds, six of them up to the longest history that half
    of the drivers have. A span counts if half of the drivers have origins in it, so that none is of
    few drivers only.

    Args:
        table: of single forecasts.

    Returns:
        A row per method, horizon and span: method, horizon_s, span_s (its middle), a column for
        each error (mean over drivers), drivers.
    """
    history = table["history_s"]
    first = float(history.min())
    last = float(table.groupby("driver")["history_s"].max().median())
    width = max(1.0, float(np.ceil((last - first) / _SPANS)))
    middle = first + width * (np.floor((history - first) / width) + 0.5)
    groups = ["method", "horizon_s", "span_s", "driver"]
    of_driver = errors_by(table.assign(span_s=middle), groups)
    grouped = of_driver.groupby(groups[:-1], sort=False, observed=True)
    found = grouped[list(ERRORS)].mean()
    found["drivers"] = grouped.size()
    found = found.reset_index().sort_values("span_s", kind="stable")
    enough = found["drivers"] >= 0.5 * table["driver"].nunique()
    return found[enough].reset_index(drop=True)


def _array(values: Tensor) -> np.ndarray:
    return np.asarray(values.double().cpu().numpy())
