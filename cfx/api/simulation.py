"""Simulation from Python: followers behind recorded or given leaders, as a data frame.

Shapes: P followers, T frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from cfx.api.fit import Fit
from cfx.api.pairs import PairsLike, pairs_from, without_data
from cfx.app.overrides import config_of
from cfx.core import registry
from cfx.core.guest import visit
from cfx.data.names import named_twice, names_of
from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.data.table import FileColumn, Layout, table_of
from cfx.data.tracks import accelerations, distance_driven
from cfx.errors import ConfigError, DataError

if TYPE_CHECKING:
    from torch import Tensor

    from cfx.models.base import DrivingModel
    from cfx.simulation.trajectory import Trajectory

_STANDSTILL_M, _TIME_GAP_S = 2.0, 1.5
"""Where a follower begins behind a given leader: so far, and so many seconds of their speed."""

_FASTEST_MPS, _LONGEST_STEP_S = 100.0, 2.0
"""Beyond these a leader's speeds or times are in another unit."""

_LEADER = Layout(
    "a leader's speed over time",
    (
        FileColumn("time_s", "s"),
        FileColumn("speed", "m/s", least=0.0, wrong="is no speed; give 0 or more, in m/s"),
    ),
)

Parameters = Fit | Mapping[str, float] | pd.Series | pd.DataFrame | None
"""Parameters of followers: a fit's, one set for all, or a row for each."""


def simulate(
    model: str,
    parameters: Parameters = None,
    pairs: PairsLike | None = None,
    *,
    leader: pd.DataFrame | pd.Series | None = None,
    at: float = 0.0,
    gap: float | None = None,
    speed: float | None = None,
    **settings: Any,
) -> pd.DataFrame:
    """Simulates followers behind recorded leaders, or behind one given leader.

    Args:
        model: as after `model=`.
        parameters: a `Fit` (each driver's own), a mapping or a series of values by name for all
            followers, or a frame with a row for each, whose index or column `pair_id` has the
            pairs' ids; SI units. What is left out is at its default; None: all is.
        pairs: recorded leaders and the followers' starts, as `cfx.read` takes them.
        leader: in place of `pairs`: a leader's speed over time, as columns `time_s` and `speed`
            (m/s), or as a series of it whose index is the time. The step must be constant.
        at: s after a pair's first frame, from whose measured state the follower is simulated.
        gap: behind a given leader: the first bumper-to-bumper gap, m; None: 2 m and 1.5 s.
        speed: behind a given leader: the follower's first speed, m/s; None: the leader's.
        settings: of the model, as on the command line: `**{"model.limits": None}`; of reading a
            file, `**{"data.max_pairs": 20}`.

    Returns:
        A row per follower and frame: pair_id, time_s, leader_speed (m/s), position (m), speed
        (m/s), acceleration (m/s2), gap (m; negative after a collision). The first row of each is
        where it starts from.

    Raises:
        CfxError: a parameter is unknown or outside its bounds, or the leader is no time series.

    Examples:
        >>> import cfx
        >>> import numpy as np
        >>> import pandas as pd
        >>> leader = pd.DataFrame({"time_s": np.arange(0, 60, 0.1), "speed": 15.0})
        >>> drive = cfx.simulate("idm", {"T": 1.2}, leader=leader)
        >>> list(drive.columns)
        ['pair_id', 'time_s', 'leader_speed', 'position', 'speed', 'acceleration', 'gap']
        >>> round(float(drive["speed"].iloc[-1]), 1)
        15.0
    """
    with visit():
        from cfx.models.base import DrivingModel, Leader
        from cfx.simulation.rollout import simulate_follower as rollout
        from cfx.simulation.trajectory import Start

        if isinstance(parameters, Fit) and parameters.model != model:
            raise ConfigError(
                f"the parameters are of model={parameters.model}, not of model={model}; simulate"
                " that model, or give others"
            )
        of_model = without_data(settings)
        for key, value in of_model.items():
            if not key.startswith("model."):
                raise ConfigError(
                    f"{key}={value} does nothing here: a simulation reads the model's settings and"
                    " those of data alone; leave it out"
                )
        made = cast(
            DrivingModel, registry.create("model", config_of({"model": model, **of_model}).model)
        )
        if made.needs_simulator:
            raise ConfigError(
                f"model={model} has equations in {made.needs_simulator} alone and cannot be"
                " simulated here; run a job with it"
            )
        recording = _recording(parameters, pairs, leader, (gap, speed), settings)
        batch = PairBatch.of(recording)
        first = round(at / batch.dt)
        if not 0 <= first < int(batch.lengths.min()) - 1:
            raise ConfigError(
                f"at={at:g}: the shortest pair has {int(batch.lengths.min())} frames of"
                f" {batch.dt:g} s; give a time within it"
            )
        values = _values(parameters, recording.ids, made)
        ahead = Leader(
            batch.leader_position[:, first:],
            batch.leader_speed[:, first:],
            batch.leader_acceleration[:, first:],
            batch.leader_length,
        )
        start = Start(
            batch.follower_position[:, first],
            batch.follower_speed[:, first],
            batch.follower_acceleration[:, first],
        )
        trajectory = rollout(made, values, ahead, start, batch.dt)
        return _table(recording, trajectory, start.acceleration, first)


def _recording(
    parameters: Parameters,
    pairs: PairsLike | None,
    leader: pd.DataFrame | pd.Series | None,
    start: tuple[float | None, float | None],
    settings: Mapping[str, Any],
) -> PairSet:
    """Returns the leaders, and where their followers start.

    Args:
        parameters, pairs, leader: as of `simulate`.
        start: gap (m) and speed (m/s) of a follower of `leader`.
        settings: of the call; those of `data` say how a file is read.

    Raises:
        CfxError: these do not belong together.
    """
    gap, speed = start
    read_from_file = pairs is not None and leader is None
    for key, value in settings.items():
        if key not in without_data(settings) and not read_from_file:
            raise ConfigError(f"{key}={value} does nothing here: no file is read; leave it out")
    if leader is not None:
        if pairs is not None:
            raise ConfigError("give pairs or leader, not both")
        names = ["follower"]
        if isinstance(parameters, pd.DataFrame):
            names = names_of(parameters.index)
        return _behind(leader, names, gap, speed)
    if gap is not None or speed is not None:
        raise ConfigError("gap and speed say where a follower of leader=... starts; give a leader")
    if pairs is None and isinstance(parameters, Fit):
        return parameters.recorded.selected
    if pairs is None:
        raise ConfigError("give recorded pairs, or leader=FRAME with columns time_s and speed")
    return pairs_from(pairs, settings).selected


def _behind(
    leader: pd.DataFrame | pd.Series, names: list[str], gap: float | None, speed: float | None
) -> PairSet:
    """Returns a pair for each name, behind one leader."""
    if isinstance(leader, pd.Series):
        leader = leader.rename("speed").rename_axis("time_s").reset_index()
    table = table_of(leader, _LEADER, "leader")
    time, speeds = table.numbers["time_s"], table.numbers["speed"]
    steps = np.diff(time)
    dt = float(np.mean(steps)) if len(steps) else 0.0
    if len(time) < 2 or not np.allclose(steps, dt, rtol=0.05, atol=0) or dt <= 0:
        raise DataError("leader: time_s must advance by a constant step, over two rows or more")
    if dt > _LONGEST_STEP_S:
        raise DataError(f"leader: time_s advances by {dt:g} a row; give seconds, in steps of 0.1 s")
    if speeds.max() > _FASTEST_MPS:
        raise DataError(f"leader: speed goes up to {speeds.max():g}; give m/s")
    dt = round(dt, 9)
    start = float(speeds[0]) if speed is None else _at_least_0("speed", speed, "m/s")
    ahead = _STANDSTILL_M + _TIME_GAP_S * start if gap is None else _at_least_0("gap", gap, "m")
    still = np.zeros(len(time))
    pairs = []
    for name in names:
        pairs.append(
            Pair(
                pair_id=name,
                recording="given",
                leader_id="leader",
                follower_id=name,
                first_frame=0,
                dt=dt,
                leader_length=0.0,
                leader_position=ahead + distance_driven(speeds, dt),
                leader_speed=speeds,
                leader_acceleration=accelerations(speeds, dt),
                follower_position=still,
                follower_speed=still + start,
                follower_acceleration=still,
            )
        )
    return PairSet(tuple(pairs), "the given leader")


def _at_least_0(name: str, value: Any, unit: str) -> float:
    """Returns a value of a follower's start."""
    number = float(value) if isinstance(value, Real) else math.nan
    if not (math.isfinite(number) and number >= 0):
        raise ConfigError(f"{name}={value!r}: give a number of 0 {unit} or more")
    return number


def _values(parameters: Parameters, ids: list[str], model: DrivingModel) -> dict[str, Tensor]:
    """Returns values `(P,)` by name."""
    import torch

    if isinstance(parameters, Fit):
        parameters = parameters.parameters
    if isinstance(parameters, pd.DataFrame):
        if "pair_id" in parameters:
            parameters = parameters.set_index("pair_id")
        names = names_of(parameters.index)
        twice = named_twice(names)
        if twice is not None:
            raise ConfigError(
                f"parameters: two rows are of pair '{twice}'; give one row for each pair"
            )
        table = parameters.set_axis(names)
        missing = pd.Index(ids)[~pd.Index(ids).isin(table.index)]
        if len(missing):
            raise ConfigError(
                f"parameters: there is no row for pair '{missing[0]}' ({len(missing)} such pairs);"
                " give a row for each, or one set for all"
            )
        table = table.loc[ids]
    else:
        table = pd.DataFrame([{} if parameters is None else dict(parameters)] * len(ids), ids)
    values = {}
    for name in table.columns.astype(str):
        model.space[name]  # says that it is unknown
        column = table[name].to_numpy(np.float64)
        if not np.isfinite(column).all():
            raise ConfigError(f"parameters: {name} is NaN or infinite; give a number")
        values[name] = torch.tensor(column)
    return values


def _table(pairs: PairSet, trajectory: Trajectory, at_start: Tensor, first: int) -> pd.DataFrame:
    """Returns a row per follower and frame; `at_start` are the followers' first accelerations."""
    parts = []
    for number, pair in enumerate(pairs):
        count = len(pair) - first
        speed = trajectory.speed[number, :count].numpy()
        columns = {
            "pair_id": pair.pair_id,
            "time_s": (first + np.arange(count)) * pair.dt,
            "leader_speed": np.asarray(pair.leader_speed)[first:],
            "position": trajectory.position[number, :count].numpy(),
            "speed": speed,
            "acceleration": np.append(float(at_start[number]), np.diff(speed) / pair.dt),
            "gap": trajectory.gap[number, :count].numpy(),
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)
