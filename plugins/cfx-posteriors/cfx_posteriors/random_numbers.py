"""Random numbers for libraries that draw from PyTorch's global generator and take no other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class DrawsFrom(TorchDispatchMode):  # type: ignore[no-untyped-call] # PyTorch's has no types
    """Lets all operations of this thread draw from one generator in the block.

    To seed the global one and to put it back would give other threads of the program their numbers
    again. The numbers are those that the global one would give with the same seed.

    Args:
        generator: on the CPU.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._generator = generator

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        given, values = dict(kwargs or {}), list(args)
        operation = _with_generator(func)
        if operation is not None:
            names = [argument.name for argument in operation._schema.arguments]  # noqa: SLF001 - as below
            place = names.index("generator")
            if place < len(values):
                values[place] = values[place] or self._generator
            elif given.get("generator") is None:
                given["generator"] = self._generator
        return (operation or func)(*values, **given)


def _with_generator(operation: Any) -> Any:
    """Returns the form of a drawing operation that takes a generator; None for all others."""
    if torch.Tag.nondeterministic_seeded not in operation.tags:
        return None
    # PyTorch's own modes look at these; there is no public name.
    if any(argument.name == "generator" for argument in operation._schema.arguments):  # noqa: SLF001
        return operation
    name = operation._overloadname  # noqa: SLF001
    wanted = "generator" if name == "default" else f"{name}_generator"
    packet = operation.overloadpacket
    if wanted in packet.overloads():
        return getattr(packet, wanted)
    return None
