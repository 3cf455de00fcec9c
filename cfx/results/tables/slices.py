"""The table of losses along single parameters."""

from __future__ import annotations

from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import PAIR


class Slices(ResultTable):
    """The loss along each calibrated parameter, the others held."""

    meaning = (
        "the loss when one calibrated parameter is moved from bound to bound and the others are"
        " held"
    )
    order = 200
    columns = (
        PAIR,
        Column("parameter", "", "which is moved", "text"),
        Column("place", "1", "0 at the lower bound, 1 at the upper, as it is calibrated"),
        Column("value", "as of the parameter", "the parameter there"),
        Column("loss", "as of the objective", "the loss there, without the prior"),
        Column("best_loss", "as of the objective", "the loss with the calibrated parameters"),
    )
