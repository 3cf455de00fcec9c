"""Errors of predictions, pair by pair.

Shapes: P pairs, K + 1 frames, Q moments, S samples. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import scoringrules
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.errors import DataError
from cfx.plugin import Metric, Pair, PairBatch, ParameterSpace, Trajectories, registry
from cfx_report.benchmark.segments import Segments, segments_of
from cfx_report.benchmark.suite import Suite, Task

TRAJECTORY_METRICS = ("rmse_speed", "rmse_gap", "collisions", "hard_braking")
"""Of simulated trajectories; as cfx's metrics of these names."""

FORECAST_METRICS = ("rmse_speed", "crps_speed", "coverage")
"""Of forecasts: of the mean (m/s), of the distribution (m/s), and the share of speeds within the
central 90 %. Where one number is forecast its CRPS is its absolute error."""

METRICS = tuple(dict.fromkeys((*TRAJECTORY_METRICS, *FORECAST_METRICS)))

_LOW = 0.05
"""Where the central 90 % begin."""

Floats = NDArray[np.float64]


def horizon_task(horizon: float) -> str:
    """Returns the name under which errors at a horizon stand."""
    return f"forecast_{horizon:g}s"


def errors_of(
    suite: Suite, pairs: Sequence[Pair], table: pd.DataFrame, source: str
) -> pd.DataFrame:
    """Returns errors of predictions, as `cfx_report.benchmark.predictions.read` gives them.

    Args:
        suite: what is asked.
        pairs: all of its pairs.
        table: trajectories, or forecasts.
        source: what messages call it.

    Returns:
        A row per task and pair: task, site, pair_id, driver, frames (or moments), and `METRICS`,
        NaN where one is not defined.

    Raises:
        DataError: a task or a pair is unknown, or a frame or a moment is missing or there twice.
    """
    if "horizon_s" in table.columns:
        for task in suite.tasks:
            if task.kind == "forecast":
                return _forecast_errors(suite, task, pairs, table, source)
        raise DataError(f"{source}: {suite.version} asks for no forecasts")
    parts = []
    for name, of_task in table.groupby("task", sort=False):
        task = suite.task(str(name))
        if task.kind == "forecast":
            raise DataError(f"{source}: '{name}' asks for forecasts, not for trajectories")
        parts.append(_trajectory_errors(suite, task, pairs, of_task, source))
    if not parts:
        raise DataError(f"{source}: has no rows")
    return pd.concat(parts, ignore_index=True)


def _about(suite: Suite, task: str, pairs: Sequence[Pair]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "task": task,
            "site": suite.sites_of(pairs),
            "pair_id": [pair.pair_id for pair in pairs],
            "driver": [pair.driver for pair in pairs],
        }
    )


def _trajectory_errors(
    suite: Suite, task: Task, pairs: Sequence[Pair], table: pd.DataFrame, source: str
) -> pd.DataFrame:
    """Returns a row per pair of a task."""
    segments = segments_of(suite, task, pairs)
    batch = segments.batch()
    shape = batch.mask.shape
    row = _places(table["pair_id"], segments.pair_ids, source, task.name)
    frame = np.rint(table["time_s"].to_numpy() / batch.dt).astype(np.int64)
    counted = batch.mask & (torch.arange(shape[1]) > segments.first[:, None])
    is_scored = counted.numpy()
    inside = (frame >= 0) & (frame < shape[1])
    inside[inside] = is_scored[row[inside], frame[inside]]
    if not inside.all():
        at = int(np.flatnonzero(~inside)[0])
        wrong = table.iloc[at]
        raise DataError(
            f"{source}, row {table.index[at] + 1}, column time_s: {wrong['time_s']:g} s of pair"
            f" '{wrong['pair_id']}' is not tested in '{task.name}'"
        )
    given = np.zeros(shape, dtype=np.int64)
    np.add.at(given, (row, frame), 1)
    _require_each(given, is_scored, segments, source, task.name)
    about = _about(suite, task.name, pairs)
    return _measured(about, segments, *_on_frames(batch, table, row, frame))


def errors_of_segments(
    suite: Suite, segments: Segments, pairs: Sequence[Pair], table: pd.DataFrame
) -> pd.DataFrame:
    """Returns errors of simulated stretches that belong to no task, a row per pair.

    Args:
        suite: says the sites.
        segments: P stretches.
        pairs: of which they are cut.
        table: as `cfx_report.benchmark.predictions.trajectory_table` returns it.
    """
    batch = segments.batch()
    row = _places(table["pair_id"], segments.pair_ids, "the stretches", "")
    frame = np.rint(table["time_s"].to_numpy() / batch.dt).astype(np.int64)
    return _measured(_about(suite, "", pairs), segments, *_on_frames(batch, table, row, frame))


def _on_frames(
    batch: PairBatch, table: pd.DataFrame, row: NDArray[np.int64], frame: NDArray[np.int64]
) -> tuple[Tensor, Tensor]:
    """Returns speeds and gaps `(P, T)`, the simulated ones at the frames that a table has."""
    speed, gap = batch.follower_speed.numpy().copy(), batch.gap.numpy().copy()
    speed[row, frame] = table["speed_mps"].to_numpy()
    gap[row, frame] = table["gap_m"].to_numpy()
    return torch.from_numpy(speed), torch.from_numpy(gap)


def _measured(about: pd.DataFrame, segments: Segments, speed: Tensor, gap: Tensor) -> pd.DataFrame:
    """Returns the metrics of P trajectories `(P, T)` beside what `about` says of the pairs."""
    batch = segments.batch()
    frames = torch.arange(batch.mask.shape[1])
    trajectories = Trajectories(
        speed=speed,
        gap=gap,
        measured_speed=batch.follower_speed,
        measured_gap=batch.gap,
        leader_speed=batch.leader_speed,
        parameters=speed.new_zeros((*speed.shape, 0)),
        counted=batch.mask & (frames > segments.first[:, None]),
        dt=batch.dt,
        space=ParameterSpace.of(),
    )
    errors = about.assign(frames=trajectories.counted.sum(1).numpy())
    for name in METRICS:
        errors[name] = np.nan
        if name in TRAJECTORY_METRICS:
            metric = registry.create("metric", {"name": name})
            assert isinstance(metric, Metric)
            errors[name] = metric.compute(trajectories).double().numpy()
    return errors


def _places(
    pair_ids: pd.Series, tested_ids: Sequence[str], source: str, task: str
) -> NDArray[np.int64]:
    """Returns the number of the pair of each row."""
    number = pd.Series(np.arange(len(tested_ids)), index=list(tested_ids))
    unknown = ~pair_ids.isin(number.index)
    if unknown.any():
        row = pair_ids.index[int(np.flatnonzero(unknown)[0])]
        raise DataError(
            f"{source}, row {row + 1}, column pair_id: '{pair_ids.loc[row]}' is no pair of '{task}'"
        )
    return number.loc[pair_ids].to_numpy(dtype=np.int64)


def _require_each(
    given: NDArray[np.int64],
    is_scored: NDArray[np.bool_],
    segments: Segments,
    source: str,
    task: str,
) -> None:
    """Raises DataError unless each scored frame is given once."""
    for wrong, what in (
        (given > 1, "stands there twice"),
        (is_scored & (given == 0), "is missing"),
    ):
        if wrong.any():
            row, frame = np.argwhere(wrong)[0]
            if not given[row].any():
                raise DataError(
                    f"{source}: pair '{segments.pair_ids[row]}' is missing, in '{task}': all pairs"
                    " of a task are asked for, or none"
                )
            raise DataError(
                f"{source}, column time_s: {frame * segments.pairs.dt:g} s of pair"
                f" '{segments.pair_ids[row]}' {what}, in '{task}'"
            )


def _forecast_errors(
    suite: Suite, task: Task, pairs: Sequence[Pair], table: pd.DataFrame, source: str
) -> pd.DataFrame:
    """Returns a row per horizon and pair."""
    segments = segments_of(suite, task, pairs)
    batch = segments.batch()
    dt = batch.dt
    origins = (segments.begin + segments.first).tolist()
    moments = dict(
        zip(zip(segments.pair_ids, origins, strict=True), range(len(segments)), strict=True)
    )
    frame = np.rint(table["origin_s"].to_numpy() / dt).astype(np.int64)
    keys = pd.MultiIndex.from_arrays([table["pair_id"], frame])
    number = pd.Series(moments).reindex(keys).to_numpy(dtype=np.float64)
    if np.isnan(number).any():
        at = int(np.flatnonzero(np.isnan(number))[0])
        wrong = table.iloc[at]
        raise DataError(
            f"{source}, row {at + 1}, column origin_s: {wrong['origin_s']:g} s of pair"
            f" '{wrong['pair_id']}' is no moment of '{task.name}'"
        )
    labelled = table.assign(moment=number.astype(np.int64))
    of_moment = _about(suite, task.name, pairs).set_index("pair_id").loc[list(segments.pair_ids)]
    parts = []
    for horizon in suite.horizons:
        here = labelled[np.isclose(labelled["horizon_s"], horizon)]
        measured = batch.follower_speed[
            torch.arange(len(segments)), segments.first + round(horizon / dt)
        ].numpy()
        scores = _scores(here, measured, segments, horizon, source)
        scored = of_moment.reset_index().assign(**scores, task=horizon_task(horizon))
        parts.append(_over_moments(scored))
    return pd.concat(parts, ignore_index=True)


def _scores(
    table: pd.DataFrame, measured: Floats, segments: Segments, horizon: float, source: str
) -> dict[str, Floats]:
    """Returns squared error, CRPS and coverage of each of Q moments."""
    of = "quantile" if "quantile" in table.columns else "sample"
    twice = table.duplicated(["moment", of]).to_numpy()
    if twice.any():
        moment = int(table["moment"].iloc[int(np.flatnonzero(twice)[0])])
        raise DataError(_of_moment(segments, moment, of, horizon, source, "stands there twice"))
    wide = table.pivot_table("speed_mps", "moment", of).reindex(range(len(measured)))
    values = wide.to_numpy(dtype=np.float64)
    lacking = np.isnan(values).any(1) if values.shape[1] else np.ones(len(measured), dtype=bool)
    if lacking.any():
        moment = int(np.flatnonzero(lacking)[0])
        raise DataError(_of_moment(segments, moment, of, horizon, source, "is missing"))
    if of == "quantile":
        return _of_quantiles(values, wide.columns.to_numpy(dtype=np.float64), measured)
    mean = values.mean(1)
    if values.shape[1] == 1:
        crps, coverage = np.abs(mean - measured), np.full(len(mean), np.nan)
    else:
        crps = scoringrules.crps_ensemble(measured, values, estimator="fair")
        low, high = np.quantile(values, (_LOW, 1.0 - _LOW), axis=1)
        coverage = ((measured >= low) & (measured <= high)).astype(np.float64)
    return {"square": (mean - measured) ** 2, "crps_speed": crps, "coverage": coverage}


def _of_moment(
    segments: Segments, moment: int, of: str, horizon: float, source: str, what: str
) -> str:
    """Returns what is wrong with the forecasts of a moment."""
    origin = int(segments.begin[moment] + segments.first[moment]) * segments.pairs.dt
    pair_id = segments.pair_ids[moment]
    return f"{source}: a {of} at {horizon:g} s after {origin:g} s of pair '{pair_id}' {what}"


def _of_quantiles(values: Floats, levels: Floats, measured: Floats) -> dict[str, Floats]:
    """Returns the scores of quantiles `(Q, levels)`; their median is the point forecast."""
    ordered = np.sort(values, axis=1)
    low, high = _quantile(ordered, levels, _LOW), _quantile(ordered, levels, 1.0 - _LOW)
    coverage = ((measured >= low) & (measured <= high)).astype(np.float64)
    if levels.min() > _LOW or levels.max() < 1.0 - _LOW:  # nothing is said of the central 90 %
        coverage = np.full(len(measured), np.nan)
    return {
        "square": (_quantile(ordered, levels, 0.5) - measured) ** 2,
        "crps_speed": scoringrules.crps_quantile(measured, ordered, levels),
        "coverage": coverage,
    }


def _quantile(ordered: Floats, levels: Floats, level: float) -> Floats:
    """Returns one quantile of each row, between the nearest two that are given."""
    right = int(np.clip(np.searchsorted(levels, level), 1, max(1, len(levels) - 1)))
    if len(levels) == 1:
        return ordered[:, 0]
    share = (level - levels[right - 1]) / (levels[right] - levels[right - 1])
    share = float(np.clip(share, 0.0, 1.0))
    return (1.0 - share) * ordered[:, right - 1] + share * ordered[:, right]


def _over_moments(scored: pd.DataFrame) -> pd.DataFrame:
    """Returns a row per pair: the root mean square error, mean CRPS and coverage of its moments."""
    grouped = scored.groupby(["task", "site", "pair_id", "driver"], sort=False)
    means = grouped[["square", "crps_speed", "coverage"]].mean()
    means["frames"] = grouped.size()
    means["rmse_speed"] = np.sqrt(means.pop("square"))
    table = means.reset_index()
    for name in METRICS:
        if name not in table.columns:
            table[name] = np.nan
    return table[["task", "site", "pair_id", "driver", "frames", *METRICS]]
