"""Fans of trajectories: what a driver's posterior says of what they did, and did afterwards.

On the part that was calibrated on a fan is of predictions without noise: one closed loop, or from
step to step, as the kind of noise has it. After it each draw drives on without what was measured,
and its noise goes on from the last error and enters where it enters: the fan is a forecast.

Whether forecasts hold what happened as often as they say is the check of a posterior (posterior
predictive check on a part that was held out; A. Gelman, X.-L. Meng and H. Stern 1996, *Posterior
predictive assessment of model fitness via realized discrepancies*, Statistica Sinica 6). Errors
last, so that a fan that is right may miss most of one driver's part: what is missed is compared
with what the fan misses of its own paths.

Shapes: P drivers, q draws, d coordinates, K steps of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.plugin import threads
from cfx_posteriors import noise
from cfx_posteriors.density import Posterior


class Fan(NamedTuple):
    """Paths of a signal of P drivers, and their quantiles.

    Attributes:
        signal: `speed` (m/s) or `gap` (m).
        time: of each step since the recording's start, `(K,)`, s.
        counted: which steps were recorded, bool `(P, K)`.
        calibrated: which of them were calibrated on, bool `(P, K)`.
        measured: `(P, K)`.
        quantiles: low, median and high, `(P, K, 3)`.
        paths: as measured, noise included, `(P, K, q)`.
    """

    signal: str
    time: Tensor
    counted: Tensor
    calibrated: Tensor
    measured: Tensor
    quantiles: Tensor
    paths: Tensor

    def check(self, seed: int) -> dict[str, Tensor]:
        """Returns how much of the held-out parts is within the fan, and by what chance.

        Args:
            seed: of ties, which are broken at random.

        Returns:
            `held`, the share of each driver's held-out steps that the fan holds, and `held_chance`,
            how likely it is for the fan's own paths to be held as little, `(P,)` each. NaN where no
            part was held out.
        """
        after = self.counted & ~self.calibrated
        count = after.sum(1)
        low, _, high = self.quantiles.unbind(-1)

        def within(paths: Tensor) -> Tensor:
            is_in = (paths >= low[..., None]) & (paths <= high[..., None])
            return (is_in & after[..., None]).sum(1) / count[:, None]

        held = within(self.measured[..., None])[:, 0]
        shares = within(self.paths)
        as_little = (shares < held[:, None]).double().mean(1)
        the_same = (shares == held[:, None]).double().mean(1)
        generator = torch.Generator().manual_seed(seed)
        part = torch.rand(len(held), generator=generator, dtype=torch.float64)
        chance = torch.where(count > 0, as_little + part * the_same, torch.nan)
        return {"held": held, "held_chance": chance}

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
    with threads.one_thread():  # a path is many small steps
        for drivers in torch.split(torch.arange(len(draws)), size):
            parts.append(_paths(whole.take(drivers), calibrated[drivers], draws[drivers], seed))
    paths = torch.cat(parts)
    return Fan(
        whole.signal,
        count * stride * whole.segments.stepper.dt,
        whole.counted[..., 0].T > 0,
        calibrated,
        measured,
        paths.quantile(shares, dim=2).movedim(0, 2),
        paths,
    )


def _paths(part: Posterior, calibrated: Tensor, draws: Tensor, seed: int) -> Tensor:
    """Returns paths of the signal, `(P, K, q)`.

    Args:
        part: of P drivers, whole recordings.
        calibrated: the steps that were calibrated on, bool `(P, K)`.
        draws: `(P, q, d)`.
        seed: of the noise. All drivers have the same random numbers: none depends on who is worked
            on beside them.
    """
    noise_values = draws[..., part.simulated :]
    coefficients, scale = noise.coefficients(noise_values[..., :-1]), noise_values[..., -1].exp()
    generator = torch.Generator().manual_seed(seed)
    predictor = part.predictor(draws)
    errors: list[Tensor] = []
    paths = []
    for step in range(calibrated.shape[1]):
        predicted, measured = predictor.advance()
        drawn = torch.randn(scale.shape[1], generator=generator, dtype=torch.float64)
        expected = scale * drawn
        for back in range(min(step, part.order)):
            expected = expected + coefficients[..., back] * errors[step - 1 - back]
        is_calibrated = calibrated[:, step, None]
        error = torch.where(is_calibrated, predicted - measured, expected)
        predictor.correct(error, is_calibrated)
        errors.append(error)
        # Errors are predicted minus measured: what is measured is predicted minus noise.
        paths.append(torch.where(is_calibrated, predicted, predicted - error))
    return torch.stack(paths, dim=1)
