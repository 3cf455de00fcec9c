"""From closed loops to the table of all metrics and to statistics over drivers.

Shapes: P pairs, K + 1 frames, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.core import registry
from cfx.core.parameters import ParameterSpace
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.style import CLUSTERS, StyleResult
from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.metrics.base import (
    RECORDED,
    LeftOut,
    MeasuredMetric,
    MetricInfo,
    MetricSet,
    Trajectories,
    leave_out,
)
from cfx.evaluation.metrics.errors import RmseGap, RmseSpeed
from cfx.evaluation.result import METHODS, Array, Evaluation
from cfx.evaluation.statistics import Improvement, improvement_statistics
from cfx.evaluation.tables import long_table, values_of
from cfx.evaluation.trajectories import (
    array,
    beside_recording,
    parts_of,
    rows_of,
    simulated_pairs,
    trajectories_of,
)
from cfx.simulation.trajectory import TRANSIENT_S

Measured = dict[tuple[str, str, str], NDArray[np.float64]]
"""By metric, scope and method the value of each pair, `(P,)`."""


@dataclass(frozen=True)
class ComparedPairs:
    """P pairs on which methods are compared.

    Attributes:
        pairs, batch: the recording, as objects and as tensors.
        first: `(P,)`, the frame of the last measured state.
        style: score and cluster of each driver.
        fold: `(P,)`, in which fold each pair was tested; None if there was one.
    """

    pairs: PairSet
    batch: PairBatch
    first: Tensor
    style: StyleResult
    fold: Tensor | None = None


def evaluate(
    tested: ComparedPairs,
    scopes: Mapping[str, Mapping[str, ClosedLoop]],
    space: ParameterSpace,
    *,
    seed: int,
    policy_space: ParameterSpace | None = None,
    metrics: MetricSet | None = None,
) -> Evaluation:
    """Measures closed loops against the recording.

    Args:
        tested: P pairs.
        scopes: the closed loops of each method of `METHODS`. `test`: from `first` on; `fixed` and
            `policy` are among them. `full_trajectory`, if there: from frame 0 on, of methods that
            nothing of these drivers went into.
        space: the model's parameters, in the bounds of constant ones.
        seed: of the bootstrap.
        policy_space: the parameters in the bounds of `policy`; None: the same bounds.
        metrics: what is measured; None: cfx's own metrics.

    Returns:
        The comparison, without `platoon`, `tables` and `outside`.
    """
    pairs, batch, first = tested.pairs, tested.batch, tested.first
    loops = {method: scopes["test"][method] for method in METHODS if method in scopes["test"]}
    full_trajectory = scopes.get("full_trajectory", {})
    if policy_space is None:
        policy_space = space
    spaces = dict.fromkeys(METHODS, space) | {"policy": policy_space}
    measures = _Measures(metrics or MetricSet.own())
    for rows in parts_of(len(pairs)):
        whole = _rows(full_trajectory, rows)
        measures.add(_scopes(batch[rows], first[rows], _rows(loops, rows), whole, spaces))
    measured, infos, left_out = measures.found()
    drivers = [pair.driver for pair in pairs]
    values = long_table([pair.pair_id for pair in pairs], drivers, measured)
    improvements = {}
    for scope in ("test", "steady", "full_trajectory"):
        found = _improvements(values, scope, drivers, seed)
        if found:
            improvements[scope] = found
    return Evaluation(
        about=_about(tested, measures, space.names),
        values=values,
        measured=infos,
        improvements=improvements,
        trajectories=simulated_pairs(pairs, batch, first, loops),
        parameters=policy_space.tuned,
        left_out=left_out,
    )


def closed_loop_errors(batch: PairBatch, first: Tensor, loop: ClosedLoop) -> tuple[Array, Array]:
    """Returns the RMSE of speed (m/s) and of the gap (m), `(P,)` each.

    Args:
        first: `(P,)`, the frame of the recording at which each closed loop begins.
    """
    speed, gap = [], []
    for rows in parts_of(len(batch)):
        space = ParameterSpace(())
        some = beside_recording(batch[rows], first[rows], rows_of(loop, rows), space)
        speed.append(array(RmseSpeed().compute(some)))
        gap.append(array(RmseGap().compute(some)))
    return np.concatenate(speed), np.concatenate(gap)


def _rows(loops: Mapping[str, ClosedLoop], rows: slice) -> dict[str, ClosedLoop]:
    """Returns of each method the closed loops of some of the pairs."""
    return {method: rows_of(loop, rows) for method, loop in loops.items()}


def _scopes(
    batch: PairBatch,
    first: Tensor,
    test: Mapping[str, ClosedLoop],
    full_trajectory: Mapping[str, ClosedLoop],
    spaces: Mapping[str, ParameterSpace],
) -> dict[str, dict[str, Trajectories]]:
    """Returns what is measured in each scope, beside the recording."""
    of_test = trajectories_of(batch, first, test, spaces)
    scopes = {"test": of_test, "steady": _after_transient(of_test)}
    if full_trajectory:
        start = torch.zeros_like(first)
        scopes["full_trajectory"] = trajectories_of(batch, start, full_trajectory, spaces)
    return scopes


def _after_transient(trajectories: Mapping[str, Trajectories]) -> dict[str, Trajectories]:
    """Returns the same trajectories, of which only the frames after the transient count."""
    found = {}
    for method, one in trajectories.items():
        time = torch.arange(one.counted.shape[1], device=one.counted.device) * one.dt
        found[method] = one.counting(one.counted & (time > TRANSIENT_S + 1e-6))
    return found


class _Measures:
    """What is measured of pairs, some after the other.

    A plugin's metric that fails is left out with a warning.

    Attributes:
        frames: of the test part, how many count of each pair, `(P,)`; one array per part.
        parameters: by method the mean of each parameter over them, `(P, n)`; the same.
    """

    def __init__(self, metrics: MetricSet) -> None:
        self.frames: list[NDArray[np.int64]] = []
        self.parameters: dict[str, list[Array]] = {}
        self._metrics = list(metrics.metrics)
        self._left_out = list(metrics.left_out)
        self._values: dict[str, dict[tuple[str, str, str], list[Array]]] = {}
        self._scopes: Collection[str] = ()

    def add(self, scopes: Mapping[str, Mapping[str, Trajectories]]) -> None:
        """Computes every metric for every scope and method of further pairs."""
        self._scopes = scopes.keys()
        for one in list(self._metrics):
            try:
                values = _values(one, scopes)
            except (
                Exception
            ) as error:  # a plugin may raise anything, and must not cost the job its results
                if one.distribution == registry.OWN:
                    raise
                self._left_out.append(
                    leave_out(one.name, one.distribution, registry.in_words(error))
                )
                self._metrics.remove(one)
                continue
            of_metric = self._values.setdefault(one.name, {})
            for key, found in values.items():
                of_metric.setdefault(key, []).append(found)
        test = scopes["test"]
        self.frames.append(next(iter(test.values())).counted.sum(1).cpu().numpy())
        for method, trajectories in test.items():
            if method != RECORDED:
                self.parameters.setdefault(method, []).append(_mean_parameters(trajectories))

    def found(self) -> tuple[Measured, tuple[MetricInfo, ...], tuple[LeftOut, ...]]:
        """Returns what was measured of all pairs, of which metrics, and what was left out."""
        measured: Measured = {}
        for one in self._metrics:
            for key, parts in self._values[one.name].items():
                measured[key] = np.concatenate(parts)
        infos = tuple(_info(one, self._scopes) for one in self._metrics)
        return measured, infos, tuple(self._left_out)


@torch.no_grad()
def _values(one: MeasuredMetric, scopes: Mapping[str, Mapping[str, Trajectories]]) -> Measured:
    found: Measured = {}
    for scope, by_method in scopes.items():
        for method, trajectories in by_method.items():
            if method == RECORDED and (scope != "test" or not one.metric.is_of_recording):
                continue
            values = one.metric.compute(trajectories)
            if values.shape != (len(trajectories),):
                raise ValueError(f"compute gives the shape {tuple(values.shape)}, not (pairs,)")
            # Where no frame counts nothing is defined, a count of zero neither.
            some = trajectories.counted.any(1)
            found[one.name, scope, method] = array(torch.where(some, values, torch.nan))
    return found


def _info(one: MeasuredMetric, scopes: Collection[str]) -> MetricInfo:
    metric = one.metric
    return MetricInfo(
        name=one.name,
        unit=metric.unit,
        direction=metric.direction,
        summary=metric.summary,
        heading=metric.heading,
        meaning=metric.meaning,
        scopes=tuple(scope for scope in metric.scopes if scope in scopes),
        headline=metric.headline,
        distribution=one.distribution,
    )


def _improvements(
    values: pd.DataFrame, scope: str, drivers: Sequence[str], seed: int
) -> dict[str, Improvement]:
    """Returns the policy's improvement over every other method; empty if it was not simulated."""
    speed = values_of(values, "rmse_speed", scope)
    if "policy" not in speed:
        return {}
    policy = speed["policy"].to_numpy()
    if scope == "steady" and not np.isfinite(policy).any():
        return {}
    found = {}
    for method in METHODS:
        if method in speed and method != "policy":
            before = speed[method].to_numpy()
            found[method] = improvement_statistics(before, policy, drivers, seed=seed)
    return found


def _about(tested: ComparedPairs, measures: _Measures, names: Sequence[str]) -> pd.DataFrame:
    """Returns `Evaluation.about`."""
    pairs = tested.pairs
    by_driver = tested.style.table.set_index("driver")
    methods = list(measures.parameters)
    drivers = [pair.driver for pair in pairs]
    clusters = by_driver["cluster"].loc[drivers].map(dict(enumerate(CLUSTERS)))
    folds = np.zeros(len(pairs), dtype=np.int64)
    if tested.fold is not None:
        folds = tested.fold.numpy()
    of_pair = {
        "pair_id": [pair.pair_id for pair in pairs],
        "recording": [pair.recording for pair in pairs],
        "leader_id": [pair.leader_id for pair in pairs],
        "follower_id": [pair.follower_id for pair in pairs],
        "driver": drivers,
        "cluster": clusters.to_numpy(),
        "style_score": by_driver["score"].loc[drivers].to_numpy(dtype=np.float64),
        "fold": folds,
    }
    # A pair after the other, the methods in turn.
    table = pd.DataFrame(of_pair).iloc[np.repeat(np.arange(len(pairs)), len(methods))]
    table = table.reset_index(drop=True)
    table["method"] = np.tile(np.asarray(methods, dtype=object), len(pairs))
    table["frames"] = np.repeat(np.concatenate(measures.frames), len(methods))
    of_method = [np.concatenate(parts) for parts in measures.parameters.values()]
    parameters = np.stack(of_method, 1)
    for k, name in enumerate(names):
        table[f"parameter_{name}"] = parameters[:, :, k].reshape(-1)
    return table


def _mean_parameters(trajectories: Trajectories) -> Array:
    """Returns the mean of each parameter over the frames that count, `(P, n)`."""
    weight = trajectories.counted[..., None]
    return array(torch.where(weight, trajectories.parameters, 0.0).sum(1) / weight.sum(1))
