"""Parameters of driving models: one frozen specification that feeds everything else.

Calibration bounds, policy outputs, config nodes, the documentation table and the contract tests all
read the same `ParameterSpace`. A *tuned* parameter is calibrated and adapted. The others are
constants of the config that a user may set, or turn into tuned ones
(`model.parameters.a.tuned=true`). A tuned parameter is *frozen* where policies of offsets leave it
at its base, and *adaptable* otherwise.

Shapes: a parameter tensor is `(*batch, n)`, n being the number of *tuned* parameters, in the order
of `ParameterSpace.names`. *Unit space* is the same tensor mapped linearly so that each bound is 0
or 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from pydantic import Field

from cfx.core.component import Settings
from cfx.errors import ParameterError, nearest

if TYPE_CHECKING:
    import torch
    from torch import Tensor


_EDGE = 0.005
"""Least distance to a bound, in unit space, that a logit is taken at, so that it is finite."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a driving model.

    Attributes:
        name: short name, the key in configs and columns.
        unit: SI unit, "1" for a pure number.
        low, high: bounds in that unit; calibration and policies never leave them.
        default: the value of the method `default`, within the bounds.
        meaning: one line.
        source: where default and bounds come from.
        tuned: whether calibration and policies choose it; a constant otherwise.
        frozen: whether policies of offsets leave it at its base
            (`ModelSettings.adaptation_bounds`).
        used_with: the model's setting and its value with which the model uses the parameter, such
            as `("variant", "vissim")`; None: it always does. With another value the parameter is
            not tuned, and stays at its default.
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    meaning: str
    source: str = ""
    tuned: bool = True
    frozen: bool = False
    used_with: tuple[str, object] | None = None

    def __post_init__(self) -> None:
        finite = math.isfinite(self.low) and math.isfinite(self.high)
        if not finite or not math.isfinite(self.default):
            raise ParameterError(
                f"parameter {self.name}: bounds and default must be finite numbers"
            )
        if not self.low < self.high:
            raise ParameterError(
                f"parameter {self.name}: low ({self.low}) must be below high ({self.high})"
            )
        if not self.low <= self.default <= self.high:
            raise ParameterError(
                f"parameter {self.name}: default {self.default} lies outside its bounds"
                f" [{self.low}, {self.high}] {self.unit}; give a value within them, or move"
                f" model.parameters.{self.name}.low or .high"
            )

    def is_used(self, settings: Settings) -> bool:
        """Says whether a model with these settings uses the parameter."""
        if self.used_with is None:
            return True
        name, value = self.used_with
        return bool(getattr(settings, name) == value)


_WIDEST = 100.0
"""How many times as large as a model's own bounds a config's may be; a unit is wrong beyond."""


def _require_possible(declared: Parameter, key: str, low: float | None, high: float | None) -> None:
    """Raises ParameterError for bounds of another sign than a model's, or far beyond them."""
    most = _WIDEST * max(abs(declared.low), abs(declared.high))
    wrong = ""
    for value in (low, high):
        if value is None:
            continue
        if declared.low >= 0 > value:
            wrong = f"{value:g} is negative"
        elif declared.high <= 0 < value:
            wrong = f"{value:g} is positive"
        elif abs(value) > most:
            wrong = f"{value:g} is more than {_WIDEST:g} times as far"
    if wrong:
        raise ParameterError(
            f"{key}: {wrong}, and the model's own bounds of {declared.name} are"
            f" [{declared.low:g}, {declared.high:g}] {declared.unit}; give bounds that it can have"
        )


class ParameterOverride(Settings):
    """Changes of one parameter by a config; the rest stays as the model declares it."""

    low: float | None = Field(None, description="lower bound")
    high: float | None = Field(None, description="upper bound")
    default: float | None = Field(
        None, description="value of the method 'default', and of a parameter that is not tuned"
    )
    tuned: bool | None = Field(
        None,
        description="whether calibration and policies choose it; null: as the model declares, and"
        " not where its settings leave the parameter out",
    )


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered set of parameters.

    Attributes:
        parameters: in order.
        open: a config may add parameters that it names, with both bounds and the default.
        tuned: those of them that are tuned.
        names: names of the tuned parameters, in tensor order.

    Example:
        >>> space = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time headway"))
        >>> space.names
        ('tau',)
    """

    parameters: tuple[Parameter, ...]
    open: bool = False
    tuned: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)
    names: tuple[str, ...] = field(init=False, repr=False, compare=False)
    _by_name: dict[str, Parameter] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        tuned = tuple(parameter for parameter in self.parameters if parameter.tuned)
        object.__setattr__(self, "tuned", tuned)
        object.__setattr__(self, "names", tuple(parameter.name for parameter in tuned))
        by_name = {parameter.name: parameter for parameter in self.parameters}
        if len(by_name) != len(self.parameters):
            raise ParameterError("a parameter space names each parameter once")
        object.__setattr__(self, "_by_name", by_name)

    @classmethod
    def of(cls, *parameters: Parameter) -> ParameterSpace:
        return cls(parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __len__(self) -> int:
        """The number of tuned parameters, n."""
        return len(self.tuned)

    def __getitem__(self, name: str) -> Parameter:
        if name not in self._by_name:
            raise ParameterError(
                f"unknown parameter '{name}'.{nearest(name, self._by_name)} Known:"
                f" {', '.join(self._by_name)}."
            )
        return self._by_name[name]

    def for_settings(self, settings: Settings) -> ParameterSpace:
        """Returns the space of a model with these settings: unused parameters are not tuned."""
        parameters = []
        for parameter in self.parameters:
            tuned = parameter.tuned and parameter.is_used(settings)
            parameters.append(replace(parameter, tuned=tuned))
        return replace(self, parameters=tuple(parameters))

    def override(self, changes: Mapping[str, ParameterOverride]) -> ParameterSpace:
        """Returns a space with the config's changes.

        Raises:
            ParameterError: an unknown name, or bounds and default that contradict each other.
        """
        merged = []
        for parameter in self.parameters:
            change = changes.get(parameter.name)
            if change is None:
                merged.append(parameter)
            else:
                key = f"model.parameters.{parameter.name}"
                _require_possible(parameter, f"{key}.low", change.low, None)
                _require_possible(parameter, f"{key}.high", None, change.high)
                merged.append(replace(parameter, **change.model_dump(exclude_none=True)))
        for name, addition in changes.items():
            if name in self._by_name:
                continue
            if not self.open:
                raise ParameterError(
                    f"model.parameters.{name}: the model has no such parameter."
                    f"{nearest(name, self._by_name)} Known: {', '.join(self._by_name)}."
                )
            merged.append(_added(name, addition))
        space = ParameterSpace(tuple(merged))
        if not space.parameters:
            raise ParameterError(
                "give the parameters, such as"
                " model.parameters='{tau: {low: 0.5, high: 3, default: 1}}'"
            )
        if not space.tuned:
            raise ParameterError(
                "no parameter is tuned; set model.parameters.NAME.tuned=true for at least one"
            )
        return space

    def for_adaptation(self, bounds: Mapping[str, tuple[float, float] | None]) -> ParameterSpace:
        """Returns the space in which policies of offsets move parameters.

        Args:
            bounds: name -> (low, high), to which bounds move outwards as far as they are not there
                already; None: frozen. Those of other parameters stay.

        Raises:
            ParameterError: an unknown name, a lower bound that is not below the upper one, or
                nothing is left to move.
        """
        _check_adaptation(self, bounds)
        parameters = []
        for parameter in self.parameters:
            if parameter.name in bounds:
                parameters.append(_for_adaptation(parameter, bounds[parameter.name]))
            else:
                parameters.append(parameter)
        space = replace(self, parameters=tuple(parameters))
        if all(parameter.frozen for parameter in space.tuned):
            raise ParameterError(
                "model.adaptation_bounds: every tuned parameter is null, so a policy of offsets"
                " could move none; leave one out"
            )
        return space

    def adaptable(self, *, device: torch.device | str | None = None) -> Tensor | None:
        """Returns which tuned parameters a policy of offsets moves, bool `(n,)`; None: all."""
        import torch

        frozen = [parameter.frozen for parameter in self.tuned]
        if not any(frozen):
            return None
        return ~torch.tensor(frozen, device=device)

    def bounds(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Tensor:
        """Returns `(2, n)`: lower bounds, upper bounds."""
        import torch

        rows = [[p.low for p in self.tuned], [p.high for p in self.tuned]]
        return torch.tensor(rows, dtype=dtype or torch.float64, device=device)

    def defaults(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Tensor:
        """Returns `(n,)`: the default of each tuned parameter."""
        import torch

        return torch.tensor(
            [p.default for p in self.tuned], dtype=dtype or torch.float64, device=device
        )

    def to_unit(self, values: Tensor) -> Tensor:
        """Maps `(*batch, n)` from SI units to unit space."""
        low, high = self.bounds(dtype=values.dtype, device=values.device).unbind(0)
        return (values - low) / (high - low)

    def from_unit(self, unit: Tensor) -> Tensor:
        """Maps `(*batch, n)` from unit space to SI units; 0 and 1 give the bounds exactly."""
        low, high = self.bounds(dtype=unit.dtype, device=unit.device).unbind(0)
        return (low + unit * (high - low)).clamp(low, high)

    def unpack(self, values: Tensor) -> dict[str, Tensor]:
        """Splits `(*batch, n)` into one tensor `(*batch,)` per parameter, in SI units.

        Constants are included; they are 0-dimensional.

        Raises:
            ParameterError: another number of parameters.
        """
        if values.shape[-1] != len(self):
            raise ParameterError(
                f"expected {len(self)} parameters ({', '.join(self.names)}), got {values.shape[-1]}"
            )
        columns = dict(zip(self.names, values.unbind(-1), strict=True))
        named = {}
        for parameter in self.parameters:
            if parameter.tuned:
                named[parameter.name] = columns[parameter.name]
            else:
                named[parameter.name] = values.new_tensor(parameter.default)
        return named

    def check(self, values: Mapping[str, float]) -> None:
        """Checks values by name, in SI units.

        Raises:
            ParameterError: a value lies outside its parameter's bounds, or its name is unknown.
        """
        for name, value in values.items():
            parameter = self[name]
            if not parameter.low <= value <= parameter.high:
                raise ParameterError(
                    f"parameter {name}={value} lies outside its bounds"
                    f" [{parameter.low}, {parameter.high}] {parameter.unit}"
                )


def squashed(unit: Tensor) -> Tensor:
    """Returns logits of parameters in unit space, finite also at the bounds."""
    return unit.clamp(_EDGE, 1.0 - _EDGE).logit()


def _check_adaptation(
    space: ParameterSpace, bounds: Mapping[str, tuple[float, float] | None]
) -> None:
    for name, ends in bounds.items():
        parameter = space[name]
        if ends is None:
            continue
        low, high = ends
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ParameterError(
                f"model.adaptation_bounds.{name}=[{low}, {high}]: the first must be below the"
                " second, and both finite"
            )
        _require_possible(parameter, f"model.adaptation_bounds.{name}", low, high)


def _for_adaptation(parameter: Parameter, bounds: tuple[float, float] | None) -> Parameter:
    if bounds is None:
        return replace(parameter, frozen=True)
    return replace(
        parameter, low=min(parameter.low, bounds[0]), high=max(parameter.high, bounds[1])
    )


def _added(name: str, change: ParameterOverride) -> Parameter:
    """Returns a parameter that a config adds to an open space."""
    if change.low is None or change.high is None or change.default is None:
        raise ParameterError(
            f"model.parameters.{name}: give low, high and default, as nobody else knows them"
        )
    tuned = change.tuned is not False
    return Parameter(
        name,
        "",
        change.low,
        change.high,
        change.default,
        "as the model defines it",
        "configuration",
        tuned,
    )
