"""Batches of followers in tiles that stay in the processor's cache."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from cfx.models.base import Follower, Leader

_TILE_BYTES = 1 << 17
"""What one tile of followers takes for each value. A tile does all its steps before the next
begins, so that the twenty or so values that a model reads and writes stay in the cache; otherwise
memory sets the speed. Tiles run on one thread: two would wait for each other after every small
operation, thirty times as long where another program wants the core.
"""


class Tile:
    """A rectangle of a batch that is seen as rows and columns, `(prod(batch[:-1]), batch[-1])`.

    What goes into a step is copied into new one-dimensional tensors (`(time, n)` for the leader),
    whatever the caller's batch looks like: the compiler makes other code for other strides, offsets
    and views, and this way all batches share one. The copies stay in the cache.
    """

    def __init__(self, batch: torch.Size, rows: slice, columns: slice) -> None:
        self._batch = batch
        self._grid = _grid(batch)
        self._rows, self._columns = rows, columns
        self.shape = (rows.stop - rows.start, columns.stop - columns.start)

    def __len__(self) -> int:
        """The number of followers, n."""
        return math.prod(self.shape)

    def rows(self, full: Tensor) -> Tensor:
        """Returns the tile of a contiguous `(time, *batch)` as a view `(time, rows, columns)`."""
        return full.view(len(full), *self._grid)[:, self._rows, self._columns]

    def follower(self, follower: Follower) -> Follower:
        """Returns the tile's followers, each state `(n,)`."""
        width = follower.memory.shape[-1]
        memory = follower.memory.new_empty((len(self), width))
        memory.view(*self.shape, width).copy_(
            follower.memory.reshape(*self._grid, width)[self._rows, self._columns]
        )
        return Follower(
            self._flat(follower.position),
            self._flat(follower.speed),
            self._flat(follower.acceleration),
            memory,
        )

    def leader(self, leader: Leader, first: int, last: int) -> Leader:
        """Returns the tile's leaders at frames `first` to `last - 1`, `(time, n)`."""
        return Leader(
            self._flat_frames(leader.position[first:last]),
            self._flat_frames(leader.speed[first:last]),
            self._flat_frames(leader.acceleration[first:last]),
            self._flat(leader.length),
        )

    def parameters(self, p: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the tile's parameters, `(n,)` each.

        Constants stay 0-dimensional: they cost no memory traffic.
        """
        own = {}
        for name, value in p.items():
            own[name] = value.clone() if value.dim() == 0 else self._flat(value)
        return own

    def write(self, end: Follower, last: Follower) -> None:
        """Writes the tile's last state into the full batch's."""
        self._write_state(end.position, last.position)
        self._write_state(end.speed, last.speed)
        self._write_state(end.acceleration, last.acceleration)
        width = end.memory.shape[-1]
        end.memory.view(*self._grid, width)[self._rows, self._columns].copy_(
            last.memory.view(*self.shape, width)
        )

    def _write_state(self, full: Tensor, part: Tensor) -> None:
        self.rows(full[None])[0].copy_(part.view(self.shape))

    def _flat(self, value: Tensor) -> Tensor:
        return self._copy(value.expand(self._batch).reshape(self._grid))

    def _flat_frames(self, signal: Tensor) -> Tensor:
        frames = len(signal)
        missing = (1,) * (len(self._batch) - signal.dim() + 1)
        full = signal.reshape(frames, *missing, *signal.shape[1:]).expand(frames, *self._batch)
        return self._copy(full.reshape(frames, *self._grid))

    def _copy(self, grid: Tensor) -> Tensor:
        """Copies the tile out of `(*time, all rows, all columns)` into a new `(*time, n)`."""
        time = grid.shape[:-2]
        copy = grid.new_empty((*time, len(self)))
        copy.view(*time, *self.shape).copy_(grid[..., self._rows, self._columns])
        return copy


def tile_size(like: Tensor) -> int:
    """Returns how many followers one tile holds; on an accelerator, all."""
    if like.device.type != "cpu":
        return max(1, like.numel())
    return _TILE_BYTES // like.element_size()


def tiles(batch: torch.Size, size: int) -> Iterator[Tile]:
    """Cuts a batch into tiles of at most `size` followers: whole rows, or parts of one."""
    rows, columns = _grid(batch)
    width = min(size, columns)
    height = 1
    if width == columns:
        height = max(1, size // max(1, width))
    for top in range(0, rows, height):
        own_rows = slice(top, min(top + height, rows))
        for left in range(0, columns, width):
            yield Tile(batch, own_rows, slice(left, min(left + width, columns)))


def _grid(batch: torch.Size) -> tuple[int, int]:
    """Returns the numbers of rows and columns as which a batch is seen."""
    if not batch:
        return 1, 1
    return batch[:-1].numel(), batch[-1]
