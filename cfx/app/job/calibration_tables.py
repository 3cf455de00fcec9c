"""What a job's calibration found, beyond its parameters: slices of the loss, and fits."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.identifiability import slices, training_errors
from cfx.calibration.windows import Split
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.evaluation.result import Evaluation
from cfx.simulation.rollout import MemoryStepper

_CONSTANT = ("default", "population", "fixed")


def calibration_tables(context: ProtocolContext, evaluation: Evaluation) -> dict[str, pd.DataFrame]:
    """Returns the tables `slices` and `fits` of a calibration of driver-specific parameters.

    There are none where nothing was calibrated per driver, nor where another program simulates
    (`simulator=sumo`): it would take minutes.

    Returns:
        slices: see `cfx.calibration.identifiability.slices`.
        fits: a row per pair and method: pair_id, driver, method, and train_rmse_speed,
            test_rmse_speed (m/s), train_rmse_gap, test_rmse_gap (m): on the part that
            driver-specific parameters were calibrated on, and on the test part.
    """
    if "fixed" not in evaluation.methods or not evaluation.names:
        return {}
    if not isinstance(context.simulator, MemoryStepper):
        return {}
    number = {pair.pair_id: index for index, pair in enumerate(context.pairs)}
    ids = evaluation.about["pair_id"].drop_duplicates().astype(str).tolist()
    chosen = torch.tensor([number[name] for name in ids])
    batch = context.batch[chosen.to(context.batch.lengths.device)]
    last = Split.of(context.pairs, context.windows, context.split).frame[chosen]
    fits = []
    for method in evaluation.methods:
        if method in _CONSTANT:
            parameters = _parameters(evaluation, method, ids, batch.leader_length)
            found = training_errors(context.calibrator, batch, last, parameters)
            fits.append(_fits(evaluation, method, found))
    best = _parameters(evaluation, "fixed", ids, batch.leader_length)
    table = slices(context.calibrator, batch, last, best, ids)
    return {"slices": table, "fits": pd.concat(fits, ignore_index=True)}


def _parameters(evaluation: Evaluation, method: str, ids: list[str], like: Tensor) -> Tensor:
    """Returns a method's constant parameters `(P, n)`, SI units."""
    rows = evaluation.about[evaluation.about["method"] == method].set_index("pair_id")
    columns = [f"parameter_{name}" for name in evaluation.names]
    values = np.array(rows.loc[ids, columns], dtype=np.float64)
    return torch.as_tensor(values, dtype=like.dtype, device=like.device)


def _fits(evaluation: Evaluation, method: str, train: dict[str, Tensor]) -> pd.DataFrame:
    rows = evaluation.table[evaluation.table["method"] == method]
    found = rows[["pair_id", "driver"]].reset_index(drop=True)
    found["method"] = method
    for name, values in train.items():
        found[f"train_{name}"] = values.cpu().numpy()
        found[f"test_{name}"] = rows[name].to_numpy(dtype=np.float64)
    return found
