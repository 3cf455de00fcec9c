"""Closed loops of many pairs, some at a time: in this process or wherever the job's engine works.

Shapes: P pairs, K simulated frames of the longest.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.core import scratch
from cfx.core.engine import Engine, Report
from cfx.core.memory import give_back
from cfx.evaluation.closed_loop import ClosedLoop, Followers, simulate_closed_loop
from cfx.policies.agent import Agent, TrainedOn
from cfx.simulation.base import Stepper

PAIRS_AT_ONCE = 1024
"""Pairs that are simulated together: enough for batches, few enough for a worker's memory."""


_TENSORS = 12
"""Tensors as large as these that an evaluation holds at once: several methods, several of each."""


@dataclass(frozen=True)
class ClosedLoopShard:
    """Some pairs, and what drives them: the arguments of `simulate_closed_loop`."""

    simulator: Stepper
    agent: Agent
    followers: Followers
    first: Tensor


def simulate_shard(shard: ClosedLoopShard, report: Report) -> ClosedLoop:
    """Simulates the pairs of a shard, wherever it is."""
    found = simulate_closed_loop(shard.simulator, shard.agent, shard.followers, shard.first)
    report(len(shard.first))
    return found


def simulate_in_shards(
    engine: Engine,
    simulator: Stepper,
    agent: Agent,
    followers: Followers,
    first: Tensor,
) -> ClosedLoop:
    """Simulates P pairs as `simulate_closed_loop` does, in shards where there are many.

    How pairs are cut follows from their number alone, so that every engine gives the same bits.

    Args:
        engine: where shards are simulated; few pairs are simulated here.
        simulator, agent, followers, first: as for `simulate_closed_loop`.
    """
    # What it has learned from is a long list, and drives nothing.
    agent = replace(agent, trained_on=TrainedOn())
    whole = ClosedLoopShard(simulator, agent, followers, first)
    batch = followers.batch
    if len(batch) <= PAIRS_AT_ONCE:
        return simulate_shard(whole, _nothing)
    joined = _Joined(len(batch), 1 + int((batch.lengths - 1 - first).max()))
    with closing(engine.map(simulate_shard, _cut(whole), _nothing)) as results:
        for number, part in results:
            joined.put(number, part)
    give_back()
    return joined.whole()


def _nothing(_pairs: int) -> None:
    """Progress that nobody is shown: a simulation takes seconds."""


def _cut(whole: ClosedLoopShard) -> Iterator[ClosedLoopShard]:
    """Yields shards that hold copies of their own rows: pickled, a slice is all that it is of."""
    followers = whole.followers
    every = torch.arange(len(whole.first), device=whole.first.device)
    for part in torch.split(every, PAIRS_AT_ONCE):
        agent, network, base = whole.agent, followers.network[part], None
        if len(agent.names) > len(part):
            used, network = torch.unique(network, return_inverse=True)
            agent = agent.only(used)
        if followers.base is not None:
            base = followers.base[part]
        own = None if followers.own is None else followers.own[part]
        some = Followers(followers.batch[part].trimmed(), network, base, followers.history, own)
        yield ClosedLoopShard(whole.simulator, agent, some, whole.first[part])


class _Joined:
    """Closed loops of P pairs, put together from shards in any order.

    Those of many pairs lie in files (`cfx.core.memory`). Frames that a shard has not, because all
    its pairs end before, repeat its last one and do not count, as frames after the end of a pair.

    Args:
        pairs: P.
        columns: K + 1.
    """

    def __init__(self, pairs: int, columns: int) -> None:
        self._shape = (pairs, columns)
        self._tensors: dict[str, Tensor] = {}
        self._beyond: dict[int, Tensor] = {}

    def put(self, number: int, part: ClosedLoop) -> None:
        """Takes the closed loops of a shard."""
        rows = slice(number * PAIRS_AT_ONCE, number * PAIRS_AT_ONCE + len(part.speed))
        for name in ("speed", "gap", "parameters", "counted", "at_limits", "outside"):
            values = getattr(part, name)
            if values is None:
                continue
            if name not in self._tensors:
                self._tensors[name] = self._empty(values)
            target, width = self._tensors[name][rows], values.shape[1]
            target[:, :width] = values
            target[:, width:] = False if values.dtype == torch.bool else values[:, -1:]
        if part.beyond is not None:
            self._beyond[number] = part.beyond
        scratch.release()

    def _empty(self, values: Tensor) -> Tensor:
        """Returns room for values `(pairs, columns, ...)` of all shards, on their device."""
        shape = (*self._shape, *values.shape[2:])
        if values.device.type != "cpu":
            return values.new_empty(shape)
        kind = values.new_empty(0).numpy().dtype
        return torch.as_tensor(scratch.empty(shape, kind, together=_TENSORS))

    def whole(self) -> ClosedLoop:
        """Returns the closed loops of all shards, `(P, K + 1)`."""
        beyond = None
        if self._beyond:
            # In the order of the shards: the sum of floating point numbers depends on it.
            beyond = torch.stack([self._beyond[number] for number in sorted(self._beyond)]).sum(0)
        return ClosedLoop(**self._tensors, beyond=beyond)
