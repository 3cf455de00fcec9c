"""Chains of draws that depend on the one before, and how far to trust them.

A. Vehtari, A. Gelman, D. Simpson, B. Carpenter and P.-C. Bürkner (2021), *Rank-normalization,
folding, and localization: an improved R-hat*, Bayesian Analysis 16(2).

Shapes: P drivers, C chains, n tuned parameters, d coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from arviz_stats.base.array import array_stats
from numpy.typing import NDArray
from torch import Tensor


class Chains(NamedTuple):
    """Chains of P drivers.

    Attributes:
        quantiles: of each parameter's logit, `(P, shares, n)`.
        draws: of all coordinates, a chain after the other, `(P, C * draws of each, d)`.
        effective: effective sample size (ArviZ; in the middle and in the tails), of the coordinate
            with the least, `(P,)`.
        diagnostics: what says how far to trust them, `(P,)` each: `r_hat` of the coordinate with
            the largest, and what the sampler knows.
        chains: C.
    """

    quantiles: Tensor
    draws: Tensor
    effective: Tensor
    diagnostics: dict[str, Tensor]
    chains: int


def chains_of(places: Tensor, n: int, shares: Tensor) -> Chains:
    """Returns what draws of chains say.

    Args:
        places: `(P, C, draws, d)`.
        n: tuned parameters, which come first.
        shares: of the quantiles, within (0, 1).
    """
    r_hat = array_stats.rhat(places.numpy(), chain_axis=1, draw_axis=2).max(-1)
    draws = places.flatten(1, 2)
    return Chains(
        draws[..., :n].quantile(shares, dim=1).transpose(0, 1),
        draws,
        torch.from_numpy(effective_samples(places.numpy())),
        {"r_hat": torch.from_numpy(r_hat)},
        places.shape[1],
    )


def effective_samples(chains: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the effective sample size of the coordinate with the least, `(P,)`.

    Args:
        chains: `(P, C, draws, d)`.
    """
    bulk = array_stats.ess(chains, chain_axis=1, draw_axis=2)
    tails = array_stats.ess(chains, chain_axis=1, draw_axis=2, method="tail", prob=(0.05, 0.95))
    least: NDArray[np.float64] = np.minimum(bulk, tails).min(-1)
    return least
