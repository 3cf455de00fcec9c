"""A second device without hardware: PyTorch's `meta`, with values behind it.

Code that runs on it must do what code for a GPU must do: put everything on one device, ask for
values by `.cpu()` or `.item()`, and write nothing across. The values are computed on the CPU, so
that results can be compared with those of the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

DEVICE = torch.device("meta")

_ACROSS = {"aten::_to_copy", "aten::copy_"}
"""Operations that may read from one device and write to the other."""

_CPU_INDICES = {"aten::index.Tensor", "aten::index_put_", "aten::index_put"}
"""Operations whose index may lie on the CPU, as on a GPU."""


class Elsewhere(torch.Tensor):
    """A tensor on the second device."""

    value: Tensor

    @staticmethod
    def __new__(cls, value: Tensor) -> Elsewhere:
        made: Any = torch.Tensor._make_wrapper_subclass(
            cls,
            value.shape,
            strides=value.stride(),
            storage_offset=value.storage_offset(),
            dtype=value.dtype,
            device=DEVICE,
        )
        made.value = value
        return made

    def __repr__(self, **_: Any) -> str:
        return f"Elsewhere({self.value})"

    def tolist(self) -> Any:
        return self.value.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


class _Constants(TorchFunctionMode):
    """Makes tensors of Python's numbers on the CPU, and moves them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            device = kwargs.pop("device")
            return func(*args, **kwargs).to(device)
        if func is torch.Tensor.new_tensor and args[0].device == DEVICE:
            kwargs.setdefault("dtype", args[0].dtype)
            return torch.tensor(*args[1:], **kwargs).to(DEVICE)
        return func(*args, **kwargs)


@contextmanager
def second_device() -> Iterator[None]:
    """Within it there is a second device."""
    with _Constants(), _Values():
        yield


class _Values(TorchDispatchMode):
    """Computes the values of tensors on the second device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


def dispatch(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Computes on the CPU what belongs to either device; refuses what mixes them.

    Raises:
        RuntimeError: tensors of both devices meet.
    """
    name = func._schema.name
    overload = f"{name}.{func._overloadname}" if func._overloadname != "default" else name
    there, here = [], []

    def sort(one: Any) -> Any:
        if isinstance(one, Elsewhere):
            there.append(one)
            return one.value
        if isinstance(one, Tensor) and one.dim() > 0:
            here.append(one)
        return one

    plain_args, plain_kwargs = tree_map(sort, (args, kwargs))
    device = kwargs.get("device")
    if there and here and name not in _ACROSS and not {name, overload} & _CPU_INDICES:
        raise RuntimeError(f"{overload}: tensors on two devices")
    if device is not None:
        plain_kwargs["device"] = torch.device("cpu")
    found = func(*plain_args, **plain_kwargs)
    if func._schema.is_mutable:
        if "out" in kwargs:
            return kwargs["out"]
        if name.endswith("_"):
            return args[0]
    goes_there = bool(there) if device is None else torch.device(device) == DEVICE
    if name == "aten::copy_":
        return args[0]
    if not goes_there:
        return found
    return tree_map(lambda one: Elsewhere(one) if isinstance(one, Tensor) else one, found)
