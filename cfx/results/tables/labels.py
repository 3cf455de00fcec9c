"""The table of what a learner imitates."""

from __future__ import annotations

from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import PAIR


class Labels(ResultTable):
    """Parameters that were calibrated window by window, for a learner that imitates them."""

    meaning = "per-window calibrated parameters (labels), with their loss and sensitivity"
    order = 60
    tracked = ""
    columns = (
        PAIR,
        Column("window", "1", "number of the window, from 0", "int", required=False),
        Column("time_s", "s", "start of the window, since the start of the pair"),
        Column("parameter_NAME", "as of the parameter", "what was calibrated"),
        Column("loss", "as of the objective", "the loss with these parameters"),
        Column("sensitivity", "as of the objective", "by how much the choice changes the loss"),
        Column("diverged", "1", "whether the simulation diverged", "bool", required=False),
    )
