"""Recent frames of a follower and their surroundings, as policies see them.

Shapes: P pairs, T frames of the longest pair, L frames of a token; `*batch` any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.data.signals import OBSERVED

History = Mapping[str, Tensor]
"""Recent frames by the names of signals, oldest first; `(*batch, L)` each, SI units.

It has the signals `cfx.data.signals.OBSERVED`, and further ones that inputs of the policy declare.
"""


def changed(history: History, change: Callable[[Tensor], Tensor]) -> History:
    """Returns a history with each of its signals changed alike."""
    return {name: change(signal) for name, signal in history.items()}


def history_of(batch: PairBatch) -> History:
    """Returns all that was measured of P pairs, `(P, T)` each."""
    history = {name: getattr(batch, name) for name in OBSERVED}
    for signal, stored in batch.surroundings.items():
        history[signal.name] = signal.seen_from(batch.follower_position, stored)
    return history


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
    history = {name: getattr(batch, name)[rows, index] for name in OBSERVED}
    for signal, stored in batch.surroundings.items():
        position = batch.follower_position[rows, index]
        history[signal.name] = signal.seen_from(position, stored[rows, index])
    return history
