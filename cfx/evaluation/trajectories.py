"""Closed loops beside the recording: tensors for metrics, single pairs for tables and figures.

Shapes: P pairs, K + 1 frames, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfx.core import scratch
from cfx.core.memory import give_back
from cfx.core.parameters import ParameterSpace
from cfx.data.pairs import PairBatch, PairSet
from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.metrics.base import RECORDED, Trajectories
from cfx.evaluation.result import Array, PairTrajectory

PAIRS_AT_ONCE = 1024
"""Pairs that are measured together."""


def parts_of(pairs: int) -> Iterator[slice]:
    """Yields the rows of some pairs, then of the next.

    Between two of them memory goes back to the system: what is kept of each part, small arrays,
    lies between large ones that are free by then.
    """
    for start in range(0, pairs, PAIRS_AT_ONCE):
        yield slice(start, min(start + PAIRS_AT_ONCE, pairs))
        scratch.release()
        if pairs > PAIRS_AT_ONCE:
            give_back()


def trajectories_of(
    batch: PairBatch,
    first: Tensor,
    loops: Mapping[str, ClosedLoop],
    spaces: Mapping[str, ParameterSpace],
) -> dict[str, Trajectories]:
    """Returns closed loops, and the recorded drivers (`real`), beside the recording.

    Args:
        batch: P pairs.
        first: `(P,)`, the frame of the recording at which each closed loop begins.
        loops: of each method.
        spaces: for each method the bounds within which its parameters were chosen.
    """
    found = {}
    for method, loop in loops.items():
        found[method] = beside_recording(batch, first, loop, spaces[method])
    of_any = next(iter(found.values()))
    found[RECORDED] = replace(
        of_any,
        speed=of_any.measured_speed,
        gap=of_any.measured_gap,
        parameters=torch.full_like(of_any.parameters, torch.nan),
        at_limits=None,
        outside=None,
    )
    return found


def beside_recording(
    batch: PairBatch, first: Tensor, loop: ClosedLoop, space: ParameterSpace
) -> Trajectories:
    """Returns closed loops of P pairs, which begin at frames `first` `(P,)` of the recording."""
    index = _frames(batch, first, loop.counted.shape[1])
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


def _frames(batch: PairBatch, first: Tensor, count: int) -> Tensor:
    """Returns the frames of the recording from frames `first` `(P,)` on, `(P, count)`."""
    frames = first[:, None] + torch.arange(count, device=first.device)
    return frames.clamp(max=batch.mask.shape[1] - 1)


def simulated_pairs(
    pairs: PairSet, batch: PairBatch, first: Tensor, loops: Mapping[str, ClosedLoop]
) -> Sequence[PairTrajectory]:
    """Returns the test part of each pair; of many pairs, each is made when it is asked for.

    Args:
        pairs, batch, first, loops: as for `SimulatedPairs`.
    """
    found = SimulatedPairs(pairs, batch, first, loops)
    if len(pairs) > PAIRS_AT_ONCE:
        return found
    return tuple(found)


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
            scratch.release()
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
