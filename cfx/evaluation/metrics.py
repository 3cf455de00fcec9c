"""From closed loops to a table and to statistics over drivers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.result import METHODS, Array, Drive, Evaluation, Improvement, Platoon
from cfx.evaluation.safety import Safety, rms_jerk
from cfx.pairs import PairBatch, PairSet
from cfx.parameters import ParameterSpace
from cfx.style.result import CLUSTERS, StyleResult

_TRIMMED = 0.1
"""Share dropped at each end of the improvements for the trimmed mean, as in the paper."""

_RESAMPLES = 9_999

TRANSIENT_S = 5.0
"""How long the start of a test part is: constant parameters leave the measured state for their own within some such time."""


def improvement_statistics(
    baseline: NDArray[np.float64],
    policy: NDArray[np.float64],
    drivers: Sequence[str] | None = None,
    *,
    seed: int,
) -> Improvement:
    """Compares two methods over P pairs.

    Pairs of one driver are not independent: the bootstrap draws drivers (a cluster bootstrap), and the test compares drivers.

    Args:
        baseline, policy: RMSE of speed of each pair, `(P,)`, m/s; a pair counts where both are finite and `baseline` is positive.
        drivers: whose pair each is, `(P,)`; None if each is another's.
        seed: of the bootstrap.
    """
    counts = np.isfinite(baseline) & np.isfinite(policy) & (baseline > 0)
    before, after = baseline[counts], policy[counts]
    if not counts.any():
        nan = float("nan")
        return Improvement(
            nan, nan, nan, nan, nan, nan, nan, pairs=0, undefined=len(baseline), drivers=0
        )
    who = (
        np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]
        if drivers is not None
        else np.arange(len(before))
    )
    gain = (before - after) / before
    low, high = _interval(gain, who, seed)
    number = np.bincount(who)
    before, after = np.bincount(who, before) / number, np.bincount(who, after) / number
    # Without a single difference the test has nothing to rank.
    different = bool(np.any(before != after))
    return Improvement(
        mean=float(gain.mean()),
        trimmed_mean=float(stats.trim_mean(gain, _TRIMMED)),
        median=float(np.median(gain)),
        ci95_low=low,
        ci95_high=high,
        win_rate=float((gain > 0).mean()),
        p_value=float(stats.wilcoxon(before, after, zero_method="zsplit").pvalue)
        if different
        else 1.0,
        pairs=int(counts.sum()),
        undefined=int((~counts).sum()),
        drivers=len(number),
    )


def mean_interval(
    values: Sequence[float], drivers: Sequence[str], *, seed: int
) -> tuple[float, float, float]:
    """Returns the mean over pairs and its 95 % interval, drivers drawn with all their pairs; NaN where it is not defined.

    Args:
        values: one for each pair; those that are not finite do not count.
        drivers: whose pair each is.
        seed: of the bootstrap.
    """
    every = np.asarray(values, dtype=np.float64)
    counts = np.isfinite(every)
    if not counts.any():
        return float("nan"), float("nan"), float("nan")
    who = np.unique(np.asarray(drivers)[counts], return_inverse=True)[1]
    return float(every[counts].mean()), *_interval(every[counts], who, seed)


def _interval(gain: NDArray[np.float64], who: NDArray[np.intp], seed: int) -> tuple[float, float]:
    """Returns the 95 % interval of the mean gain, drawing drivers with all their pairs; NaN for a single driver."""
    number = np.bincount(who).astype(float)
    if len(number) < 2:
        return float("nan"), float("nan")

    def mean(
        total: NDArray[np.float64], pairs: NDArray[np.float64], axis: int = -1
    ) -> NDArray[np.float64]:
        return np.asarray(total.sum(axis) / pairs.sum(axis))

    interval = stats.bootstrap(
        (np.bincount(who, gain), number),
        mean,
        n_resamples=_RESAMPLES,
        paired=True,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def closed_loop_errors(batch: PairBatch, first: Tensor, loop: ClosedLoop) -> tuple[Array, Array]:
    """Returns the RMSE of speed (m/s) and of gap (m) of P closed loops that begin at frames `first`, `(P,)` each."""
    frames = first[:, None] + torch.arange(loop.counted.shape[1], device=first.device)
    index = frames.clamp(max=batch.mask.shape[1] - 1)
    return (
        _rmse(loop.speed, batch.follower_speed.gather(1, index), loop.counted),
        _rmse(loop.gap, batch.gap.gather(1, index), loop.counted),
    )


@dataclass(frozen=True)
class _Errors:
    """What each method did over the frames that its closed loops have, `(P,)` each; `counted` as in `ClosedLoop`.

    `speed` and `gap` are RMSEs; `later` is that of speed beyond the start (`TRANSIENT_S`), NaN for a drive that is no longer;
    `real_jerk` is the recorded drivers', m/s3.
    """

    speed: Mapping[str, Array]
    gap: Mapping[str, Array]
    steady: Mapping[str, Array]
    safety: Mapping[str, Safety]
    real_jerk: Array
    counted: Tensor
    index: Tensor

    @classmethod
    def of(
        cls,
        batch: PairBatch,
        first: Tensor,
        loops: Mapping[str, ClosedLoop],
        space: ParameterSpace,
        adaptation_space: ParameterSpace,
    ) -> _Errors:
        counted = next(iter(loops.values())).counted
        frames = first[:, None] + torch.arange(counted.shape[1], device=first.device)
        index = frames.clamp(max=batch.mask.shape[1] - 1)
        real_speed, real_gap = batch.follower_speed.gather(1, index), batch.gap.gather(1, index)
        steady = counted & (
            torch.arange(counted.shape[1], device=first.device) * batch.dt > TRANSIENT_S + 1e-6
        )
        return cls(
            {m: _rmse(loop.speed, real_speed, counted) for m, loop in loops.items()},
            {m: _rmse(loop.gap, real_gap, counted) for m, loop in loops.items()},
            {m: _rmse(loop.speed, real_speed, steady) for m, loop in loops.items()},
            {
                m: Safety.of(loop, adaptation_space if m == "policy" else space, batch.dt)
                for m, loop in loops.items()
            },
            rms_jerk(real_speed, counted, batch.dt),
            counted,
            index,
        )

    def row(self, i: int, method: str) -> dict[str, float]:
        """Returns what the table says of pair i and a method."""
        before, after, safety = self.speed["fixed"][i], self.speed[method][i], self.safety[method]
        row = {
            "frames": int(self.counted[i].sum()),
            "rmse_speed": float(after),
            "rmse_gap": float(self.gap[method][i]),
            "steady_rmse_speed": float(self.steady[method][i]),
            "improvement": _gain(before, after),
        }
        for other in (name for name in self.speed if name not in {"fixed", "policy"}):
            row[f"improvement_over_{other}"] = _gain(self.speed[other][i], after)
        return row | {
            "collisions": int(safety.collided[i]),
            "hard_braking": int(safety.hard_braking[i]),
            "rms_jerk": float(safety.rms_jerk[i]),
            "real_rms_jerk": float(self.real_jerk[i]),
            "at_bounds": float(safety.at_bounds[i]),
        }

    def full_trajectory_row(self, i: int, method: str) -> dict[str, float]:
        """Returns what the table says of the whole drive of pair i; NaN for a method that did not drive it."""
        names = ("rmse_speed", "rmse_gap", "collisions", "hard_braking")
        if method not in self.speed:
            return {f"whole_{name}": float("nan") for name in names}
        safety = self.safety[method]
        found = (self.speed[method], self.gap[method], safety.collided, safety.hard_braking)
        return {
            f"whole_{name}": float(values[i]) for name, values in zip(names, found, strict=True)
        }

    def improvements(
        self, drivers: Sequence[str], seed: int, *, steady: bool = False
    ) -> dict[str, Improvement]:
        """Returns the policy's improvement over every other method; `later`: beyond the start, empty if no drive is longer."""
        errors = self.steady if steady else self.speed
        if steady and not np.isfinite(errors["policy"]).any():
            return {}
        return {
            method: improvement_statistics(before, errors["policy"], drivers, seed=seed)
            for method, before in errors.items()
            if method != "policy"
        }


def evaluate(
    pairs: PairSet,
    batch: PairBatch,
    first: Tensor,
    loops: Mapping[str, ClosedLoop],
    space: ParameterSpace,
    style: StyleResult,
    *,
    seed: int,
    adaptation_space: ParameterSpace | None = None,
    fold: Tensor | None = None,
    whole: Mapping[str, ClosedLoop] | None = None,
    platoon: Platoon | None = None,
    history: pd.DataFrame | None = None,
) -> Evaluation:
    """Measures closed loops against the recording.

    Args:
        pairs: P pairs.
        batch: the same as tensors.
        first: `(P,)`, the frame of the last measured state.
        loops: the closed loops of each method of `METHODS`, on the same frames; `fixed` and `policy` are among them.
        space: the model's parameters, in the bounds of constant ones.
        reach: the same in the bounds of `policy`; None: alike.
        style: score and cluster of each driver.
        seed: of the bootstrap.
        fold: `(P,)`, in which fold each pair was tested; None if there was one.
        whole: closed loops from frame 0 on, of methods that nothing of these drivers went into; None if there are none.
        platoon, history: further results, handed on; see `Evaluation`.
    """
    loops = {method: loops[method] for method in METHODS if method in loops}
    adaptation_space = space if adaptation_space is None else adaptation_space
    errors = _Errors.of(batch, first, loops, space, adaptation_space)
    errors_full_trajectory = (
        _Errors.of(batch, torch.zeros_like(first), whole, space, adaptation_space)
        if whole
        else None
    )
    means = {m: _mean(loop.parameters, errors.counted) for m, loop in loops.items()}
    by_driver = style.table.set_index("driver")
    rows = []
    for i, pair in enumerate(pairs):
        about = {
            "pair_id": pair.pair_id,
            "recording": pair.recording,
            "leader_id": pair.leader_id,
            "follower_id": pair.follower_id,
            "driver": pair.driver,
            "cluster": CLUSTERS[by_driver["cluster"][pair.driver]],
            "style_score": float(by_driver["score"][pair.driver]),
            "fold": int(fold[i]) if fold is not None else 0,
        }
        for method in loops:
            row = about | {"method": method} | errors.row(i, method)
            row |= {
                f"parameter_{name}": float(v)
                for name, v in zip(space.names, means[method][i], strict=True)
            }
            rows.append(
                row
                | (
                    errors_full_trajectory.full_trajectory_row(i, method)
                    if errors_full_trajectory is not None
                    else {}
                )
            )
    drivers = [pair.driver for pair in pairs]
    return Evaluation(
        table=pd.DataFrame(rows),
        improvements=errors.improvements(drivers, seed),
        steady_improvements=errors.improvements(drivers, seed, steady=True),
        drives=_drives(pairs, batch, first, errors.index, loops),
        names=space.names,
        units=tuple(parameter.unit for parameter in space.tuned),
        bounds=adaptation_space.bounds().numpy(),
        full_trajectory_improvements=errors_full_trajectory.improvements(drivers, seed)
        if errors_full_trajectory is not None
        else {},
        platoon=platoon,
        history=history,
    )


def _gain(before: float, after: float) -> float:
    return float((before - after) / before) if before > 0 else float("nan")


def _rmse(simulated: Tensor, real: Tensor, counted: Tensor) -> NDArray[np.float64]:
    error = torch.where(counted, simulated - real, 0.0)
    return np.asarray((error.square().sum(1) / counted.sum(1)).sqrt().double().cpu().numpy())


def _mean(parameters: Tensor, counted: Tensor) -> NDArray[np.float64]:
    weight = counted[..., None]
    return np.asarray(
        (torch.where(weight, parameters, 0.0).sum(1) / weight.sum(1)).double().cpu().numpy()
    )


def _drives(
    pairs: PairSet, batch: PairBatch, first: Tensor, index: Tensor, loops: Mapping[str, ClosedLoop]
) -> tuple[Drive, ...]:
    def rows(values: Tensor) -> list[NDArray[np.float64]]:
        ends = (batch.lengths - first).tolist()
        return [row[:end].double().cpu().numpy() for row, end in zip(values, ends, strict=True)]

    leader = rows(batch.leader_speed.gather(1, index))
    speed, gap = rows(batch.follower_speed.gather(1, index)), rows(batch.gap.gather(1, index))
    simulated = {
        m: (rows(loop.speed), rows(loop.gap), rows(loop.parameters)) for m, loop in loops.items()
    }
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
