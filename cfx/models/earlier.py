"""What driving models did under other names in the version before; it works for one version more.

`cfx.renamed` knows the earlier names of all components' attributes. Two of them need more where a
plugin's model uses them: `softness` is read inside the step, which torch compiles, and `smoothed`
may be overridden.
"""

from __future__ import annotations

import warnings
from types import MethodType
from typing import Any

import torch

from cfx import renamed


class EarlierNames:
    """Gives a class of driving models the earlier names of `temperature` and `at_temperature`."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Takes an override of `smoothed` for one of `at_temperature`."""
        super().__init_subclass__(**options)
        if "smoothed" in cls.__dict__:
            _warn(cls, "smoothed")
            setattr(cls, renamed.ATTRIBUTES["smoothed"], cls.__dict__["smoothed"])

    @property
    def softness(self) -> Any:
        """The earlier name of `temperature`."""
        _warn(type(self), "softness")
        return self.temperature

    @softness.setter
    def softness(self, value: Any) -> None:
        _warn(type(self), "softness")
        self.temperature = value

    @property
    def smoothed(self) -> Any:
        """The earlier name of `at_temperature`."""
        from cfx.models.base import DrivingModel

        _warn(type(self), "smoothed")
        # Not self.at_temperature: an override of `smoothed` has become that, and calls this.
        return MethodType(DrivingModel.at_temperature, self)


def _warn(cls: type, old: str) -> None:
    if torch.compiler.is_compiling():  # a warning would break the compiled graph
        return
    text = (
        f"{cls.__name__}.{old} is now called {renamed.ATTRIBUTES[old]}; the old name goes with the"
        " next version"
    )
    warnings.warn(text, DeprecationWarning, stacklevel=3)
