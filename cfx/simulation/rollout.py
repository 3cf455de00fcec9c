"""The rollout: one driving model along recorded leaders, for any number of followers at once.

Every step is `cfx.simulation.step.advance_vehicle`; the model sees the leader **at t**.

Shapes: public tensors are `(*batch, time)`. Inside, time comes first, so that each step reads contiguous memory, and
leaders broadcast: a leader `(pairs, 1)` drives ahead of followers `(pairs, candidates)` without a copy.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cfx.component import folder_hash
from cfx.errors import ParameterError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.simulation.base import Stepper
from cfx.simulation.step import advance_vehicle
from cfx.simulation.threads import one_thread
from cfx.simulation.trajectory import Start as Start  # noqa: PLC0414 - earlier home
from cfx.simulation.trajectory import Trajectory as Trajectory  # noqa: PLC0414 - earlier home

Compile = Literal["auto", "always", "never"]
_Parameters = dict[str, Tensor]
_Step = Callable[[Follower, Leader, _Parameters], tuple[Follower, Tensor, Tensor]]

_BLOCK = 5
"""Steps that one compiled call takes: a window of the paper. State and parameters stay in registers meanwhile; longer blocks
were not faster and take long to compile."""

_WORTH_COMPILING = 20_000_000
"""Vehicle steps in one call, or in calls that belong together (`for_work`), from which compiling pays: about a second of eager
work. The rule looks at these alone, so that the same call gives the same bits whatever came before it."""

_TILE_BYTES = 1 << 17
"""What one tile of followers takes for each value. A tile does all its steps before the next begins, so that the twenty or so
values that a model reads and writes stay in the cache; otherwise memory sets the speed. Tiles run on one thread: two would wait
for each other after every small operation, thirty times as long where another program wants the core."""


class MemoryStepper(Stepper):
    """Advances followers of one model at one time step.

    Compiles the model's step once that pays (`compile="auto"`), where a compiler is found; runs it eagerly otherwise and
    whenever gradients are wanted. Both give the same numbers to the last few bits. A simulator has no state: compiled code
    is kept for the process, and simulators of equal models share it.
    """

    differentiable: ClassVar[bool] = True

    def __init__(self, model: DrivingModel, dt: float, *, compile: Compile = "auto") -> None:
        super().__init__(model, dt)
        self._mode: Compile = compile

    def identity(self) -> str:
        return folder_hash(__file__)

    def for_work(self, steps: int) -> MemoryStepper:
        return MemoryStepper(self.model, self.dt, compile="always") if self._pays(steps) else self

    def advance(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]
    ) -> tuple[Follower, Tensor, Tensor]:
        steps, batch = len(leader.position), follower.speed.shape
        if steps == 0:
            nothing = follower.speed.new_empty((0, *batch))
            return follower, nothing, nothing
        eager = _stepper(self.model, self.dt)
        if torch.is_grad_enabled() and any(
            tensor.requires_grad for tensor in (*follower, *leader, *p.values())
        ):
            return eager(follower, leader, dict(p))
        with torch.no_grad():
            compiled = self._compiles(steps, follower.speed)
            size = _tile_size(follower.speed)
            if not compiled and follower.speed.numel() <= size:
                return eager(follower, leader, dict(p))
            end = Follower(
                *(
                    torch.empty_like(state, memory_format=torch.contiguous_format)
                    for state in follower
                )
            )
            position, speed = (follower.speed.new_empty((steps, *batch)) for _ in range(2))
            with one_thread():
                for tile in _tiles(batch, size):
                    drive = (
                        self._compiled_drive if compiled and len(tile) > 1 else self._eager_drive
                    )
                    tile.put(
                        end,
                        drive(
                            tile,
                            follower,
                            leader,
                            tile.parameters(p),
                            tile.rows(position),
                            tile.rows(speed),
                        ),
                    )
        return end, position, speed

    def _compiles(self, steps: int, like: Tensor) -> bool:
        return self._pays(steps * like.numel()) and can_compile(like.device)

    def _pays(self, steps: int) -> bool:
        return self._mode == "always" or (self._mode == "auto" and steps >= _WORTH_COMPILING)

    def _eager_drive(
        self,
        tile: _Tile,
        follower: Follower,
        leader: Leader,
        p: _Parameters,
        position: Tensor,
        speed: Tensor,
    ) -> Follower:
        """Takes all steps of one tile; writes positions and speeds `(time, rows, columns)`."""
        last, at, fast = _stepper(self.model, self.dt)(
            tile.follower(follower), tile.leader(leader, 0, len(position)), p
        )
        position.copy_(at.view_as(position))
        speed.copy_(fast.view_as(speed))
        return last

    def _compiled_drive(
        self,
        tile: _Tile,
        follower: Follower,
        leader: Leader,
        p: _Parameters,
        position: Tensor,
        speed: Tensor,
    ) -> Follower:
        """As `_eager_drive`, in compiled blocks; what is left over goes step by step."""
        steps = len(position)
        cuts = [
            *range(0, steps - steps % _BLOCK, _BLOCK),
            *range(steps - steps % _BLOCK, steps + 1),
        ]
        current = tile.follower(follower)
        for first, last in itertools.pairwise(cuts):
            take = _compiled_stepper(self.model, self.dt, last - first)
            current, at, fast = take(current, tile.leader(leader, first, last), p)
            position[first:last].copy_(at.view(-1, *tile.shape))
            speed[first:last].copy_(fast.view(-1, *tile.shape))
        return current


def _stepper(model: DrivingModel, dt: float) -> _Step:
    """Returns the function that takes all steps of a leader's frames; `advance` without its layout."""

    def take(follower: Follower, leader: Leader, p: _Parameters) -> tuple[Follower, Tensor, Tensor]:
        positions, speeds = [], []
        for k in range(leader.position.shape[0]):
            now = Leader(leader.position[k], leader.speed[k], leader.acceleration[k], leader.length)
            follower = advance_vehicle(model, follower, now, p, dt)
            positions.append(follower.position)
            speeds.append(follower.speed)
        return follower, torch.stack(positions), torch.stack(speeds)

    return take


_COMPILED: dict[tuple[type[DrivingModel], str, float, float, int], _Step] = {}


def _compiled_stepper(model: DrivingModel, dt: float, steps: int) -> _Step:
    """Returns `_stepper`, compiled for a number of steps; equal models share it."""
    key = (
        type(model),
        model.settings.model_dump_json(exclude={"parameters"}),
        float(model.temperature),
        dt,
        steps,
    )
    if key not in _COMPILED:
        # Each model and block has a cache of its own: torch counts recompilations per function, and gives up after eight.
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # torch's own, about itself, as it imports its compiler
            _COMPILED[key] = torch.compile(  # type: ignore[call-overload]  # torch's overloads leave isolate_recompiles out
                _stepper(model, dt), dynamic=True, isolate_recompiles=True
            )
    return _COMPILED[key]


def can_compile(device: torch.device) -> bool:
    """Says whether `torch.compile` has what it needs here: a C++ compiler for the CPU, Triton for CUDA."""
    if device.type == "cuda":
        return importlib.util.find_spec("triton") is not None
    return device.type == "cpu" and any(shutil.which(name) for name in ("g++", "clang++", "c++"))


class _Tile:
    """A rectangle of a batch that is seen as rows and columns, `(prod(batch[:-1]), batch[-1])`.

    What goes into a step is copied into new one-dimensional tensors (`(time, n)` for the leader), whatever the caller's batch
    looks like: the compiler makes other code for other strides, offsets and views, and this way all batches share one. The
    copies stay in the cache.
    """

    def __init__(self, batch: torch.Size, rows: slice, columns: slice) -> None:
        self._batch = batch
        self._grid = (batch[:-1].numel(), batch[-1]) if batch else (1, 1)
        self._rows, self._columns = rows, columns
        self.shape = (rows.stop - rows.start, columns.stop - columns.start)

    def __len__(self) -> int:
        """The number of followers, n."""
        return math.prod(self.shape)

    def rows(self, whole: Tensor) -> Tensor:
        """Returns the tile of a contiguous `(time, *batch)` as a view `(time, rows, columns)`."""
        return whole.view(len(whole), *self._grid)[:, self._rows, self._columns]

    def follower(self, follower: Follower) -> Follower:
        position, speed, acceleration = (self._flat(state) for state in follower[:3])
        width = follower.memory.shape[-1]
        memory = follower.memory.new_empty((len(self), width))
        memory.view(*self.shape, width).copy_(
            follower.memory.reshape(*self._grid, width)[self._rows, self._columns]
        )
        return Follower(position, speed, acceleration, memory)

    def leader(self, leader: Leader, first: int, last: int) -> Leader:
        position, speed, acceleration = (
            self._flat_frames(signal[first:last]) for signal in leader[:3]
        )
        return Leader(position, speed, acceleration, self._flat(leader.length))

    def parameters(self, p: Mapping[str, Tensor]) -> _Parameters:
        """Constants stay 0-dimensional: they cost no memory traffic."""
        return {
            name: value.clone() if value.dim() == 0 else self._flat(value)
            for name, value in p.items()
        }

    def put(self, end: Follower, last: Follower) -> None:
        """Writes the tile's last state into the whole batch's."""
        for whole, part in zip(end[:3], last[:3], strict=True):
            self.rows(whole[None])[0].copy_(part.view(self.shape))
        width = end.memory.shape[-1]
        end.memory.view(*self._grid, width)[self._rows, self._columns].copy_(
            last.memory.view(*self.shape, width)
        )

    def _flat(self, value: Tensor) -> Tensor:
        return self._copy(value.expand(self._batch).reshape(self._grid))

    def _flat_frames(self, signal: Tensor) -> Tensor:
        frames = len(signal)
        missing = (1,) * (len(self._batch) - signal.dim() + 1)
        whole = signal.reshape(frames, *missing, *signal.shape[1:]).expand(frames, *self._batch)
        return self._copy(whole.reshape(frames, *self._grid))

    def _copy(self, grid: Tensor) -> Tensor:
        """Copies the tile out of `(*time, all rows, all columns)` into a new `(*time, n)`."""
        time = grid.shape[:-2]
        copy = grid.new_empty((*time, len(self)))
        copy.view(*time, *self.shape).copy_(grid[..., self._rows, self._columns])
        return copy


def _tile_size(like: Tensor) -> int:
    """Returns how many followers one tile holds; on an accelerator, all."""
    if like.device.type != "cpu":
        return max(1, like.numel())
    return _TILE_BYTES // like.element_size()


def _tiles(batch: torch.Size, size: int) -> Iterator[_Tile]:
    """Cuts a batch into tiles of at most `size` followers: whole rows, or parts of one."""
    rows, columns = (batch[:-1].numel(), batch[-1]) if batch else (1, 1)
    width = min(size, columns)
    height = max(1, size // max(1, width)) if width == columns else 1
    for top in range(0, rows, height):
        for left in range(0, columns, width):
            yield _Tile(
                batch, slice(top, min(top + height, rows)), slice(left, min(left + width, columns))
            )


def _frames(leader: Leader, first: int, last: int) -> Leader:
    return Leader(
        leader.position[first:last],
        leader.speed[first:last],
        leader.acceleration[first:last],
        leader.length,
    )


def simulate(
    model: DrivingModel,
    parameters: Tensor | Mapping[str, Tensor | float] | None,
    leader: Leader,
    start: Start,
    dt: float,
    *,
    window: int | None = None,
    compile: Compile = "auto",
) -> Trajectory:
    """Drives followers behind recorded leaders: the batched rollout that calibration, learning and evaluation use.

    Args:
        model: the driving model.
        parameters: `(*batch, n)` tuned parameters, constant; or `(*batch, windows, n)` with `window` given, one set for each
            `window` steps (the last set is kept if the drive is longer); or a mapping name -> value, the others at their
            defaults; or None for all defaults.
        leader: `(*batch, time)` each, its length `(*batch,)`.
        start: the followers at frame 0, `(*batch,)`.
        dt: time step, s.
        window: steps for which one set of parameters holds.
        compile: `auto` compiles where that pays.

    The leading dimensions of `parameters`, `leader` and `start` broadcast: a leader `(pairs, 1, time)` drives ahead of
    candidates `(pairs, candidates, n)`.

    Returns:
        Frames 0 to time - 1, `(*batch, time)`.

    Raises:
        ParameterError: the number of parameters or a name does not fit the model, or `window` does not fit their shape. Values
            outside the bounds are simulated as they are.
    """
    windows = _windows(model, parameters, start.speed, leader.position.shape[-1] - 1, window)
    shapes = [leader.position.shape[:-1], leader.length.shape, *(state.shape for state in start)]
    shapes += [value.shape for _, _, p in windows for value in p.values()]
    batch = torch.broadcast_shapes(*shapes)  # type: ignore[no-untyped-call]  # torch leaves it untyped
    stepper = MemoryStepper(model, dt, compile=compile)
    follower = stepper.begin(Start(*(state.expand(batch) for state in start)))
    in_time = Leader(
        _time_first(leader.position),
        _time_first(leader.speed),
        _time_first(leader.acceleration),
        leader.length,
    )
    positions, speeds = [follower.position[None]], [follower.speed[None]]
    for first, last, p in windows:
        follower, position, speed = stepper.advance(follower, _frames(in_time, first, last), p)
        positions.append(position)
        speeds.append(speed)
    position = torch.cat(positions).movedim(0, -1)
    gap = leader.position - leader.length[..., None] - position
    return Trajectory(position, torch.cat(speeds).movedim(0, -1), gap, gap < 0)


def _time_first(signal: Tensor) -> Tensor:
    return signal.movedim(-1, 0).contiguous()


def _windows(
    model: DrivingModel,
    parameters: Tensor | Mapping[str, Tensor | float] | None,
    like: Tensor,
    steps: int,
    window: int | None,
) -> list[tuple[int, int, _Parameters]]:
    """Returns (first step, last step, parameters by name) of each stretch with constant parameters."""
    space = model.space
    if not isinstance(parameters, Tensor):
        given = dict(parameters or {})
        for name in given:
            space[name]
        named = {
            p.name: torch.as_tensor(
                given.get(p.name, p.default), dtype=like.dtype, device=like.device
            )
            for p in space
        }
        return [(0, steps, named)]
    if window is None:
        return [(0, steps, space.unpack(_columns(parameters)))]
    if window < 1 or parameters.dim() < 2:
        raise ParameterError(
            f"window={window}: parameters per window need a window of at least one step and shape (*batch, windows, n)"
        )
    count = parameters.shape[-2]
    if count == 0:
        raise ParameterError("parameters per window: got no window")
    cuts = [*range(0, min(steps, count * window), window)]
    ends = [*cuts[1:], steps]
    columns = _columns(parameters)
    return [
        (a, b, space.unpack(columns[..., k, :]))
        for k, (a, b) in enumerate(zip(cuts, ends, strict=True))
    ]


def _columns(parameters: Tensor) -> Tensor:
    """Returns the same tensor with each parameter contiguous in memory, as a step reads them."""
    return parameters.movedim(-1, 0).contiguous().movedim(0, -1)


Simulator = MemoryStepper
