"""Keys of recorded steps, within one process and, where that is safe, on disk."""

from __future__ import annotations

import inspect
from typing import NamedTuple

import torch

from cfx.core.component import content_key, folder_hash
from cfx.simulation import step


class ComponentKey(NamedTuple):
    """Key of a component's equations.

    Attributes:
        component: the class.
        settings: as JSON, without what is an input of the equations.
    """

    component: type
    settings: str


class KernelKey(NamedTuple):
    """Key of a kernel.

    Attributes:
        model: the driving model.
        temperature: of the model.
        terms: what the terms depend on; a name that only this process understands otherwise.
        dt: time step, s.
        parameters: names of the model's parameters, and whether candidates differ in each.
        dtype: of all values.
        summed: whether terms are summed up over frames.
    """

    model: ComponentKey
    temperature: float
    terms: ComponentKey | str
    dt: float
    parameters: tuple[tuple[str, bool], ...]
    dtype: torch.dtype
    summed: bool = True

    def lasting(self) -> str | None:
        """Returns a key that other processes agree on; None if there is none.

        Classes made inside functions have none: what they do may depend on variables there.
        """
        if isinstance(self.terms, str):
            return None
        # The step itself, and how it is recorded and written.
        described: list[object] = [folder_hash(step.__file__), folder_hash(__file__)]
        for key in (self.model, self.terms):
            code = component_code(key.component)
            if code is None:
                return None
            described.append([code, key.settings])
        described += [self.temperature, self.dt, self.parameters, self.dtype, self.summed]
        described.append(torch.__version__)
        return content_key(described)


def component_code(component: type) -> list[str] | None:
    """Returns the name and the code of a class and all that it inherits from.

    It is None where no file has it.
    """
    if getattr(component, "process_code", ""):
        return None
    found = []
    for part in component.__mro__:
        if part.__module__ in {"abc", "builtins", "typing"}:
            continue
        if "<locals>" in part.__qualname__:
            return None
        try:
            code = folder_hash(inspect.getfile(part))
        except (OSError, TypeError):
            return None
        found.append(f"{part.__module__}.{part.__qualname__} {code}")
    return found
