"""The drivers whom a policy learned from, as the population of a fleet.

A fleet of one average driver has no close and no cautious followers. A policy that is conditioned
on driver features (`policy.driver_features`) can drive like each of the drivers it learned from:
their features are saved with it, and each vehicle of a fleet draws one of them.

Shapes: E recorded drivers, k driver features, D vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.policies.driver_features import measure


class DriverPopulation(NamedTuple):
    """Recorded drivers, of whom each vehicle of a fleet draws one.

    Attributes:
        features: that the policy reads, `(E, k)`.
        weight: how likely each is, `(E,)`; they add up to 1.
    """

    features: Tensor
    weight: Tensor

    @classmethod
    def of(
        cls, batch: PairBatch, names: Sequence[str], drivers: Sequence[str]
    ) -> DriverPopulation | None:
        """Measures drivers on their whole recordings; None where nobody is known.

        Args:
            batch: P pairs.
            names: the features.
            drivers: whose pair each is; all pairs of a driver together count once.
        """
        if not names:
            return None
        begin = torch.zeros_like(batch.lengths)
        features = measure(batch, names, batch.dt, begin, batch.lengths).double().cpu()
        rows = features.isfinite().all(1).nonzero().flatten()
        if not len(rows):
            return None
        drivers_of_rows = [drivers[row] for row in rows.tolist()]
        number_of = {name: number for number, name in enumerate(dict.fromkeys(drivers_of_rows))}
        number = torch.tensor([number_of[name] for name in drivers_of_rows])
        weight = 1.0 / torch.bincount(number)[number].double()
        return cls(features[rows], weight / weight.sum())

    def drawn(self, uniform: Tensor) -> Tensor:
        """Returns the features of drivers whom uniform numbers from 0 to 1 stand for.

        Args:
            uniform: `(D,)`.

        Returns:
            `(D, k)`.
        """
        upto = self.weight.cumsum(0)
        rows = torch.searchsorted(upto, uniform.to(upto) * upto[-1], right=True)
        return self.features[rows.clamp(max=len(upto) - 1)]
