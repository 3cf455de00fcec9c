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
"""The first gap behind a given leader, unless it is given: the first, plus the follower's first
speed times the second."""

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
        parameters: a mapping or a series of values by name for all followers, or a row for each:
            a `Fit` or a frame whose index or column `pair_id` has the pairs' ids (behind `leader`:
            the followers' names); SI units. What is left out is at its default; None: all is.
        pairs: recorded leaders and the followers' starts, as `cfx.read` takes them.
        leader: in place of `pairs`: a leader's speed over time, as columns `time_s` and `speed`
            (m/s), or as a series of it whose index is the time. The step must be constant.
        at: s after a pair's first frame, from whose measured state the follower is simulated.
        gap: behind a given leader: the first bumper-to-bumper gap, m; None: 2 m plus 1.5 s times
            the follower's first speed.
        speed: behind a given leader: the follower's first speed, m/s; None: the leader's.
        settings: of the model, as on the command line: `**{"model.limits": None}`; of reading a
            file, `**{"data.max_pairs": 20}`.

    Returns:
        A row per follower and frame: pair_id, time_s, leader_speed (m/s), position (m), speed
        (m/s), acceleration (m/s2), gap (m; negative after a collision). The first row of each is
        where it starts from.

    Raises:
        CfxError: a parameter is unknown, outside its bounds or no finite number, a row is missing,
            the leader is no time series, a start is negative, or a setting or argument does not
            belong to the rest.

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
        driving_model = cast(
            DrivingModel, registry.create("model", config_of({"model": model, **of_model}).model)
        )
        if driving_model.needs_simulator:
            raise ConfigError(
                f"model={model} has equations in {driving_model.needs_simulator} alone and cannot"
                " be simulated here; run a job with it"
            )
        if pairs is None and leader is None and isinstance(parameters, Fit):
            pairs = parameters.recorded
        rows = _rows_of(parameters)
        recording = _recording(rows, pairs, leader, (gap, speed), settings)
        batch = PairBatch.of(recording)
        start_frame = round(at / batch.dt)
        if not 0 <= start_frame < int(batch.lengths.min()) - 1:
            raise ConfigError(
                f"at={at:g}: the shortest pair has {int(batch.lengths.min())} frames of"
                f" {batch.dt:g} s; give a time within it"
            )
        values = _values(rows, recording.ids, driving_model)
        leaders = Leader(
            batch.leader_position[:, start_frame:],
            batch.leader_speed[:, start_frame:],
            batch.leader_acceleration[:, start_frame:],
            batch.leader_length,
        )
        start = Start(
            batch.follower_position[:, start_frame],
            batch.follower_speed[:, start_frame],
            batch.follower_acceleration[:, start_frame],
        )
        trajectory = rollout(driving_model, values, leaders, start, batch.dt)
        return _table(recording, trajectory, start.acceleration, start_frame)


def _rows_of(parameters: Parameters) -> pd.DataFrame | dict[str, float]:
    """Returns a row of values for each follower, by its name, or one set for all.

    Raises:
        ConfigError: they have no names, there are no rows, or two of one name.
    """
    if isinstance(parameters, Fit):
        parameters = parameters.parameters
    if parameters is None:
        return {}
    if isinstance(parameters, Mapping | pd.Series):
        return dict(parameters)
    if not isinstance(parameters, pd.DataFrame):
        raise ConfigError(
            f"parameters: a {type(parameters).__name__} does not say which is which; give values by"
            " name ({'T': 1.2}), a data frame with a row for each follower, or a fit"
        )
    if "pair_id" in parameters:
        parameters = parameters.set_index("pair_id")
    if not len(parameters):
        raise ConfigError("parameters: there are no rows; give a row for each follower, or one set")
    names = names_of(parameters.index)
    twice = named_twice(names)
    if twice is not None:
        raise ConfigError(f"parameters: two rows are of pair '{twice}'; give one row for each pair")
    return parameters.set_axis(names)


def _recording(
    rows: pd.DataFrame | dict[str, float],
    pairs: PairsLike | None,
    leader: pd.DataFrame | pd.Series | None,
    start: tuple[float | None, float | None],
    settings: Mapping[str, Any],
) -> PairSet:
    """Returns the leaders, and where their followers start.

    Args:
        rows: values of each follower, or one set for all.
        pairs, leader: as of `simulate`.
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
        names = list(rows.index) if isinstance(rows, pd.DataFrame) else ["follower"]
        return _behind(leader, names, gap, speed)
    if gap is not None or speed is not None:
        raise ConfigError("gap and speed say where a follower of leader=... starts; give a leader")
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
    start = float(speeds[0]) if speed is None else _not_negative("speed", speed, "m/s")
    default_gap = _STANDSTILL_M + _TIME_GAP_S * start
    first_gap = default_gap if gap is None else _not_negative("gap", gap, "m")
    # Of the follower the first frame alone is read, where it starts.
    zeros = np.zeros(len(time))
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
                leader_position=first_gap + distance_driven(speeds, dt),
                leader_speed=speeds,
                leader_acceleration=accelerations(speeds, dt),
                follower_position=zeros,
                follower_speed=zeros + start,
                follower_acceleration=zeros,
            )
        )
    return PairSet(tuple(pairs), "the given leader")


def _not_negative(name: str, value: Any, unit: str) -> float:
    """Returns a value of a follower's start.

    Raises:
        ConfigError: it is negative, infinite or no number.
    """
    number = float(value) if isinstance(value, Real) else math.nan
    if not (math.isfinite(number) and number >= 0):
        raise ConfigError(f"{name}={value!r}: give a number of 0 {unit} or more")
    return number


def _values(
    rows: pd.DataFrame | dict[str, float], ids: list[str], model: DrivingModel
) -> dict[str, Tensor]:
    """Returns the values of each pair, `(P,)` by name.

    Args:
        rows: values of each follower, or one set for all.
        ids: of the P pairs.
        model: whose parameters they are.

    Raises:
        CfxError: a pair has no row, or a parameter is unknown or no finite number.
    """
    import torch

    if isinstance(rows, pd.DataFrame):
        missing = pd.Index(ids)[~pd.Index(ids).isin(rows.index)]
        if len(missing):
            raise ConfigError(
                f"parameters: there is no row for pair '{missing[0]}' ({len(missing)} such pairs);"
                " give a row for each, or one set for all"
            )
        table = rows.loc[ids]
    else:
        table = pd.DataFrame([rows] * len(ids), ids)
    values = {}
    for name in table.columns.astype(str):
        model.space[name]  # says that it is unknown
        column = table[name].to_numpy(np.float64)
        if not np.isfinite(column).all():
            raise ConfigError(f"parameters: {name} is NaN or infinite; give a number")
        values[name] = torch.tensor(column)
    return values


def _table(
    pairs: PairSet, trajectory: Trajectory, first_acceleration: Tensor, start_frame: int
) -> pd.DataFrame:
    """Returns a row per follower and frame, from the frame that they start at.

    Args:
        pairs: P pairs.
        trajectory: of their followers, simulated.
        first_acceleration: of each follower as it starts, m/s2, `(P,)`.
        start_frame: number of the frame, of each pair, that the trajectory begins with.
    """
    parts = []
    for number, pair in enumerate(pairs):
        count = len(pair) - start_frame
        speed = trajectory.speed[number, :count].numpy()
        columns = {
            "pair_id": pair.pair_id,
            "time_s": (start_frame + np.arange(count)) * pair.dt,
            "leader_speed": np.asarray(pair.leader_speed)[start_frame:],
            "position": trajectory.position[number, :count].numpy(),
            "speed": speed,
            "acceleration": np.append(float(first_acceleration[number]), np.diff(speed) / pair.dt),
            "gap": trajectory.gap[number, :count].numpy(),
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)
