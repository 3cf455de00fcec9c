"""A weak prior on calibrated parameters, for those that a recording does not determine.

Congested traffic says nothing of the speed that drivers want on a free road: any value beyond what
they reached fits as well, and a search returns whichever it met. With a prior such a parameter
stays near the model's default, and a parameter that the recording determines is hardly moved.

Shapes: P problems, q candidates of each, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.core.parameters import squashed

_WEIGHTS = {"weak": 0.01, "none": 0.0}
"""Weights of the priors. With the weak one, a parameter that is one unit of the squashed space away
from its default costs 1 % of the default's loss over n; 13 instead of 33 m/s, of 1 to 70, is 1.4
units away."""


def prior_weight(name: str) -> float:
    """Returns the weight of a prior that `calibration.prior` names."""
    return _WEIGHTS[name]


@dataclass(frozen=True)
class Prior:
    """A penalty on the distance from a center in the squashed space, such as the model's default.

        loss + weight * (loss of the center) * mean((logit u - logit u_center)^2)

    It is the logarithm of a normal prior on each logit, up to constants; the center's loss gives
    it the objective's unit and makes it as strong for every driver.

    Attributes:
        center: what is likeliest, in the squashed space, `(n,)` or `(P, 1, n)`.
        weight: without unit.
        scale: the loss there in each problem, `(P, 1)`, in the objective's unit.
    """

    center: Tensor
    weight: float
    scale: Tensor

    @classmethod
    def of(
        cls, losses: Callable[[Tensor], Tensor], unit: Tensor, center: Tensor, weight: float
    ) -> Prior:
        """Returns the prior of P problems.

        Args:
            losses: of candidates `(P, q, n)`, without a prior.
            unit: what is likeliest, in unit space, `(P, 1, n)`.
            center: the same in the squashed space, `(n,)` or `(P, 1, n)`.
            weight: without unit.
        """
        return cls(center, weight, losses(unit).nan_to_num(nan=0.0, posinf=0.0))

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs."""
        return 4 * torch.float64.itemsize * self.center.shape[-1]

    def cut(self, which: slice | Tensor) -> Prior:
        """Returns the prior of some of the problems."""
        center = self.center if self.center.dim() == 1 else self.center[which]
        return replace(self, center=center, scale=self.scale[which])

    def penalty(self, candidates: Tensor) -> Tensor:
        """Returns what is added to the losses of candidates `(P, q, n)`, `(P, q)`."""
        if candidates.stride(0) == 0:  # shared by all problems: an expanded view
            candidates = candidates[:1]
        away = squashed(candidates) - self.center.to(candidates)
        return self.weight * self.scale * away.square().mean(-1)
