"""What the console shows of metrics: a row per method."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def metrics_table(
    title: str,
    methods: Iterable[str],
    columns: Mapping[str, tuple[str, str]],
    metrics: Mapping[str, float],
) -> Table:
    """Returns a table for the console with a row per method; what is not known is an empty cell.

    `columns`: by heading what a metric is called before `/METHOD`, and how it is formatted.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("method")
    for heading in columns:
        table.add_column(heading, justify="right")
    for method in methods:
        cells = []
        for name, form in columns.values():
            value = metrics.get(f"{name}/{method}", math.nan)
            cells.append(f"{value:{form}}" if math.isfinite(value) else "")
        table.add_row(method, *cells)
    return table
