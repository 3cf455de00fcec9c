"""Work in another process, which counts its progress there and hands it over with the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

from cfx.plugin import engine


@dataclass(frozen=True)
class Counted(Generic[engine.ResultT]):
    """A result, and the units of work that it took."""

    result: engine.ResultT
    units: int


def counted(
    work: engine.Work[engine.ShardT, engine.ResultT], shard: engine.ShardT
) -> Counted[engine.ResultT]:
    """Does the work of one shard."""
    units = 0

    def report(more: int) -> None:
        nonlocal units
        units += more

    return Counted(work(shard, report), units)
