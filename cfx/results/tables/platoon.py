"""The table of a platoon behind a leader that brakes."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from cfx.evaluation.result import Evaluation
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import METHOD


class Platoon(ResultTable):
    """Followers in a row behind a leader that brakes, a row per method, network and frame."""

    meaning = "ten such followers in a row behind a leader that brakes"
    order = 100
    columns = (
        METHOD,
        Column("network", "", "which network or parameter set chooses the parameters", "text"),
        Column("vehicle", "1", "0 is the leader", "int"),
        Column("time_s", "s", "since the start"),
        Column("speed", "m/s", "simulated"),
        Column("gap", "m", "simulated; NaN for the leader"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        platoon = evaluation.platoon
        return [None if platoon is None else platoon.table]

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        platoon = evaluation.platoon
        return {} if platoon is None else platoon.metrics()
