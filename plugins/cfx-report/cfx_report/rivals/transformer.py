"""A transformer over lagged states that sets the acceleration, trained by rollout.

The encoder reads the last three seconds, the decoder asks with what is seen now.

Differences from the paper: it answers an acceleration for the next half second, and is trained by
driving; the paper's answers whole trajectories, whose leader is known.

Shapes: P pairs, L lags, w width.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from cfx.plugin import Settings
from cfx_report.benchmark.rival import Seen
from cfx_report.rivals.rollout_training import (
    FEATURES,
    NetworkDriver,
    RolloutRival,
    RolloutSettings,
    acceleration_of,
    features_of,
)

_EVERY = 5
"""Frames between the states that the encoder reads."""


class _EncoderDecoder(nn.Module):
    """One layer of an encoder and one of a decoder, of two heads each."""

    def __init__(self, width: int, states: int) -> None:
        super().__init__()
        self.embed = nn.Linear(FEATURES, width)
        self.place = nn.Parameter(0.1 * torch.randn(states, width))
        self.transformer = nn.Transformer(width, 2, 1, 1, 2 * width, dropout=0.0, batch_first=True)
        self.answer = nn.Linear(width, 1)
        self.double()

    def forward(self, features: Tensor) -> Tensor:
        """Returns an answer for each of P sequences, `(P, L, f)` -> `(P,)`."""
        embedded = self.embed(features)
        decoded: Tensor = self.transformer(embedded + self.place, embedded[:, -1:])
        answer: Tensor = self.answer(decoded[:, 0])
        return answer[:, 0]


class TransformerDriver(NetworkDriver):
    """Drives by an encoder and a decoder over lagged states."""

    lags = 31

    def __init__(self, width: int) -> None:
        self.module = _EncoderDecoder(width, len(range(0, self.lags, _EVERY)))

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        features = features_of(seen)[:, ::_EVERY]
        return acceleration_of(self.module(features)), memory


class TransformerSettings(RolloutSettings):
    """Settings of a transformer: a quarter of the others' steps and seconds, at their cost."""

    steps: int = Field(200, ge=1, description="steps of the optimizer")
    seconds: float = Field(10.0, gt=0.5, description="s that a stretch lasts")


class TransformerRival(RolloutRival):
    """A transformer over the last three seconds."""

    schema: ClassVar[type[Settings]] = TransformerSettings
    settings: TransformerSettings
    reference = "Zhu et al. (2022), TransFollower, arXiv:2202.03183"

    def network(self) -> NetworkDriver:
        return TransformerDriver(2 * (self.settings.hidden_size // 2))
