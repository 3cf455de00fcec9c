"""Histories of tests."""

from __future__ import annotations

from torch import Tensor

from cfx.data.signals import OBSERVED
from cfx.policies.history import History


def observed(*signals: Tensor) -> History:
    """Returns a history of the signals of every recording, in the order of `OBSERVED`."""
    return dict(zip(OBSERVED, signals, strict=True))
