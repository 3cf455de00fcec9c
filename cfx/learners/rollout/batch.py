"""The trajectories of one gradient step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class RolloutBatch(NamedTuple):
    """Trajectories to simulate, D for each of N networks.

    Attributes:
        place: which of the network's drivers, `(N, D)`.
        start: window at whose beginning the policy takes over, `(N, D)`.
        cold_start: whether nothing was observed before and the pooled parameters are the base, as
            for an unseen driver; bool `(N, D)`.
        last: the last frame that counts, `(N, D)`.
        weight: `(N, D)`; 0 leaves a trajectory out.
        scale: factor on all distances, speeds and accelerations, `(N, D)`; None: 1. It makes a
            recording of another driver on another road.
        shift: m/s added to the speeds of both vehicles, `(N, D)`; None: nothing. It makes a
            recording of a faster road.
        wider: m by which the gap is wider for that, `(N, D)`; given where `shift` is.
    """

    place: Tensor
    start: Tensor
    cold_start: Tensor
    last: Tensor
    weight: Tensor
    scale: Tensor | None = None
    shift: Tensor | None = None
    wider: Tensor | None = None

    @property
    def row(self) -> Tensor:
        """The network of each trajectory, `(N, 1)`: the first index of tables `(N, B, ...)`."""
        return torch.arange(len(self.place), device=self.place.device)[:, None]

    def repeated(self, times: int) -> RolloutBatch:
        """Returns the trajectories `times` times, all of them behind one another."""

        def copies(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return values.repeat(1, times)

        return RolloutBatch(
            place=self.place.repeat(1, times),
            start=self.start.repeat(1, times),
            cold_start=self.cold_start.repeat(1, times),
            last=self.last.repeat(1, times),
            weight=self.weight.repeat(1, times),
            scale=copies(self.scale),
            shift=copies(self.shift),
            wider=copies(self.wider),
        )

    def without_unweighted(self) -> RolloutBatch:
        """Returns the trajectories that have weight, in order.

        A network that has fewer of them than another is filled up with trajectories without weight.
        """
        has_weight = self.weight > 0
        most = int(has_weight.sum(1).max())
        order = has_weight.long().argsort(dim=1, descending=True, stable=True)
        kept = order[:, :most].sort(1).values

        def chosen(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return values.gather(1, kept)

        return RolloutBatch(
            place=self.place.gather(1, kept),
            start=self.start.gather(1, kept),
            cold_start=self.cold_start.gather(1, kept),
            last=self.last.gather(1, kept),
            weight=self.weight.gather(1, kept),
            scale=chosen(self.scale),
            shift=chosen(self.shift),
            wider=chosen(self.wider),
        )
