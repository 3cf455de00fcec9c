"""Inputs of policies: recent states of leader and follower, one token per window; normalisation.

The token of a window holds the last `length` frames up to and including the window's first, so it
never looks ahead. Shapes: f features of a token, N networks, B drivers of each, W windows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from cfx.data.pairs import PairBatch
from cfx.errors import nearest

Summary = Literal["frames", "last", "mean", "mean_std"]
"""What networks read of the frames of a window: all, the last, the mean, or mean and deviation."""


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
        return cls(
            batch.leader_speed,
            batch.leader_acceleration,
            batch.follower_speed,
            batch.follower_acceleration,
            batch.gap,
        )

    def double(self) -> History:
        """Returns the same signals in double precision."""
        return History(*(signal.double() for signal in self))


_STANDING = 1.0
"""Speed in m/s below which time headway and inverse time to collision are taken at this speed: they
have poles at 0."""

_FRAME_S = 0.1
"""Time between frames for which jerk is in m/s3; a network's scaler takes out what differs."""


def _jerk(acceleration: Tensor) -> Tensor:
    """Returns jerks `(*batch, length)` at 0.1 s; the first stands twice, and is 0 where alone."""
    if acceleration.shape[-1] == 1:
        return torch.zeros_like(acceleration)
    difference = acceleration.diff(dim=-1)
    return torch.cat([difference[..., :1], difference], -1) / _FRAME_S


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
    "follower_jerk": lambda h: _jerk(h.follower_acceleration),
    "leader_jerk": lambda h: _jerk(h.leader_acceleration),
}
"""Signals that a policy may see, each `(*batch, length)`, in SI units. The gap is bumper to bumper;
the relative speed is positive where it grows, the inverse time to collision where it shrinks."""

SITUATION = (
    "leader_speed",
    "relative_speed",
    "gap",
    "time_headway",
    "follower_acceleration",
    "leader_acceleration",
)
"""The inputs with which closed-loop training works best."""

MOTION = (*SITUATION, "follower_jerk", "leader_jerk")
"""The situation and the jerks: for policies of smooth models that start from the driver's
acceleration. The follower's jerk misleads where a model's acceleration jumps, as Krauss's does."""

SPEEDS = ("leader_speed", "follower_speed")
"""The paper's inputs."""

INPUT_SETS: dict[str, tuple[str, ...]] = {
    "situation": SITUATION,
    "motion": MOTION,
    "speeds": SPEEDS,
}
"""Inputs that go by one name: `policy.inputs=situation`."""


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
    sets: Mapping[str, tuple[str, ...]], known: Collection[str], what: str
) -> Callable[[object], object]:
    """Returns the check of a setting that is the name of a set, or a list of names and sets.

    The check returns names, a set's in its place. It raises ValueError for a name that is unknown
    or stands twice, and for no name where there is no set `none`.

    Args:
        sets: names that stand for several.
        known: what there is.
        what: one of them in words, such as `input`.
    """

    def check(value: object) -> object:
        if isinstance(value, str):
            if value not in sets:
                hint = nearest(value, [*sets, *known])
                if value in known:
                    hint = f" Write [{value}]."
                raise ValueError(
                    f"not a set of {what}s.{hint} Give {', '.join(sets)}, or a list of"
                    f" {', '.join(known)}"
                )
            return sets[value]
        if not isinstance(value, list | tuple) or not all(isinstance(one, str) for one in value):
            return value
        names: list[str] = []
        for one in value:
            names.extend(sets.get(one, (one,)))
        for name in names:
            if name not in known:
                hint = nearest(name, known)
                raise ValueError(f"unknown {what} '{name}'.{hint} Known: {', '.join(known)}")
        if len(set(names)) != len(names):
            raise ValueError(f"one {what} stands twice in {', '.join(names)}")
        if not names and "none" not in sets:
            raise ValueError(f"give at least one of {', '.join(known)}")
        return tuple(names)

    return check


def token_width(names: tuple[str, ...], summary: Summary, length: int) -> int:
    """Returns f where a token holds `length` frames."""
    if summary == "frames":
        return len(names) * length
    if summary == "mean_std":
        return len(names) * 2
    return len(names)


def tokens(history: History, names: tuple[str, ...], summary: Summary) -> Tensor:
    """Returns tokens `(*batch, f)` of recent frames `(*batch, length)`."""
    features = []
    for name in names:
        features += _summarised(INPUTS[name](history), summary)
    return torch.stack(features, dim=-1)


def measured_history(batch: PairBatch, pair: Tensor, frame: Tensor, length: int) -> History:
    """Returns the last measured frames up to a frame; the first stands for those before it.

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
