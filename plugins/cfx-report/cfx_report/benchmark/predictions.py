"""Simulated trajectories and forecasts as files, which are scored without the code that made them.

`trajectories.parquet` has a row for each task, pair and frame that is tested:

| column | unit | meaning |
| --- | --- | --- |
| `task`, `pair_id` | | as the suite calls them |
| `time_s` | s | after the pair's first frame |
| `speed_mps` | m/s | of the follower |
| `gap_m` | m | bumper to bumper, behind the recorded leader |

`forecasts.parquet` has a row for each pair, moment, horizon and sample (or quantile):

| column | unit | meaning |
| --- | --- | --- |
| `pair_id` | | |
| `origin_s` | s | the moment, after the pair's first frame |
| `horizon_s` | s | after the moment |
| `sample` | | its number; or in its place |
| `quantile` | | 0 to 1, the same ones everywhere |
| `speed_mps` | m/s | of the follower |
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.errors import DataError
from cfx.plugin import files, names
from cfx_report.benchmark.segments import Segments

TRAJECTORIES, FORECASTS = "trajectories.parquet", "forecasts.parquet"

TRAJECTORY_COLUMNS = ("task", "pair_id", "time_s", "speed_mps", "gap_m")
FORECAST_COLUMNS = ("pair_id", "origin_s", "horizon_s", "speed_mps")
OF_SAMPLE = ("sample", "quantile")
"""One of both says which number of a distribution a row of forecasts is."""


def write(table: pd.DataFrame, path: Path) -> None:
    """Writes predictions, whole or not at all."""
    with files.atomic_write(path) as temporary:
        table.to_parquet(temporary, index=False, compression="zstd")


def trajectory_table(task: str, segments: Segments, speed: Tensor) -> pd.DataFrame:
    """Returns simulated trajectories as a table.

    Args:
        task: its name.
        segments: Q whole pairs.
        speed: `(Q, T)`, m/s, that after `first` counts.
    """
    batch = segments.batch()
    frames = torch.arange(batch.mask.shape[1])
    first = segments.first[:, None]
    moved = torch.where(frames > first, speed, 0.0).cumsum(1) * batch.dt
    start = batch.follower_position.gather(1, first)
    gap = batch.leader_position - batch.leader_length[:, None] - (start + moved)
    row, frame = ((frames > first) & batch.mask).nonzero(as_tuple=True)
    return pd.DataFrame(
        {
            "task": task,
            "pair_id": np.asarray(segments.pair_ids, dtype=object)[row.numpy()],
            "time_s": frame.numpy() * batch.dt,
            "speed_mps": speed[row, frame].numpy(),
            "gap_m": gap[row, frame].numpy(),
        }
    )


def forecast_table(segments: Segments, speed: Tensor, horizons: Sequence[float]) -> pd.DataFrame:
    """Returns forecasts as a table.

    Args:
        segments: Q moments.
        speed: `(S, Q, T)`, m/s.
        horizons: s.
    """
    dt = segments.pairs.dt
    samples, moments = speed.shape[:2]
    ids = np.asarray(segments.pair_ids, dtype=object)
    origin = (segments.begin + segments.first).numpy() * dt
    parts = []
    for horizon in horizons:
        at = (segments.first + round(horizon / dt)).expand(samples, -1)
        columns = {
            "pair_id": np.tile(ids, samples),
            "origin_s": np.tile(origin, samples),
            "horizon_s": horizon,
            "sample": np.repeat(np.arange(samples), moments),
            "speed_mps": speed.gather(2, at[..., None])[..., 0].numpy().ravel(),
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def read(path: Path) -> pd.DataFrame:
    """Reads predictions of either kind.

    Raises:
        DataError: the file cannot be read, a column is missing, or a value is none.
    """
    try:
        table = pd.read_parquet(path).reset_index(drop=True)  # rows are counted in messages
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as Parquet ({error})") from None
    needed = FORECAST_COLUMNS if "horizon_s" in table.columns else TRAJECTORY_COLUMNS
    for column in needed:
        if column not in table.columns:
            raise DataError(
                f"{path}: column {column} is missing; docs/benchmark.md lists the columns of"
                " trajectories and of forecasts"
            )
    if needed is FORECAST_COLUMNS:
        _require_one_of(table, path)
    for column in (*needed, *OF_SAMPLE):
        if column in table.columns and column not in {"task", "pair_id"}:
            table[column] = _numbers(table, column, path)
    return table.assign(pair_id=names.names_of(table["pair_id"]))


def _require_one_of(table: pd.DataFrame, path: Path) -> None:
    """Raises DataError unless forecasts are samples or quantiles."""
    if len([column for column in OF_SAMPLE if column in table.columns]) != 1:
        raise DataError(
            f"{path}: forecasts need the column sample or the column quantile, and not both"
        )
    if "quantile" in table.columns:
        outside = ~table["quantile"].between(0.0, 1.0, inclusive="neither")
        if outside.any():
            row = int(np.flatnonzero(outside)[0])
            raise DataError(
                f"{path}, row {row + 1}, column quantile: {table['quantile'].iloc[row]} is no"
                " quantile; give numbers between 0 and 1"
            )


def _numbers(table: pd.DataFrame, column: str, path: Path) -> pd.Series:
    """Returns a column as numbers.

    Raises:
        DataError: one of them is none, is not finite, or is a speed below 0.
    """
    values = pd.to_numeric(table[column], errors="coerce").astype(np.float64)
    wrong = ~np.isfinite(values)
    if column == "speed_mps":
        wrong |= values < 0.0
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        what = "number of 0 or more" if column == "speed_mps" else "finite number"
        raise DataError(
            f"{path}, row {row + 1}, column {column}: {table[column].iloc[row]!r} is no {what}"
        )
    return values
