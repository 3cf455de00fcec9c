"""Tables of the loss around calibrated parameters (slices), and of their errors (fit).

**Slices.** From a driver's calibrated parameters one is moved from bound to bound, the others stay.
Where the loss hardly rises, these recordings do not determine the parameter. Where it rises, others
might still make up for the move: a full profile, which calibrates the others anew at every place,
is never higher than the slice.

**Fit.** The errors of constant parameters on the part of each trajectory that was calibrated on.

Shapes: P pairs, n tuned parameters, G places.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.calibrator import Calibrator
from cfx.calibration.losses import SegmentLosses
from cfx.calibration.objectives import Objective
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.core import memory
from cfx.data.pairs import PairBatch

__all__ = [
    "FLAT_SHARE_PREFIX",
    "NEARLY_BEST",
    "flat_shares",
]
"""What plugins may use, as `cfx.plugin.identifiability`."""


PLACES = 21
"""G: places between a parameter's bounds, both included."""

_PAIRS_AT_ONCE = 1024
"""Pairs whose segments are cut together."""


def slices(
    calibrator: Calibrator,
    batch: PairBatch,
    last: Tensor,
    parameters: Tensor,
    pair_ids: Sequence[str],
) -> pd.DataFrame:
    """Returns the loss along each parameter's slice.

    Args:
        calibrator: whose model and objective count.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed loop.
        parameters: `(P, n)`, the calibrated ones, SI units.
        pair_ids: of the pairs.

    Returns:
        Columns: pair_id, parameter, place (0 at the lower bound, 1 at the upper, in the space that
        is calibrated in), value (SI units), loss, best_loss (with the calibrated parameters), both
        in the objective's unit and without the prior.
    """
    space = calibrator.space
    best = space.to_unit(parameters)
    pairs, count = best.shape
    places = torch.linspace(0, 1, PLACES, dtype=best.dtype, device=best.device)
    moved = best[:, None, None].repeat(1, count, PLACES, 1)
    for column in range(count):
        moved[:, column, :, column] = places
    candidates = torch.cat([best[:, None], moved.reshape(pairs, count * PLACES, count)], dim=1)
    losses = losses_of(calibrator, calibrator.solver.objective, batch, last, candidates)
    values = torch.diagonal(space.from_unit(moved), dim1=1, dim2=3)  # (P, G, n)
    per_pair = count * PLACES
    return pd.DataFrame(
        {
            "pair_id": pd.Series(list(pair_ids)).repeat(per_pair).to_numpy(),
            "parameter": pd.Series(list(space.names)).repeat(PLACES).tolist() * pairs,
            "place": places.cpu().tolist() * count * pairs,
            "value": values.transpose(1, 2).reshape(-1).cpu().numpy(),
            "loss": losses[:, 1:].reshape(-1).cpu().numpy(),
            "best_loss": losses[:, :1].repeat(1, per_pair).reshape(-1).cpu().numpy(),
        }
    )


def training_errors(
    calibrator: Calibrator, batch: PairBatch, last: Tensor, parameters: Tensor
) -> dict[str, Tensor]:
    """Returns `rmse_speed` (m/s) and `rmse_gap` (m) up to a last frame, `(P,)` each.

    Args:
        calibrator: whose model counts.
        batch: P pairs.
        last: `(P,)`, the last frame that is compared.
        parameters: `(P, n)`, SI units.
    """
    unit = calibrator.space.to_unit(parameters)[:, None]
    objectives: dict[str, Objective] = {"rmse_speed": SpeedRmse(), "rmse_gap": GapRmse()}
    errors = {}
    for name, objective in objectives.items():
        errors[name] = losses_of(calibrator, objective, batch, last, unit)[:, 0]
    return errors


@torch.no_grad()
def losses_of(
    calibrator: Calibrator, objective: Objective, batch: PairBatch, last: Tensor, candidates: Tensor
) -> Tensor:
    """Returns losses `(P, q)` of candidates `(P, q, n)` in unit space, in shards of pairs."""
    losses, solver = [], calibrator.solver
    for pairs in torch.split(torch.arange(len(batch), device=candidates.device), _PAIRS_AT_ONCE):
        first, end = torch.zeros_like(pairs), last.to(pairs.device)[pairs]
        segments = SegmentLosses.of_segments(solver.stepper, objective, batch, pairs, first, end)
        per_pair = segments.bytes_per_candidate * candidates.shape[1]
        size = max(1, solver.memory // max(1, per_pair))
        for shard in torch.split(torch.arange(len(pairs), device=pairs.device), size):
            losses.append(segments.take(shard)(candidates[pairs[shard]]))
        memory.release()
    return torch.cat(losses)


NEARLY_BEST = 0.05
"""A loss that is higher than the best by no more than this share of it counts as nearly as good."""

FLAT_SHARE_PREFIX = "flat_"
"""Prefix of the columns of flat shares."""


def flat_shares(slices: pd.DataFrame) -> pd.DataFrame:
    """Returns the flat share of each parameter for each pair, a column per parameter.

    Args:
        slices: as `cfx.calibration.identifiability.slices` returns it. A pair whose best loss is 0
            or no number has none: NaN.
    """
    best = slices["best_loss"].where(np.isfinite(slices["best_loss"]) & (slices["best_loss"] > 0))
    near = (slices["loss"] <= (1 + NEARLY_BEST) * best).astype(float).where(best.notna())
    rows = slices[["pair_id", "parameter"]].assign(near=near)
    wide = rows.pivot_table(index="pair_id", columns="parameter", values="near")
    return wide.reindex(columns=slices["parameter"].unique())


def with_flat_shares(
    about: pd.DataFrame, slices: pd.DataFrame, names: Sequence[str]
) -> pd.DataFrame:
    """Returns a table of pairs and methods with a column `flat_NAME` for each parameter.

    It holds the flat shares of the method `driver_specific`, whose parameters they are of; else
    NaN.
    """
    shares = flat_shares(slices)
    columns = {}
    for name in names:
        values = about["pair_id"].map(shares[name])
        columns[f"{FLAT_SHARE_PREFIX}{name}"] = values.where(about["method"] == "driver_specific")
    return about.assign(**columns)


def flat_for(table: pd.DataFrame, names: Sequence[str]) -> dict[str, float]:
    """Returns for which share of the pairs each parameter is flat; without those of no share.

    Args:
        table: a row per pair and method, with columns as of `with_flat_shares` if they are known.
        names: of the parameters.
    """
    flat = {}
    for name in names:
        if f"{FLAT_SHARE_PREFIX}{name}" in table:
            shares = table[f"{FLAT_SHARE_PREFIX}{name}"].dropna()
            if len(shares):
                flat[name] = float((shares == 1).mean())
    return flat
