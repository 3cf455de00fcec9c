"""Valid range of a policy: the situations it learned from, and the distance to others.

A situation is five signals: the follower's speed and acceleration, the leader's acceleration, the
relative speed and the logarithm of the gap. Its score is its Mahalanobis distance from those that
were learned from (P. C. Mahalanobis 1936, On the generalised distance in statistics), over the
distance that all but a few of them keep to: up to 1 it counts as inside. So a speed is judged
together with its gap, which minimum and maximum of each alone would not do.

Outside, an agent's answer fades towards the base parameters and has faded altogether at a score of
`FADED`.

Shapes: N networks, D drivers, S situations, f = 5 signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.data.signals import SIGNALS
from cfx.policies.history import History, changed

__all__ = [
    "FADED",
    "RANGE_SIGNALS",
    "share_in_words",
]
"""What plugins may use, as `cfx.plugin.valid_range`."""


FADED = 2.5
"""Score from which on nothing is left of an agent's answer. Nearer bounds are worse: mixtures of an
answer and the base can be worse than either, and just outside the answers are still good."""

_WORDS = {
    "follower_speed": ("speed", SIGNALS["follower_speed"].unit),
    "follower_acceleration": ("acceleration", SIGNALS["follower_acceleration"].unit),
    "leader_acceleration": ("leader's acceleration", SIGNALS["leader_acceleration"].unit),
    "relative_speed": ("relative speed", SIGNALS["leader_speed"].unit),
    "log_gap": ("gap", SIGNALS["gap"].unit),
}
"""The signals of a situation, what people call them, and the unit in which they are told.

Further signals, such as rain, are not among them: a distance needs a covariance that is known.
"""

RANGE_SIGNALS = tuple(_WORDS)
"""The signals of a situation."""

_INSIDE = 0.995
"""Share of the situations learned from that lie inside."""

_EXTREMES = (0.001, 0.999)
"""Quantiles between which a single signal counts as usual, for naming what is unusual."""

_RECORDED = (0.05, 0.5, 0.95)
"""Quantiles of recordings that are kept, to be set beside live traffic."""

_MOST_PAIRS = 4096
"""Pairs whose recordings these quantiles are measured on."""

_WALKING_MPS = 1.5
"""Speed below which a time gap means nothing."""

_LEAST_VARIANCE = 1e-6
"""Added to variances, so that a signal that never changes does no harm."""


class ValidRange(NamedTuple):
    """The situations that each of N networks learned from.

    Attributes:
        mean: `(N, f)`.
        precision: inverse covariance, `(N, f, f)`.
        distance: Mahalanobis distance that counts as 1, `(N,)`.
        low, high: usual values of each signal alone, `(N, f)`.
    """

    mean: Tensor
    precision: Tensor
    distance: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, situations: Sequence[Tensor]) -> ValidRange:
        """Measures situations `(S, f)` of each network, in double precision."""
        measured = [_measured(learned.double()) for learned in situations]
        return cls(*(torch.stack(column) for column in zip(*measured, strict=True)))

    def of_drivers(self, network: Tensor) -> ValidRange:
        """Returns the range of each of D drivers' network, `(D,)`: N is D then."""
        return ValidRange(*(values[network] for values in self))

    def score(self, situation: Tensor, network: Tensor | None = None) -> Tensor:
        """Returns how far outside situations lie, `(D,)`; up to 1 is inside.

        Args:
            situation: `(D, f)`.
            network: whose range each is compared with, `(D,)`; None: each situation has its own.
        """
        if network is not None:
            return self.of_drivers(network).score(situation)
        away = situation.to(self.mean) - self.mean
        # Products of matrices, no einsum: what translates an exported graph to C knows hardly any,
        # and of three factors opt_einsum, where it is installed, would fix the number of drivers.
        turned = torch.matmul(away.unsqueeze(-2), self.precision).squeeze(-2)
        squared = torch.matmul(turned.unsqueeze(-2), away.unsqueeze(-1)).squeeze(-1).squeeze(-1)
        return squared.clamp(min=0.0).sqrt() / self.distance

    def beyond(self, situation: Tensor, network: Tensor | None = None) -> Tensor:
        """Says which signals alone are unusual, bool `(D, 2 f)`: too low, then too high.

        Arguments as for `score`.
        """
        if network is not None:
            return self.of_drivers(network).beyond(situation)
        value = situation.to(self.mean)
        return torch.cat([value < self.low, value > self.high], -1)

    def joined(self, other: ValidRange) -> ValidRange:
        """Returns one range for what lies in either, by their means and spreads.

        Args:
            other: of one network, which each of these N learned from before.
        """
        mean = (self.mean + other.mean) / 2.0
        apart = ((self.mean - other.mean) / 2.0)[..., None]
        spread = (torch.linalg.inv(self.precision) + torch.linalg.inv(other.precision)) / 2.0
        return ValidRange(
            mean,
            torch.linalg.inv(spread + apart @ apart.mT),
            torch.maximum(self.distance, other.distance),
            torch.minimum(self.low, other.low),
            torch.maximum(self.high, other.high),
        )


def situation_of(history: History) -> Tensor:
    """Returns the situations at the last frame of histories `(*batch, L)`, `(*batch, f)`."""
    return situations(changed(history, lambda signal: signal[..., -1]))


def situations(history: History) -> Tensor:
    """Returns situations `(*batch, f)` of signals `(*batch,)` each, SI units."""
    speed = history["follower_speed"]
    values = {
        "follower_speed": speed,
        "follower_acceleration": history["follower_acceleration"],
        "leader_acceleration": history["leader_acceleration"],
        "relative_speed": history["leader_speed"] - speed,
        "log_gap": (history["gap"].clamp(min=0.0) + 1.0).log(),
    }
    return torch.stack([values[name] for name in RANGE_SIGNALS], -1)


def weight_of_answer(score: Tensor) -> Tensor:
    """Returns how much of an agent's answer is used at these scores, 1 to 0, `(*batch,)`."""
    return ((FADED - score) / (FADED - 1.0)).clamp(0.0, 1.0)


def recorded_quantiles(batch: PairBatch) -> dict[str, tuple[float, ...]]:
    """Returns quantiles of recorded motion: see `TrainedOn.quantiles`.

    Of very many pairs only some are looked at, which are spread evenly over all.
    """
    if len(batch) > _MOST_PAIRS:
        chosen = torch.linspace(0, len(batch) - 1, _MOST_PAIRS).round().long()
        batch = batch[chosen.to(batch.lengths.device)]
    speed = batch.follower_speed[batch.mask]
    moves = speed > _WALKING_MPS
    signals = {
        "speed": speed,
        "acceleration": batch.follower_acceleration[batch.mask],
        "time_gap": batch.gap[batch.mask][moves] / speed[moves],
    }
    quantiles: dict[str, tuple[float, ...]] = {}
    for name, values in signals.items():
        quantiles[name] = ()
        if len(values):
            quantiles[name] = tuple(_quantiles(values, _RECORDED).tolist())
    return quantiles


def share_in_words(valid_range: ValidRange, outside: int, steps: int, beyond: Tensor) -> str:
    """Returns how many steps were outside and why, in words; "" if none was.

    Args:
        valid_range: of one network or more; the first is quoted.
        outside: steps outside.
        steps: all steps.
        beyond: as `in_words` takes it.
    """
    if outside == 0:
        return ""
    share = 100 * outside / steps
    number = f"{share:.1g}"
    if share >= 1:
        number = f"{share:.0f}"
    reason = in_words(valid_range, beyond)
    if reason:
        reason = f" ({reason})"
    return f"{number} % of steps outside what the policy has learned{reason}"


def in_words(valid_range: ValidRange, beyond: Tensor) -> str:
    """Returns what was unusual most often: "speed above 18 m/s"; "" if no signal alone was.

    Args:
        valid_range: of one network or more; the first is quoted.
        beyond: how often each signal alone was too low, then too high, `(2 f,)`.
    """
    if float(beyond.sum()) == 0:
        return ""
    signal = int(beyond.argmax())
    side, bounds = "below", valid_range.low[0]
    if signal >= len(RANGE_SIGNALS):
        side, bounds, signal = "above", valid_range.high[0], signal - len(RANGE_SIGNALS)
    bound = float(bounds[signal])
    if RANGE_SIGNALS[signal] == "log_gap":
        bound = float(torch.expm1(bounds[signal]))
    words, unit = _WORDS[RANGE_SIGNALS[signal]]
    return f"{words} {side} {bound:.3g} {unit}"


def _measured(learned: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    mean = learned.mean(0)
    away = learned - mean
    covariance = away.T @ away / max(1, len(learned) - 1)
    covariance = covariance + _LEAST_VARIANCE * torch.eye(len(mean)).to(covariance)
    precision = torch.linalg.inv(covariance)
    distances = ((away @ precision) * away).sum(-1).clamp(min=0.0).sqrt()
    inside = _quantiles(distances, [_INSIDE])[0].clamp(min=1.0)
    low, high = _quantiles(learned, _EXTREMES)
    return mean, precision, inside, low, high


def _quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """Returns quantiles along the first dimension of any number of values, one by one."""
    places = [round(share * (len(values) - 1)) for share in shares]
    # Nothing is sorted but what stands at these places.
    ordered = np.partition(values.cpu().numpy(), places, axis=0)
    return torch.as_tensor(ordered[places]).to(values.device)
