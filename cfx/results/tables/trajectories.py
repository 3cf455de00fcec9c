"""The table of what each method simulated."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from cfx.evaluation.result import Evaluation
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import PAIR, TIME


class Trajectories(ResultTable):
    """What each method simulated on the test part, a row per frame.

    A pair's first row is the last measured state before the simulation takes over.
    """

    meaning = "what each method simulated"
    order = 30
    always = True
    large = True
    columns = (
        PAIR,
        TIME,
        Column("leader_speed", "m/s", "measured"),
        Column("real_speed", "m/s", "measured, of the follower"),
        Column("real_gap", "m", "measured"),
        Column("speed_METHOD", "m/s", "simulated, of the follower"),
        Column("gap_METHOD", "m", "simulated"),
        Column("NAME_METHOD", "as of the parameter", "a tuned parameter that held at the frame"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return evaluation.trajectories_tables()
