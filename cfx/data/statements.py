"""What a file says twice must agree: by this a file in two units is found.

Positions and speeds in metres go together, whatever the unit of lengths and headways beside them.
Many layouts hold more than a pair needs: the headway beside positions, the time headway beside
speeds, the leader's speed beside the leader's own row. A reader hands over such columns, each with
what follows from others (`Statement`). Medians count, since rows are noisy. A factor between two
units is a contradiction, which `data.check` refuses; anything else is a doubt, of which a job
warns: publishers define a headway from front to front or from bumper to bumper.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from cfx.data.files import Floats
from cfx.data.pairs import Remark

__all__ = [
    "Statement",
    "remarks_of",
]
"""What plugins may use, as `cfx.plugin.statements`."""


_ROOM = 0.08
"""How far the logarithm of what is said may be from that of what follows."""

_MOST = 0.5
"""Share of the rows that agree in a file that says the same thing twice, at least."""

_LEAST = 20
"""Rows that say something, at least."""

_LOOKED_AT = 200_000
"""Rows that are looked at, spread over the file."""

_FACTORS = {
    1 / 0.3048: "feet and metres",
    3.6: "km/h and m/s",
    1 / 0.44704: "mph and m/s",
    0.44704 / 0.3048: "ft/s and mph",
    100.0: "centimetres and metres",
    1000.0: "thousandths and whole units",
}
"""Factors between units in which recordings are; km/h and ft/s are too near each other."""

_SAME = 0.03
"""How far the logarithm of a factor may be from that of one between two units."""


class Statement(NamedTuple):
    """A column, and what follows for it from others; `(N,)` each.

    Attributes:
        column: as the file calls it.
        said: its values; 0 and NaN say nothing.
        follows: what follows from others, in the column's unit, by each definition that publishers
            may mean; NaN: nothing follows.
        basis: what it follows from, in words.
        resolution: how far values may differ by rounding, in the column's unit.
    """

    column: str
    said: Floats
    follows: Sequence[Floats]
    basis: str
    resolution: float = 0.0


def remarks_of(statements: Iterable[Statement]) -> tuple[Remark, ...]:
    """Returns a remark on each column that does not agree with the others."""
    remarks = []
    for statement in statements:
        remark = _remark_of(statement)
        if remark is not None:
            remarks.append(remark)
    return tuple(remarks)


class _Comparison(NamedTuple):
    """How a column compares with one definition of it.

    Attributes:
        agree: share of the rows that agree.
        factor: median of what is said over what follows.
        steady: share of the rows that have this factor.
    """

    agree: float
    factor: float
    steady: float


def _remark_of(statement: Statement) -> Remark | None:
    """Returns a remark on a column; None if it agrees with the others, or too few rows compare."""
    comparisons = []
    for follows in statement.follows:
        comparison = _compared(statement.said, follows, statement.resolution)
        if comparison is not None:
            comparisons.append(comparison)
    if not comparisons:
        return None
    closest = max(comparisons, key=lambda comparison: comparison.agree)
    if closest.agree >= _MOST:
        return None
    for factor, units in _FACTORS.items():
        for comparison in comparisons:
            is_unit = abs(abs(np.log(comparison.factor)) - np.log(factor)) < _SAME
            if is_unit and comparison.steady >= _MOST:
                return Remark(
                    f"{statement.column} is typically {comparison.factor:.3g} times what follows"
                    f" from {statement.basis}, as between {units}: the file seems to be in two"
                    " units",
                    is_contradiction=True,
                )
    return Remark(
        f"{statement.column} agrees with {statement.basis} in {closest.agree:.0%} of the rows only,"
        f" and is typically {closest.factor:.3g} times what follows: are both of these vehicles?"
    )


def _compared(stated: Floats, follows: Floats, resolution: float) -> _Comparison | None:
    """Compares a column with what follows for it; None where too few rows say something."""
    says = np.isfinite(stated) & np.isfinite(follows) & (stated != 0) & (follows != 0)
    rows = np.flatnonzero(says)
    if len(rows) < _LEAST:
        return None
    rows = rows[:: -(-len(rows) // _LOOKED_AT)]
    stated, follows = stated[rows], follows[rows]
    ratio = stated / follows
    agrees = (np.abs(stated - follows) <= resolution) | (np.abs(ratio - 1) <= _ROOM)
    logs = np.log(np.abs(ratio))
    median = float(np.median(logs))
    steady = np.abs(logs - median) <= _ROOM
    return _Comparison(float(agrees.mean()), float(np.exp(median)), float(steady.mean()))
