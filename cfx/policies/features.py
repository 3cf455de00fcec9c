"""Features that networks read: inputs of policies as one token per window, and normalisation.

The token of a window holds the last `length` frames up to and including the window's first, so it
never looks ahead. Shapes: f features of a token, N networks, B drivers of each, W windows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from cfx.errors import nearest
from cfx.policies.history import History
from cfx.policies.inputs.base import PolicyInput

Summary = Literal["frames", "last", "mean", "mean_std"]
"""What networks read of the frames of a window: all, the last, the mean, or mean and deviation."""


def _summarised(values: Tensor, summary: Summary) -> list[Tensor]:
    """Returns what a token holds of one signal `(*batch, length)`, features `(*batch,)` each."""
    if summary == "frames":
        return list(values.unbind(-1))
    if summary == "last":
        return [values[..., -1]]
    if summary == "mean":
        return [values.mean(-1)]
    return [values.mean(-1), values.std(-1, correction=0)]


def named(
    sets: Mapping[str, tuple[str, ...]], names: Callable[[], Collection[str]], what: str
) -> Callable[[object], object]:
    """Returns the check of a setting that is the name of a set, or a list of names and sets.

    The check returns names, a set's in its place. It raises ValueError for a name that is unknown
    or stands twice, and for no name where there is no set `none`.

    Args:
        sets: names that stand for several.
        names: gives all that there are.
        what: one of them in words, such as `input`.
    """

    def check(value: object) -> object:
        if isinstance(value, str):
            return _names_of_set(value, sets, names(), what)
        if not isinstance(value, list | tuple):
            return value
        chosen: list[str] = []
        for part in value:
            if not isinstance(part, str):
                return value  # the type of the setting says what is wrong
            chosen.extend(sets.get(part, (part,)))
        _require_known(chosen, names(), what)
        if not chosen and "none" not in sets:
            raise ValueError(f"give at least one of {', '.join(names())}")
        return tuple(chosen)

    return check


def _names_of_set(
    value: str, sets: Mapping[str, tuple[str, ...]], names: Collection[str], what: str
) -> tuple[str, ...]:
    """Returns the names that a set stands for; raises ValueError if there is no such set."""
    if value in sets:
        return sets[value]
    hint = nearest(value, [*sets, *names])
    if value in names:
        hint = f" Write [{value}]."
    raise ValueError(
        f"not a set of {what}s.{hint} Give {', '.join(sets)}, or a list of {', '.join(names)}"
    )


def _require_known(chosen: Sequence[str], names: Collection[str], what: str) -> None:
    """Raises ValueError for a name that is unknown or stands twice."""
    for name in chosen:
        if name not in names:
            hint = nearest(name, names)
            raise ValueError(f"unknown {what} '{name}'.{hint} Known: {', '.join(names)}")
    if len(set(chosen)) != len(chosen):
        raise ValueError(f"one {what} stands twice in {', '.join(chosen)}")


def token_width(inputs: Sequence[object], summary: Summary, length: int) -> int:
    """Returns f where a token holds `length` frames of some inputs, or of what they are called."""
    if summary == "frames":
        return len(inputs) * length
    if summary == "mean_std":
        return len(inputs) * 2
    return len(inputs)


def tokens(history: History, inputs: Sequence[PolicyInput], summary: Summary) -> Tensor:
    """Returns tokens `(*batch, f)` of recent frames `(*batch, length)`."""
    features = []
    for policy_input in inputs:
        features += _summarised(policy_input.values(history), summary)
    return torch.stack(features, dim=-1)


_LEAST_SCALE = 1e-6
"""A feature whose standard deviation is not above this counts as constant and keeps scale 1."""


class Scaler(nn.Module):
    """Brings features to mean 0 and standard deviation 1 over each network's training windows."""

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        """Takes `(N, f)` each."""
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("scale", scale)

    @classmethod
    def of(cls, values: Tensor, mask: Tensor) -> Scaler:
        """Measures features.

        Args:
            values: `(N, B, W, f)`.
            mask: which windows count, bool `(N, B, W)`.
        """
        return cls.of_shards(lambda: [(values, mask)])

    @classmethod
    def of_shards(cls, shards: Callable[[], Iterable[tuple[Tensor, Tensor]]]) -> Scaler:
        """As `of`, some drivers after the other.

        Args:
            shards: gives features `(N, b, W, f)` and masks `(N, b, W)` of the next drivers; called
                twice.
        """
        total, added = torch.zeros(()), torch.zeros(())
        for values, mask in shards():
            weight = mask[..., None].to(values.dtype)
            total = total.to(weight) + weight.sum((1, 2))
            added = added.to(weight) + (values * weight).sum((1, 2))
        total = total.clamp(min=1.0)
        mean, squares = added / total, torch.zeros_like(added)
        for values, mask in shards():
            weight = mask[..., None].to(values.dtype)
            squares += ((values - mean[:, None, None]).square() * weight).sum((1, 2))
        scale = (squares / total).sqrt()
        return cls(mean, torch.where(scale > _LEAST_SCALE, scale, 1.0))

    def forward(self, values: Tensor) -> Tensor:
        """Returns normalised features `(N, B, W, f)`."""
        return (values - self.mean[:, None, None]) / self.scale[:, None, None]
