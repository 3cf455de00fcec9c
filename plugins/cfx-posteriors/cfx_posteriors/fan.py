"""Fans of trajectories: what a driver's posterior says of what they did, and did afterwards.

On the part that was calibrated on a fan is of simulated trajectories alone. After it the noise goes
on from its last error: the fan is a forecast, and should hold what happened as often as it says.

Shapes: P drivers, q draws, d coordinates, K steps of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx_posteriors import noise
from cfx_posteriors.density import Posterior


class Fan(NamedTuple):
    """Quantiles of a signal of P drivers.

    Attributes:
        signal: `speed` (m/s) or `gap` (m).
        time: of each step since the recording's start, `(K,)`, s.
        counted: which steps were recorded, bool `(P, K)`.
        calibrated: which of them were calibrated on, bool `(P, K)`.
        measured: `(P, K)`.
        quantiles: low, median and high, `(P, K, 3)`.
    """

    signal: str
    time: Tensor
    counted: Tensor
    calibrated: Tensor
    measured: Tensor
    quantiles: Tensor

    def table(self, ids: Sequence[str]) -> pd.DataFrame:
        """Returns the table `fan`, a row for each pair and recorded step.

        Args:
            ids: of the pairs.
        """
        pair, step = self.counted.nonzero(as_tuple=True)
        columns = {
            "pair_id": np.asarray(ids, dtype=object)[pair.numpy()],
            "time_s": self.time[step].numpy(),
            "calibrated_on": self.calibrated[pair, step].numpy(),
            "signal": self.signal,
            "measured": self.measured[pair, step].numpy(),
        }
        for number, kind in enumerate(("low", "median", "high")):
            columns[kind] = self.quantiles[pair, step, number].numpy()
        return pd.DataFrame(columns)


def fan_of(
    whole: Posterior, frame: Tensor, draws: Tensor, shares: Tensor, *, seed: int, memory: int
) -> Fan:
    """Returns the fan of each driver.

    Args:
        whole: of whole recordings.
        frame: the last one that was calibrated on, `(P,)` int64.
        draws: from the posteriors on these parts, `(P, q, d)`.
        shares: of the quantiles, within (0, 1).
        seed: of the noise.
        memory: bound in bytes for the drivers that are worked on at once.
    """
    segments, stride = whole.segments.segments, whole.stride
    measured = segments.measured_gap if whole.signal == "gap" else segments.measured_speed
    measured = measured[stride - 1 :: stride].T
    count = torch.arange(1, measured.shape[1] + 1)
    calibrated = count * stride <= frame[:, None]
    size = max(1, memory // (4 * draws.shape[1] * whole.bytes_per_candidate))
    parts = []
    for drivers in torch.split(torch.arange(len(draws)), size):
        away = _away(whole.take(drivers), calibrated[drivers], draws[drivers], seed)
        parts.append(measured[drivers][..., None] + away.quantile(shares, dim=2).movedim(0, 2))
    return Fan(
        whole.signal,
        count * stride * whole.segments.stepper.dt,
        whole.counted[..., 0].T > 0,
        calibrated,
        measured,
        torch.cat(parts),
    )


def _away(part: Posterior, calibrated: Tensor, draws: Tensor, seed: int) -> Tensor:
    """Returns how far paths are from what was measured, `(P, K, q)`."""
    n = len(part.space)
    errors = part.errors(draws[..., :n]).transpose(0, 1)
    coefficients, scale = noise.coefficients(draws[..., n:-1]), draws[..., -1].exp()
    generator = torch.Generator().manual_seed(seed)
    gone_on = errors.clone()
    for step in range(errors.shape[1]):
        # All drivers have the same random numbers: none depends on who is worked on beside them.
        drawn = torch.randn(scale.shape[1], generator=generator, dtype=torch.float64)
        expected = scale * drawn
        for back in range(min(step, coefficients.shape[-1])):
            expected = expected + coefficients[..., back] * gone_on[:, step - 1 - back]
        known = calibrated[:, step, None]
        gone_on[:, step] = torch.where(known, errors[:, step], expected)
    # Errors are simulated minus measured: what is measured is simulated minus noise.
    return torch.where(calibrated[..., None], errors, errors - gone_on)
