"""From closed loops to a table and to statistics over drivers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.result import METHODS, Drive, Evaluation, Improvement
from cfx.pairs import PairBatch, PairSet
from cfx.parameters import ParameterSpace
from cfx.style.result import CLUSTERS, StyleResult

_TRIMMED = 0.1
"""Share dropped at each end of the improvements for the trimmed mean, as in the paper."""

_RESAMPLES = 9_999


def improvement_statistics(fixed: NDArray[np.float64], policy: NDArray[np.float64], *, seed: int) -> Improvement:
    """Compares two methods over P pairs.

    Args:
        fixed, policy: RMSE of speed of each pair, `(P,)`, m/s; a pair counts where both are finite and `fixed` is positive.
        seed: of the bootstrap.
    """
    counts = np.isfinite(fixed) & np.isfinite(policy) & (fixed > 0)
    before, after = fixed[counts], policy[counts]
    if not counts.any():
        nan = float("nan")
        return Improvement(nan, nan, nan, nan, nan, nan, nan, pairs=0, undefined=len(fixed))
    gain = (before - after) / before
    low = high = float("nan")
    if len(gain) > 1:
        interval = stats.bootstrap(
            (gain,), np.mean, n_resamples=_RESAMPLES, method="percentile", rng=np.random.default_rng(seed)
        ).confidence_interval
        low, high = float(interval.low), float(interval.high)
    different = bool(np.any(before != after))
    # Without a single difference the test has nothing to rank.
    p_value = float(stats.wilcoxon(before, after, zero_method="zsplit").pvalue) if different else 1.0
    return Improvement(
        mean=float(gain.mean()),
        trimmed_mean=float(stats.trim_mean(gain, _TRIMMED)),
        median=float(np.median(gain)),
        ci95_low=low,
        ci95_high=high,
        win_rate=float((gain > 0).mean()),
        p_value=p_value,
        pairs=int(counts.sum()),
        undefined=int((~counts).sum()),
    )


def evaluate(
    pairs: PairSet,
    batch: PairBatch,
    first: Tensor,
    loops: Mapping[str, ClosedLoop],
    space: ParameterSpace,
    style: StyleResult,
    *,
    seed: int,
) -> Evaluation:
    """Measures closed loops against the recording.

    Args:
        pairs: P pairs.
        batch: the same as tensors.
        first: `(P,)`, the frame of the last measured state.
        loops: the closed loops of each method, on the same frames.
        space: the model's parameters.
        style: score and cluster of each driver.
        seed: of the bootstrap.
    """
    counted = loops["fixed"].counted
    steps = counted.shape[1]
    index = (first[:, None] + torch.arange(steps, device=first.device)).clamp(max=batch.mask.shape[1] - 1)
    real_speed, real_gap = batch.follower_speed.gather(1, index), batch.gap.gather(1, index)
    rmse_speed = {m: _rmse(loop.speed, real_speed, counted) for m, loop in loops.items()}
    rmse_gap = {m: _rmse(loop.gap, real_gap, counted) for m, loop in loops.items()}
    collided = {m: ((loop.gap < 0) & counted).any(1).cpu().numpy() for m, loop in loops.items()}
    means = {m: _mean(loop.parameters, counted) for m, loop in loops.items()}
    drivers = style.table["driver"]
    cluster = dict(zip(drivers, style.table["cluster"], strict=True))
    score = dict(zip(drivers, style.table["score"], strict=True))
    rows = []
    for i, pair in enumerate(pairs):
        for method in METHODS:
            before, after = rmse_speed["fixed"][i], rmse_speed[method][i]
            rows.append(
                {
                    "pair_id": pair.pair_id,
                    "recording": pair.recording,
                    "leader_id": pair.leader_id,
                    "follower_id": pair.follower_id,
                    "driver": pair.driver,
                    "cluster": CLUSTERS[cluster[pair.driver]],
                    "style_score": float(score[pair.driver]),
                    "fold": 0,
                    "method": method,
                    "frames": int(counted[i].sum()),
                    "rmse_speed": float(after),
                    "rmse_gap": float(rmse_gap[method][i]),
                    "improvement": float((before - after) / before) if before > 0 else float("nan"),
                    "collisions": int(collided[method][i]),
                    **{f"parameter_{name}": float(v) for name, v in zip(space.names, means[method][i], strict=True)},
                }
            )
    return Evaluation(
        table=pd.DataFrame(rows),
        improvement=improvement_statistics(rmse_speed["fixed"], rmse_speed["policy"], seed=seed),
        drives=_drives(pairs, batch, first, index, loops),
        names=space.names,
        units=tuple(parameter.unit for parameter in space.tuned),
        bounds=space.bounds().numpy(),
    )


def _rmse(simulated: Tensor, real: Tensor, counted: Tensor) -> NDArray[np.float64]:
    error = torch.where(counted, simulated - real, 0.0)
    return np.asarray((error.square().sum(1) / counted.sum(1)).sqrt().double().cpu().numpy())


def _mean(parameters: Tensor, counted: Tensor) -> NDArray[np.float64]:
    weight = counted[..., None]
    return np.asarray((torch.where(weight, parameters, 0.0).sum(1) / weight.sum(1)).double().cpu().numpy())


def _drives(pairs: PairSet, batch: PairBatch, first: Tensor, index: Tensor, loops: Mapping[str, ClosedLoop]) -> tuple[Drive, ...]:
    def rows(values: Tensor) -> list[NDArray[np.float64]]:
        ends = (batch.lengths - first).tolist()
        return [row[:end].double().cpu().numpy() for row, end in zip(values, ends, strict=True)]

    leader = rows(batch.leader_speed.gather(1, index))
    speed, gap = rows(batch.follower_speed.gather(1, index)), rows(batch.gap.gather(1, index))
    simulated = {m: (rows(loop.speed), rows(loop.gap), rows(loop.parameters)) for m, loop in loops.items()}
    return tuple(
        Drive(
            pair_id=pair.pair_id,
            driver=pair.driver,
            time=(int(first[i]) + np.arange(len(speed[i]), dtype=np.float64)) * pair.dt,
            leader_speed=leader[i],
            real_speed=speed[i],
            real_gap=gap[i],
            speed={m: values[0][i] for m, values in simulated.items()},
            gap={m: values[1][i] for m, values in simulated.items()},
            parameters={m: values[2][i] for m, values in simulated.items()},
        )
        for i, pair in enumerate(pairs)
    )
