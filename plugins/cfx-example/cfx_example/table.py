"""A table of results: a file in the folder of each job. This one counts measured speeds.

A job calls `rows` once, when everything is evaluated, then `metrics`, whose numbers stand in
`metrics.json` and in MLflow.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from cfx.plugin import Column, Evaluation, ResultTable
from numpy.typing import NDArray


class SpeedBins(ResultTable):
    """How many measured frames of the followers lie in each bin of speed."""

    meaning = "how often each speed of a follower was measured"
    columns = (
        Column("speed", "m/s", "the lower end of the bin, which is 1 m/s wide"),
        Column("frames", "1", "measured frames in the bin", "int"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        speeds = _speeds(evaluation)
        bins, counts = np.unique(np.floor(speeds), return_counts=True)
        return [pd.DataFrame({"speed": bins, "frames": counts})]

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return {"speed_bins/highest": float(_speeds(evaluation).max())}


def _speeds(evaluation: Evaluation) -> NDArray[np.float64]:
    """Returns all measured speeds of followers, m/s."""
    return np.concatenate([pair.follower_speed for pair in evaluation.recorded or ()])
