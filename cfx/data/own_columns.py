"""A tidy file's own names of columns and its own units: `data.columns` and `data.units`.

A quantity has one name in both. What a name says without `leader_` is the follower's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from cfx.core.component import Settings
from cfx.data.table import Column, Layout
from cfx.data.units import factor

COLUMNS = {
    "recording": "recording",
    "pair_id": "pair_id",
    "leader_id": "leader_id",
    "follower_id": "follower_id",
    "frame": "frame",
    "time": "time_s",
    "position": "follower_position_m",
    "speed": "follower_speed_mps",
    "acceleration": "follower_acceleration_mps2",
    "leader_position": "leader_position_m",
    "leader_speed": "leader_speed_mps",
    "leader_acceleration": "leader_acceleration_mps2",
    "leader_length": "leader_length_m",
    "gap": "gap_m",
    "lane": "lane",
    "driver_type": "driver_type",
    "leader_driver_type": "leader_driver_type",
    "site": "site",
    "vehicle": "vehicle",
}
"""The layout's columns by the names of settings."""


_Name = Annotated[str, Field(min_length=1)] | None


class OwnColumns(Settings):
    """Settings: what a file calls its columns."""

    recording: _Name = None
    pair_id: _Name = None
    leader_id: _Name = None
    follower_id: _Name = None
    frame: _Name = None
    time: _Name = None
    position: _Name = Field(None, description="the follower's, as the next two")
    speed: _Name = None
    acceleration: _Name = None
    leader_position: _Name = None
    leader_speed: _Name = None
    leader_acceleration: _Name = None
    leader_length: _Name = None
    gap: _Name = Field(None, description="bumper to bumper")
    lane: _Name = None
    driver_type: _Name = None
    leader_driver_type: _Name = None
    site: _Name = None
    vehicle: _Name = None


def _of(si: str) -> AfterValidator:
    """Returns a check that a unit can be turned into an SI unit."""

    def check(unit: str | None) -> str | None:
        if unit is None:
            return None
        try:
            factor(unit, si)
        except ValueError as error:
            raise PydanticCustomError("unit", "{reason}", {"reason": str(error)}) from None
        return unit

    return AfterValidator(check)


_Time = Annotated[str | None, _of("s")]
_Length = Annotated[str | None, _of("m")]
_Speed = Annotated[str | None, _of("m/s")]
_Acceleration = Annotated[str | None, _of("m/s2")]


class OwnUnits(Settings):
    """Settings: the units of the columns that a file calls by names of its own."""

    time: _Time = Field(None, description="null: s")
    position: _Length = Field(None, description="of the follower; null: m")
    speed: _Speed = Field(None, description="of the follower; null: m/s")
    acceleration: _Acceleration = Field(None, description="of the follower; null: m/s2")
    leader_position: _Length = Field(None, description="null: as position")
    leader_speed: _Speed = Field(None, description="null: as speed")
    leader_acceleration: _Acceleration = Field(None, description="null: as acceleration")
    leader_length: _Length = Field(None, description="null: m")
    gap: _Length = Field(None, description="null: m")


def own_layout(layout: Layout, columns: OwnColumns, units: OwnUnits) -> Layout:
    """Returns a layout whose columns have a file's own names and units.

    Args:
        layout: the tidy layout.

    Raises:
        ValueError: one column would be two, or a unit is given for a column whose own name has
            another.
    """
    by_name = {column.name: column for column in layout.columns}
    for name, plain in COLUMNS.items():
        by_name[plain] = _named(name, by_name[plain], columns, units)
    _require_different(by_name)
    gap = by_name[COLUMNS["gap"]].title
    result = []
    for column in by_name.values():
        result.append(replace(column, unless=gap if column.unless else ""))
    return replace(layout, columns=tuple(result))


def written_units(columns: OwnColumns, units: OwnUnits) -> dict[str, str]:
    """Returns the units that a file has in place of the layout's, by the names of settings."""
    found = {}
    for name in OwnUnits.model_fields:
        unit = unit_of(name, "", columns, units)
        if unit:
            found[name] = unit
    return found


def unit_of(name: str, si: str, columns: OwnColumns, units: OwnUnits) -> str:
    """Returns the unit in which a file has a quantity.

    Args:
        name: of the setting.
        si: the unit of the layout's column.
    """
    if getattr(columns, name) is None:
        return si
    own = getattr(units, name, None) or getattr(units, name.removeprefix("leader_"), None)
    return own or si


def _named(name: str, column: Column, columns: OwnColumns, units: OwnUnits) -> Column:
    """Returns a column with the name and the unit that a file has for it."""
    called = getattr(columns, name)
    unit = getattr(units, name, None)
    if called is None:
        if unit is not None and factor(unit, column.unit) != 1.0:
            raise ValueError(
                f"data.units.{name}={unit}: the column {column.name} is in {column.unit}, as its"
                f" name says; name the file's column in data.columns.{name}"
            )
        return column
    scale = 1.0
    if column.unit:
        scale = factor(unit_of(name, column.unit, columns, units), column.unit)
    return replace(column, called=called, factor=scale, needed=True, unless="")


def _require_different(columns: dict[str, Column]) -> None:
    """Raises ValueError if a column of the file would be two of the layout's."""
    settings = {plain: name for name, plain in COLUMNS.items()}
    seen: dict[str, str] = {}
    for column in columns.values():
        if column.title in seen:
            first, second = seen[column.title], settings.get(column.name, column.name)
            raise ValueError(
                f"data.columns: the column {column.title} would be both {first} and {second};"
                " name another one"
            )
        seen[column.title] = settings.get(column.name, column.name)
