"""A weak prior on calibrated parameters, for those that a recording does not determine.

Congested traffic says nothing of the speed that drivers want on a free road: any value beyond what
they reached fits as well, and a search returns whichever it met. With a prior such a parameter
stays near the model's default, and a parameter that the recording determines is hardly moved.

Shapes: P problems, q candidates of each, n tuned parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.calibration.losses import PooledLosses, SegmentLosses

_WEIGHTS = {"weak": 0.01, "none": 0.0}
"""Weights of the priors. With the weak one, a parameter that is one unit of the squashed space away
from its default costs 1 % of the default's loss over n; 13 instead of 33 m/s, of 1 to 70, is 1.4
units away."""

_EDGE = 0.005
"""How close to a bound, in unit space, a parameter counts as being, so that its logit is finite."""


def prior_weight(name: str) -> float:
    """Returns the weight of a prior that `calibration.prior` names."""
    return _WEIGHTS[name]


@dataclass(frozen=True)
class LossesWithPrior:
    """Losses plus a penalty on the distance from the model's default in the squashed space.

        loss + weight * (loss of the default) * mean((logit u - logit u_default)^2)

    It is the logarithm of a normal prior on each logit, up to constants; the default's loss gives
    it the objective's unit and makes it as strong for every driver.

    Attributes:
        losses: what the recording says.
        default: the model's default in unit space, `(n,)`.
        weight: without unit.
        scale: the loss of the default in each problem, `(P, 1)`, in the objective's unit.
    """

    losses: SegmentLosses | PooledLosses
    default: Tensor
    weight: float
    scale: Tensor

    @classmethod
    def of(
        cls, losses: SegmentLosses | PooledLosses, default: Tensor, weight: float
    ) -> LossesWithPrior:
        """Adds the prior to losses; `default` is in unit space, `(n,)`."""
        everywhere = default[None, None, :].expand(losses.problems, 1, -1)
        scale = losses(everywhere).nan_to_num(nan=0.0, posinf=0.0)
        return cls(losses, default, weight, scale)

    @property
    def problems(self) -> int:
        """P."""
        return self.losses.problems

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs."""
        return self.losses.bytes_per_candidate + 4 * self.default.nbytes

    def for_work(self, candidates: int) -> LossesWithPrior:
        """Returns the same losses, for a number of candidates of each problem in all calls."""
        return replace(self, losses=self.losses.for_work(candidates))

    def select(self, first: int, last: int) -> LossesWithPrior:
        """Returns problems `first` to `last - 1`."""
        return replace(self, losses=self.losses.select(first, last), scale=self.scale[first:last])

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(P, q)`, in the objective's unit, of candidates `(P, q, n)`."""
        return self.losses(candidates) + self.weight * self.scale * self.distance(candidates)

    def distance(self, candidates: Tensor) -> Tensor:
        """Returns the mean square distance from the default, `(P, q)` or `(1, q)`."""
        if candidates.stride(0) == 0:  # shared by all problems: an expanded view
            candidates = candidates[:1]
        away = _logit(candidates) - _logit(self.default.to(candidates))
        return away.square().mean(-1)


def _logit(unit: Tensor) -> Tensor:
    return torch.logit(unit.clamp(_EDGE, 1.0 - _EDGE))
