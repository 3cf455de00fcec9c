"""Units of measurement, as pint knows them; it is imported when a unit is named."""

from __future__ import annotations

import functools
import re
from fractions import Fraction
from typing import Any

EXAMPLES = {
    "s": "s, ms or min",
    "m": "m, ft, cm or km",
    "m/s": "m/s, km/h, mph, ft/s or kn",
    "m/s2": "m/s2, ft/s2, km/h/s or g_0 (multiples of the acceleration of gravity)",
}
"""Units that a user may mean, by the SI unit that cfx counts in."""


def factor(unit: str, si: str) -> float:
    """Returns what a number in a unit is multiplied by to be in an SI unit.

    Args:
        unit: as pint reads it, such as km/h; a digit behind a letter is a power, as in ft/s2.
        si: one of `EXAMPLES`.

    Raises:
        ValueError: there is no such unit, or it measures something else.
    """
    registry = _registry()
    advice = f"write for instance {EXAMPLES[si]}"
    try:
        parsed = registry.parse_units(unit)
    except Exception:  # what is no unit raises errors of Python's tokenizer and of pint's parser
        raise ValueError(f"there is no unit '{unit}'; {advice}") from None
    if parsed.dimensionality != registry.parse_units(si).dimensionality:
        raise ValueError(f"'{unit}' cannot be turned into {si}; {advice}")
    return float(registry.Quantity(Fraction(1), parsed).to(si).magnitude)


def length_mm(text: str) -> float:
    """Returns a length such as "88mm" or "3.5 in" in mm.

    Raises:
        ValueError: it is none.
    """
    try:
        return float(_registry().Quantity(text).to("mm").magnitude)
    except Exception:  # as in `factor`
        raise ValueError("give a length with its unit, such as 88mm or 3.5in") from None


@functools.cache
def _registry() -> Any:
    """Returns cfx's own units: those of a program that uses pint stay as they are."""
    import pint

    # Fractions: a foot is 0.3048 m to the last bit.
    return pint.UnitRegistry(preprocessors=[_with_powers], non_int_type=Fraction)


def _with_powers(text: str) -> str:
    """Returns a unit in which powers are marked: m/s**2 for m/s2; g_0 stays."""
    return re.sub(r"(?<=[A-Za-z])(\d)", r"**\1", text)
