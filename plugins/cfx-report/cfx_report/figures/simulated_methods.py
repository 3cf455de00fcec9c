"""Which methods figures of simulated pairs show."""

from __future__ import annotations

from cfx.plugin import Result, canvas


def simulated_methods(result: Result) -> list[str]:
    """Returns the methods whose trajectories a result has, without those that figures leave out."""
    simulated = result.trajectories[0].speed
    methods = []
    for method in result.shown_methods:
        if method in simulated and method not in canvas.HIDDEN:
            methods.append(method)
    return methods
