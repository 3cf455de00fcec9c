"""What a policy sees: the recent states of leader and follower, one token per window.

The token of a window holds the last `length` frames up to and including the window's first, so it never looks ahead.
Shapes: f features of a token.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from cfx.errors import ConfigError, nearest
from cfx.pairs import PairBatch

Summary = Literal["frames", "last", "mean", "mean_std"]


class History(NamedTuple):
    """Recent frames of leader and follower, oldest first; all `(*batch, length)`, SI units."""

    leader_speed: Tensor
    leader_acceleration: Tensor
    follower_speed: Tensor
    follower_acceleration: Tensor
    gap: Tensor

    @classmethod
    def of(cls, batch: PairBatch) -> History:
        """Returns all that was measured of P pairs, `(P, T)` each."""
        signals = (
            batch.leader_speed,
            batch.leader_acceleration,
            batch.follower_speed,
            batch.follower_acceleration,
        )
        return cls(*signals, batch.gap)


_STANDING = 1.0
"""Speed in m/s below which time headway and inverse time to collision are taken at this speed: they have poles at 0."""

INPUTS: dict[str, Callable[[History], Tensor]] = {
    "leader_speed": lambda h: h.leader_speed,
    "leader_acceleration": lambda h: h.leader_acceleration,
    "follower_speed": lambda h: h.follower_speed,
    "follower_acceleration": lambda h: h.follower_acceleration,
    "gap": lambda h: h.gap,
    "relative_speed": lambda h: h.leader_speed - h.follower_speed,
    "time_headway": lambda h: h.gap / h.follower_speed.clamp(min=_STANDING),
    "inverse_time_to_collision": lambda h: (
        (h.follower_speed - h.leader_speed) / h.gap.clamp(min=_STANDING)
    ),
}
"""Signals that a policy may see, each `(*batch, length)`."""

INPUT_SETS: dict[str, tuple[str, ...]] = {
    "situation": (
        "leader_speed",
        "relative_speed",
        "gap",
        "time_headway",
        "follower_acceleration",
        "leader_acceleration",
    ),
}
"""Inputs that go by one name: `policy.inputs=situation`."""

_SUMMARIES: dict[Summary, Callable[[Tensor], list[Tensor]]] = {
    "frames": lambda x: list(x.unbind(-1)),
    "last": lambda x: [x[..., -1]],
    "mean": lambda x: [x.mean(-1)],
    "mean_std": lambda x: [x.mean(-1), x.std(-1, correction=0)],
}


def of_set(
    value: object, sets: Mapping[str, tuple[str, ...]], known: Collection[str], what: str
) -> object:
    """Returns the names that a set's name stands for, and whatever else was given as it is.

    Raises:
        ValueError: it is a name, but not of a set.
    """
    if not isinstance(value, str):
        return value
    if value not in sets:
        hint = f" Write [{value}]." if value in known else nearest(value, [*sets, *known])
        raise ValueError(
            f"not a set of {what}s.{hint} Give {', '.join(sets)}, or a list of {', '.join(known)}"
        )
    return sets[value]


def check_names(names: Sequence[str], known: Collection[str], what: str) -> None:
    """Checks names that a policy's settings give.

    Args:
        names: what was given.
        known: what there is.
        what: one of them in words, such as `input`.

    Raises:
        ConfigError: a name is unknown or stands twice.
    """
    setting = f"policy.{what.replace(' ', '_')}s"
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{setting}: unknown {what} '{name}'.{nearest(name, known)}"
                f" Known: {', '.join(known)}."
            )
    if len(set(names)) != len(names):
        article = "an" if what[0] in "aeiou" else "a"
        raise ConfigError(f"{setting}: {article} {what} stands twice in {', '.join(names)}")


def named_inputs(value: object) -> object:
    """As `of_set`, for inputs."""
    return of_set(value, INPUT_SETS, INPUTS, "input")


def check_inputs(names: Sequence[str]) -> None:
    """As `check_names`, for inputs, of which there must be one."""
    if not names:
        raise ConfigError(f"policy.inputs: give at least one of {', '.join(INPUTS)}")
    check_names(names, INPUTS, "input")


def token_width(names: tuple[str, ...], summary: Summary, length: int) -> int:
    """Returns f."""
    return len(names) * {"frames": length, "last": 1, "mean": 1, "mean_std": 2}[summary]


def tokens(history: History, names: tuple[str, ...], summary: Summary) -> Tensor:
    """Returns tokens `(*batch, f)`."""
    return torch.stack(
        [value for name in names for value in _SUMMARIES[summary](INPUTS[name](history))], dim=-1
    )


def measured_history(batch: PairBatch, pair: Tensor, frame: Tensor, length: int) -> History:
    """Returns the last measured frames up to a frame; a pair's first frame stands for those before it.

    Args:
        batch: P pairs.
        pair: which of them, `(*shape)`.
        frame: `(*shape)`, or what broadcasts with it.
        length: how many frames.

    Returns:
        Signals of `(*shape, length)`.
    """
    past = torch.arange(1 - length, 1, device=frame.device)
    index = (frame[..., None] + past).clamp(min=0)
    rows = pair[..., None]
    return History(
        batch.leader_speed[rows, index],
        batch.leader_acceleration[rows, index],
        batch.follower_speed[rows, index],
        batch.follower_acceleration[rows, index],
        batch.gap[rows, index],
    )
