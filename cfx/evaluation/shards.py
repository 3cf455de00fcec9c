"""Closed loops of many pairs, some at a time: in this process or wherever the job's engine works.

Shapes: P pairs, K simulated frames of the longest.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cfx.agents.agent import Agent
from cfx.engine.base import Engine, Report
from cfx.evaluation.closed_loop import ClosedLoop, simulate_closed_loop
from cfx.pairs import PairBatch
from cfx.simulation.base import Stepper

PAIRS_AT_ONCE = 1024
"""Pairs that are simulated together: enough for batches, few enough for a worker's memory."""


@dataclass(frozen=True)
class ClosedLoopShard:
    """Some pairs, and what drives them: the arguments of `simulate_closed_loop`."""

    simulator: Stepper
    agent: Agent
    batch: PairBatch
    first: Tensor
    network: Tensor
    base: Tensor | None
    history: float | None


def simulate_shard(shard: ClosedLoopShard, report: Report) -> ClosedLoop:
    """Simulates the pairs of a shard, wherever it is."""
    found = simulate_closed_loop(
        shard.simulator,
        shard.agent,
        shard.batch,
        shard.first,
        shard.network,
        base=shard.base,
        history=shard.history,
    )
    report(len(shard.batch))
    return found


def simulate_in_shards(
    engine: Engine,
    simulator: Stepper,
    agent: Agent,
    batch: PairBatch,
    first: Tensor,
    network: Tensor,
    *,
    base: Tensor | None = None,
    history: float | None = None,
) -> ClosedLoop:
    """Simulates P pairs as `simulate_closed_loop` does, in shards where there are many.

    How pairs are cut follows from their number alone, so that every engine gives the same bits.

    Args:
        engine: where shards are simulated; few pairs are simulated here.
        simulator, agent, batch, first, network, base, history: as for `simulate_closed_loop`.
    """
    # Whom it has learned from is a long list, and drives nothing.
    agent = replace(agent, learned_from={})
    whole = ClosedLoopShard(simulator, agent, batch, first, network, base, history)
    if len(batch) <= PAIRS_AT_ONCE:
        return simulate_shard(whole, _nothing)
    found: dict[int, ClosedLoop] = {}
    with closing(engine.map(simulate_shard, _cut(whole), _nothing)) as results:
        found.update(results)
    return _joined([found[number] for number in range(len(found))])


def _nothing(_pairs: int) -> None:
    """Progress that nobody is shown: a simulation takes seconds."""


def _cut(whole: ClosedLoopShard) -> Iterator[ClosedLoopShard]:
    """Yields shards that hold copies of their own rows: pickled, a slice is all that it is of."""
    every = torch.arange(len(whole.batch), device=whole.first.device)
    for part in torch.split(every, PAIRS_AT_ONCE):
        agent, network, base = whole.agent, whole.network[part], None
        if len(agent.names) > len(part):
            used, network = torch.unique(network, return_inverse=True)
            agent = agent.only(used)
        if whole.base is not None:
            base = whole.base[part]
        yield ClosedLoopShard(
            whole.simulator,
            agent,
            whole.batch[part].trimmed(),
            whole.first[part],
            network,
            base,
            whole.history,
        )


def _joined(parts: list[ClosedLoop]) -> ClosedLoop:
    """Returns the closed loops of all shards, `(P, K + 1)`.

    Frames that a shard has not, because all its pairs end before, repeat its last one and do not
    count, as frames after the end of a pair.
    """
    width = max(part.speed.shape[1] for part in parts)
    columns: dict[str, Tensor | None] = {}
    for name in ("speed", "gap", "parameters", "counted", "at_limits", "outside"):
        values = [getattr(part, name) for part in parts]
        columns[name] = None
        if all(value is not None for value in values):
            columns[name] = torch.cat([_widened(value, width) for value in values])
    beyond = None
    if all(part.beyond is not None for part in parts):
        beyond = torch.stack([part.beyond for part in parts if part.beyond is not None]).sum(0)
    return ClosedLoop(**columns, beyond=beyond)  # type: ignore[arg-type]  # speed is never None


def _widened(values: Tensor, width: int) -> Tensor:
    """Returns `(P, width, ...)`: the last column repeated, false where it says yes or no."""
    missing = width - values.shape[1]
    if missing == 0:
        return values
    tail = values[:, -1:].expand(-1, missing, *values.shape[2:])
    if values.dtype == torch.bool:
        tail = torch.zeros_like(tail)
    return torch.cat([values, tail], dim=1)
