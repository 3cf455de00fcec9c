"""A driving model of one's own, known to this process without a package."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from cfx.core import registry
from cfx.models.base import DrivingModel

M = TypeVar("M", bound=DrivingModel)


def model(name: str) -> Callable[[type[M]], type[M]]:
    """Makes a class a driving model that this process knows by a name, until it ends.

    It then is a model like all others: `cfx.calibrate(pairs, "mine")`, `cfx.run(["model=mine"])`.
    Defining it again replaces it. To share it, write a package: `cfx plugins new model mine`.

    Args:
        name: as after `model=`; not that of an installed model.

    Raises:
        PluginError: an installed model has that name, or the class does not say what a model says
            (`cfx.DrivingModel`).

    Examples:
        >>> import cfx
        >>> @cfx.model("constant_gap")
        ... class ConstantGap(cfx.DrivingModel):
        ...     "Approaches a gap that does not depend on speed."
        ...     parameters = cfx.ParameterSpace.of(
        ...         cfx.Parameter("s0", "m", 1.0, 50.0, 20.0, "gap"),
        ...         cfx.Parameter("k", "1/s2", 0.01, 1.0, 0.1, "stiffness"),
        ...     )
        ...
        ...     def next_speed(self, follower, leader, p, dt):
        ...         gap = cfx.bumper_gap(follower, leader)
        ...         approach = leader.speed - follower.speed
        ...         acceleration = p["k"] * (gap - p["s0"]) + approach
        ...         return (follower.speed + acceleration * dt).clamp(min=0.0)
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=200)
        >>> cfx.calibrate(pairs, "constant_gap", optimizer="random").parameters.columns.tolist()
        ['s0', 'k']
    """

    def register(cls: type[M]) -> type[M]:
        registry.add("model", name, cls)
        return cls

    return register
