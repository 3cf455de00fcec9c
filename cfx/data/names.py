"""What the name of a pair, a vehicle or a recording is, however a table or a setting writes it.

Tables write names as numbers or as text. pandas turns whole numbers into 10.0 where a join leaves
one missing, and text files leave blanks beside them. So 10, 10.0, "10", "10.0", "10,0" and " 10"
are one name. 007 is another: who writes zeros in front means them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

__all__ = [
    "name_of",
    "named_twice",
    "names_of",
]
"""What plugins may use, as `cfx.plugin.names`."""


_WHOLE_NUMBER = re.compile(r"-?\d+(?:\.0*|,(?:0|00|0{4,}))")
"""A whole number that is written with a decimal mark; in 1,000 the comma marks thousands."""

_MISSING = {"NoneType", "NAType", "NaTType"}
"""Types of what stands in a cell without a name; pandas is not imported for two of them."""


def name_of(value: object) -> str:
    """Returns the name that a cell, an index or a setting holds; "" where there is none."""
    if isinstance(value, float | np.floating):
        number = float(value)
        if math.isnan(number):
            return ""
        if number.is_integer():
            return str(int(number))
    if type(value).__name__ in _MISSING:
        return ""
    text = str(value).strip()
    if _WHOLE_NUMBER.fullmatch(text):
        return re.split("[.,]", text)[0]
    return text


def names_of(values: object) -> list[str]:
    """Returns the names of several values, in their order; of a single one its name alone."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        return [name_of(values)]
    return [name_of(value) for value in values]


def named_twice(names: Sequence[str]) -> str | None:
    """Returns the first name that stands twice in a list; None if each stands there once."""
    earlier: set[str] = set()
    for name in names:
        if name in earlier:
            return name
        earlier.add(name)
    return None


def _of_setting(value: Any) -> Any:
    """Returns the name that a setting holds; what is neither text nor number is left as it is."""
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        return name_of(value)
    return value


Name = Annotated[str, BeforeValidator(_of_setting)]
"""A setting that names a pair, a recording or a type of driver, as text or as a number."""
