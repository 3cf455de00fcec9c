"""From closed loops beside the recording to the table of all metrics, and statistics over drivers.

Shapes: P pairs, K + 1 frames, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.core import memory
from cfx.core.distributions import OWN
from cfx.core.parameters import ParameterSpace
from cfx.core.registry import Installed
from cfx.data.pairs import PairBatch, PairSet, of_each
from cfx.data.style import CLUSTERS, StyleResult
from cfx.errors import in_words
from cfx.evaluation.closed_loop import PAIRS_AT_ONCE, ClosedLoop
from cfx.evaluation.metrics.base import (
    RECORDED,
    LeftOut,
    Metric,
    MetricInfo,
    MetricSet,
    Trajectories,
    info_of,
    leave_out,
)
from cfx.evaluation.metrics.errors import RmseGap, RmseSpeed
from cfx.evaluation.result import METHODS, Array, Evaluation, PairTrajectory
from cfx.evaluation.statistics import Improvement, improvement_statistics
from cfx.evaluation.tables import long_table, values_of
from cfx.simulation.trajectory import TRANSIENT_S


def parts_of(pairs: int) -> Iterator[slice]:
    """Yields the rows of some pairs, then of the next.

    Between two of them memory goes back to the system: what is kept of each part, small arrays,
    lies between large ones that are free by then.
    """
    for start in range(0, pairs, PAIRS_AT_ONCE):
        yield slice(start, min(start + PAIRS_AT_ONCE, pairs))
        memory.release()
        if pairs > PAIRS_AT_ONCE:
            memory.give_back()


def beside_recording(
    batch: PairBatch, first: Tensor, loop: ClosedLoop, space: ParameterSpace
) -> Trajectories:
    """Returns closed loops of P pairs, which begin at frames `first` `(P,)` of the recording."""
    frames = first[:, None] + torch.arange(loop.counted.shape[1], device=first.device)
    index = frames.clamp(max=batch.mask.shape[1] - 1)
    return Trajectories(
        speed=loop.speed,
        gap=loop.gap,
        measured_speed=batch.follower_speed.gather(1, index),
        measured_gap=batch.gap.gather(1, index),
        leader_speed=batch.leader_speed.gather(1, index),
        parameters=loop.parameters,
        counted=loop.counted,
        dt=batch.dt,
        space=space,
        at_limits=loop.at_limits,
        outside=loop.outside,
    )


def rows_of(loop: ClosedLoop, rows: slice) -> ClosedLoop:
    """Returns the closed loops of some of the pairs."""
    chosen: dict[str, Any] = {}
    for name, values in loop._asdict().items():
        if name != "beyond" and values is not None:
            chosen[name] = values[rows]
    return loop._replace(**chosen)


@dataclass(frozen=True)
class SimulatedPairs(Sequence[PairTrajectory]):
    """The test part of each pair as it was recorded and simulated; each is made when asked for.

    Attributes:
        pairs: P pairs.
        batch: the same as tensors.
        first: `(P,)`, the frame of the last measured state.
        loops: the closed loops of each method.
    """

    pairs: PairSet
    batch: PairBatch
    first: Tensor
    loops: Mapping[str, ClosedLoop]

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[PairTrajectory]:
        for rows in parts_of(len(self)):
            for index in range(rows.start, rows.stop):
                yield self._pair(index)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            memory.release()
            return tuple(self._pair(number) for number in range(*index.indices(len(self))))
        return self._pair(range(len(self))[index])

    def _pair(self, index: int) -> PairTrajectory:
        pair, batch = self.pairs[index], self.batch
        frames = slice(int(self.first[index]), int(batch.lengths[index]))
        count = frames.stop - frames.start
        leader_rear = batch.leader_position[index, frames] - batch.leader_length[index]
        speed, gap, parameters = {}, {}, {}
        for method, loop in self.loops.items():
            speed[method] = array(loop.speed[index, :count])
            gap[method] = array(loop.gap[index, :count])
            parameters[method] = array(loop.parameters[index, :count])
        return PairTrajectory(
            pair_id=pair.pair_id,
            driver=pair.driver,
            time=np.arange(frames.start, frames.stop, dtype=np.float64) * pair.dt,
            leader_speed=array(batch.leader_speed[index, frames]),
            real_speed=array(batch.follower_speed[index, frames]),
            real_gap=array(leader_rear - batch.follower_position[index, frames]),
            speed=speed,
            gap=gap,
            parameters=parameters,
        )


def array(values: Tensor) -> Array:
    """Returns a tensor's values in double precision."""
    return np.asarray(values.double().cpu().numpy())


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
    policy_space: ParameterSpace | None = None,
    metrics: MetricSet | None = None,
) -> Evaluation:
    """Measures closed loops against the recording.

    Args:
        tested: P pairs.
        scopes: the closed loops of each method of `METHODS`. `test`: from `first` on;
            `driver_specific` and `policy` are among them. `full_trajectory`, if there: from frame 0
            on, of methods that nothing of these drivers went into.
        space: the model's parameters, in the bounds of constant ones.
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
    chosen = metrics or MetricSet.own()
    measures = _Measures(chosen)
    for rows in parts_of(len(pairs)):
        whole = _rows(full_trajectory, rows)
        measures.add(_scopes(batch[rows], first[rows], _rows(loops, rows), whole, spaces))
    measured, infos, left_out = measures.found()
    drivers = pairs.drivers
    values = long_table(pairs.ids, drivers, measured)
    improvements = {}
    for scope in ("test", "steady", "full_trajectory"):
        of_scope = _improvements(values, chosen.judge, scope, drivers)
        if of_scope:
            improvements[scope] = of_scope
    simulated = SimulatedPairs(pairs, batch, first, loops)
    return Evaluation(
        about=_about(tested, measures, space.names),
        values=values,
        measured=infos,
        improvements=improvements,
        trajectories=simulated if len(pairs) > PAIRS_AT_ONCE else tuple(simulated),
        parameters=policy_space.tuned,
        left_out=left_out,
        judge=chosen.judge,
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
    """Returns what is measured in each scope, and the recorded drivers, beside the recording."""
    scopes = {}
    begins = {"test": (test, first), "full_trajectory": (full_trajectory, torch.zeros_like(first))}
    for scope, (loops, begin) in begins.items():
        by_name = {}
        for method, loop in loops.items():
            by_name[method] = beside_recording(batch, begin, loop, spaces[method])
        if not by_name:
            continue
        of_any = next(iter(by_name.values()))
        by_name[RECORDED] = replace(
            of_any,
            speed=of_any.measured_speed,
            gap=of_any.measured_gap,
            parameters=torch.full_like(of_any.parameters, torch.nan),
            at_limits=None,
            outside=None,
        )
        scopes[scope] = by_name
        if scope == "test":
            scopes["steady"] = _after_transient(by_name)
    return scopes


def _after_transient(trajectories: Mapping[str, Trajectories]) -> dict[str, Trajectories]:
    """Returns the same trajectories, of which only the frames after the transient count."""
    steady = {}
    for method, trajectory in trajectories.items():
        time = (
            torch.arange(trajectory.counted.shape[1], device=trajectory.counted.device)
            * trajectory.dt
        )
        steady[method] = replace(
            trajectory, counted=trajectory.counted & (time > TRANSIENT_S + 1e-6)
        )
    return steady


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
        self._judge = metrics.judge
        self._left_out = list(metrics.left_out)
        self._values: dict[str, dict[tuple[str, str, str], list[Array]]] = {}
        self._scopes: Collection[str] = ()

    def add(self, scopes: Mapping[str, Mapping[str, Trajectories]]) -> None:
        """Computes every metric for every scope and method of further pairs."""
        self._scopes = scopes.keys()
        for metric in list(self._metrics):
            try:
                values = _values(metric, scopes)
            # A plugin may raise anything, and must not cost the job its results.
            except Exception as error:
                if metric.distribution == OWN or metric.name == self._judge:
                    raise
                reason = in_words(error)
                self._left_out.append(leave_out(metric.name, metric.distribution, reason))
                self._metrics.remove(metric)
                continue
            of_metric = self._values.setdefault(metric.name, {})
            for key, column in values.items():
                of_metric.setdefault(key, []).append(column)
        test = scopes["test"]
        self.frames.append(next(iter(test.values())).counted.sum(1).cpu().numpy())
        for method, trajectories in test.items():
            if method != RECORDED:
                self.parameters.setdefault(method, []).append(_mean_parameters(trajectories))

    def found(self) -> tuple[Measured, tuple[MetricInfo, ...], tuple[LeftOut, ...]]:
        """Returns what was measured of all pairs, of which metrics, and what was left out."""
        measured: Measured = {}
        for metric in self._metrics:
            for key, parts in self._values[metric.name].items():
                measured[key] = np.concatenate(parts)
        infos = []
        for metric in self._metrics:
            infos.append(info_of(metric, self._scopes, judges=metric.name == self._judge))
        return measured, tuple(infos), tuple(self._left_out)


@torch.no_grad()
def _values(
    metric: Installed[Metric], scopes: Mapping[str, Mapping[str, Trajectories]]
) -> Measured:
    measured: Measured = {}
    for scope, by_method in scopes.items():
        for method, trajectories in by_method.items():
            if method == RECORDED and (scope != "test" or not metric.component.is_of_recording):
                continue
            values = metric.component.compute(trajectories)
            if values.shape != (len(trajectories),):
                raise ValueError(f"compute gives the shape {tuple(values.shape)}, not (pairs,)")
            # Where no frame counts nothing is defined, a count of zero neither.
            some = trajectories.counted.any(1)
            measured[metric.name, scope, method] = array(torch.where(some, values, torch.nan))
    return measured


def _improvements(
    values: pd.DataFrame, judge: str, scope: str, drivers: Sequence[str]
) -> dict[str, Improvement]:
    """Returns the policy's improvement over every other method; empty if it was not simulated."""
    errors = values_of(values, judge, scope)
    if "policy" not in errors:
        return {}
    policy = errors["policy"].to_numpy()
    if scope == "steady" and not np.isfinite(policy).any():
        return {}
    improvements = {}
    for method in METHODS:
        if method in errors and method != "policy":
            before = errors[method].to_numpy()
            improvements[method] = improvement_statistics(before, policy, drivers)
    return improvements


def _about(tested: ComparedPairs, measures: _Measures, names: Sequence[str]) -> pd.DataFrame:
    """Returns a row per pair and method: who drives, the cluster and the mean parameters."""
    pairs = tested.pairs
    by_driver = tested.style.table.set_index("driver")
    methods = list(measures.parameters)
    drivers = pairs.drivers
    clusters = by_driver["cluster"].loc[drivers].map(dict(enumerate(CLUSTERS)))
    folds = np.zeros(len(pairs), np.int64) if tested.fold is None else tested.fold.numpy()
    of_pair = {
        "pair_id": pairs.ids,
        "recording": of_each(pairs, "recording"),
        "leader_id": of_each(pairs, "leader_id"),
        "follower_id": of_each(pairs, "follower_id"),
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
