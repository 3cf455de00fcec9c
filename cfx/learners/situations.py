"""The situations that networks learn from, for the valid range of an agent.

Shapes: P pairs, N networks, S situations, f signals of a situation.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from cfx.learners.base import TrainingData
from cfx.policies.features import History, measured_history
from cfx.policies.valid_range import ValidRange, stacked

_PAIRS_AT_MOST = 4096
"""Pairs of a network whose situations are measured: of more, as many at equal distances. A range
and its quantiles need no more than the hundred thousands of situations that these have."""

Augment = Callable[[History, Tensor], History]
"""Takes the situations of pairs `(P,)`, `(P, W)` each, and returns others of the same shape."""


def learned_range(training_data: TrainingData, augment: Augment | None = None) -> ValidRange:
    """Measures the situations at the windows of each network's training parts.

    Args:
        training_data: what the networks learn from.
        augment: what training made of situations besides; None: nothing.
    """
    device = training_data.device
    last = training_data.pairs.split.frame.to(device)
    windows = torch.arange(0, int(last.max()) + 1, training_data.windows.stride, device=device)
    networks = training_data.pairs.network.to(device)
    rows = _some_of_each(networks, len(training_data.names))
    pair = training_data.pairs.index.to(device)[rows]
    history = measured_history(training_data.recorded, pair[:, None], windows, 1)
    recorded = History(*(signal[..., 0] for signal in history))
    counted = windows <= last[rows, None]
    versions = [_situations(recorded)]
    if augment is not None:
        versions.append(_situations(augment(recorded, rows)))
    found = []
    for number in range(len(training_data.names)):
        own = networks[rows] == number
        of_network = []
        for situations in versions:
            of_network.append(situations[own][counted[own]])
        found.append(torch.cat(of_network))
    return ValidRange.of(found)


def _some_of_each(network: Tensor, networks: int) -> Tensor:
    """Returns rows of each network, all or `_PAIRS_AT_MOST` of them, in order, `(S,)`."""
    chosen = []
    for number in range(networks):
        own = (network == number).nonzero()[:, 0]
        if len(own) > _PAIRS_AT_MOST:
            at = torch.arange(_PAIRS_AT_MOST, device=own.device) * len(own) // _PAIRS_AT_MOST
            own = own[at]
        chosen.append(own)
    return torch.cat(chosen).sort().values


def _situations(history: History) -> Tensor:
    """Returns situations `(P, W, f)` of signals `(P, W)` each."""
    return stacked(
        history.follower_speed,
        history.follower_acceleration,
        history.leader_acceleration,
        history.leader_speed,
        history.gap,
    )
