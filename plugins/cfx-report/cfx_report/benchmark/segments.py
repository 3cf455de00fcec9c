"""What a task asks: stretches of recordings, each up to a last measured frame and beyond it.

Every task is one batch of stretches. What a follower does after the last measured frame is blanked,
so that nobody can drive by it.

Shapes: Q stretches, T frames. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.plugin import Pair, PairBatch, PairSet
from cfx_report.benchmark.suite import Suite, Task


@dataclass(frozen=True)
class Segments:
    """Q stretches of pairs.

    Attributes:
        pairs: the stretches; their ids are their own.
        pair_ids: of the pair that each is cut from.
        begin: frame of that pair at which each begins, `(Q,)`.
        first: the last measured frame, counted from there, `(Q,)`.
    """

    pairs: PairSet
    pair_ids: tuple[str, ...]
    begin: Tensor
    first: Tensor

    def __len__(self) -> int:
        return len(self.pair_ids)

    @property
    def past(self) -> PairSet:
        """Each stretch up to its last measured frame."""
        parts = []
        for pair, frame in zip(self.pairs, self.first.tolist(), strict=True):
            parts.append(pair.beginning(frame + 1))
        return replace(self.pairs, pairs=tuple(parts))

    def batch(self) -> PairBatch:
        """Returns the stretches with everything, to be compared with."""
        return PairBatch.of(self.pairs)

    def blanked(self) -> PairBatch:
        """Returns the stretches without what their followers do after the last measured frame."""
        batch = self.batch()
        frames = torch.arange(batch.mask.shape[1])
        is_later = frames > self.first[:, None]
        blank = {}
        for name in ("follower_position", "follower_speed", "follower_acceleration"):
            blank[name] = getattr(batch, name).masked_fill(is_later, torch.nan)
        return replace(batch, **blank)


def segments_of(suite: Suite, task: Task, pairs: Sequence[Pair]) -> Segments:
    """Returns the stretches of a task.

    Args:
        suite: says how long they are.
        task: which.
        pairs: that are tested.
    """
    if task.kind == "forecast":
        return moments(pairs, suite.past_s, suite.every_s, max(suite.horizons))
    first = []
    for pair in pairs:
        is_whole = task.kind == "full"
        first.append(0 if is_whole else round((1.0 - suite.last_part) * len(pair)) - 1)
    return whole(pairs, first)


def whole(pairs: Sequence[Pair], first: Sequence[int]) -> Segments:
    """Returns whole pairs, driven from these frames on."""
    ids = tuple([pair.pair_id for pair in pairs])
    source = PairSet(tuple(pairs), "pairs")
    return Segments(source, ids, torch.zeros(len(ids), dtype=torch.int64), torch.tensor(first))


def moments(pairs: Sequence[Pair], past_s: float, every_s: float, ahead_s: float) -> Segments:
    """Returns the seconds around moments of each pair.

    Args:
        pairs: a pair that is shorter than past and future has none.
        past_s: before each moment.
        every_s: between moments, the first of which is after `past_s`.
        ahead_s: after each moment.
    """
    cut, ids, begins, first = [], [], [], []
    for pair in pairs:
        past, every = round(past_s / pair.dt), max(1, round(every_s / pair.dt))
        ahead = round(ahead_s / pair.dt)
        for moment in range(past, len(pair) - ahead, every):
            cut.append(stretch(pair, moment - past, moment + ahead + 1))
            ids.append(pair.pair_id)
            begins.append(moment - past)
            first.append(past)
    return Segments(
        PairSet(tuple(cut), "moments"), tuple(ids), torch.tensor(begins), torch.tensor(first)
    )


def stretch(pair: Pair, begin: int, end: int) -> Pair:
    """Returns some frames of a pair under a name of its own."""
    part = pair.with_arrays(lambda values: values[begin:end])
    return replace(part, pair_id=f"{pair.pair_id}@{begin}", first_frame=pair.first_frame + begin)
