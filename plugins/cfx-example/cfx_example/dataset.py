"""A dataset: where pairs of a leader and a follower come from. This one reads a CSV file.

A job calls `load` once, before all else, which calls `read`; cfx then checks the pairs and leaves
out those that the settings of every dataset exclude (`min_duration`, `max_pairs`, ...).
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
from cfx.errors import DataError
from cfx.plugin import Dataset, DatasetSettings, Pair, PairSet, Settings
from pydantic import Field

COLUMNS = ["pair", "time_s", "leader_x_m", "leader_v_mps", "follower_x_m", "follower_v_mps"]


class PairCsvSettings(DatasetSettings):
    """Settings of `pair_csv`."""

    path: Path = Field(description="the CSV file")
    leader_length: float = Field(4.8, gt=0, description="length of every leader, m")


class PairCsv(Dataset):
    """Reads one row per pair and frame.

    Positions are front bumpers along the lane, and the time step is constant.
    """

    schema: ClassVar[type[Settings]] = PairCsvSettings
    settings: PairCsvSettings

    def read(self) -> PairSet:
        path = self.settings.path.expanduser()
        try:
            table = pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise DataError(f"{path} cannot be read as CSV: {error}") from error
        missing = [column for column in COLUMNS if column not in table]
        if missing:
            raise DataError(
                f"{path}: the columns {', '.join(missing)} are missing;"
                f" it must have {', '.join(COLUMNS)}"
            )
        pairs = []
        for name, rows in table.groupby("pair", sort=True):
            pairs.append(self._pair(str(name), rows, path))
        return PairSet(tuple(pairs), str(path))

    def _pair(self, name: str, rows: pd.DataFrame, path: Path) -> Pair:
        time = rows["time_s"].to_numpy(float)
        steps = np.diff(time)
        if len(steps) == 0 or not steps[0] > 0 or not np.allclose(steps, steps[0]):
            raise DataError(
                f"{path}, pair {name}: time_s must rise by the same step from row to row"
            )
        signals = {column: rows[column].to_numpy(float) for column in COLUMNS[2:]}
        dt = float(steps[0])
        return Pair(
            pair_id=name,
            recording=path.stem,
            leader_id=f"{name}-leader",
            follower_id=f"{name}-follower",
            first_frame=0,
            dt=dt,
            leader_length=self.settings.leader_length,
            leader_position=signals["leader_x_m"],
            leader_speed=signals["leader_v_mps"],
            leader_acceleration=np.gradient(signals["leader_v_mps"], dt),
            follower_position=signals["follower_x_m"],
            follower_speed=signals["follower_v_mps"],
            follower_acceleration=np.gradient(signals["follower_v_mps"], dt),
        )
