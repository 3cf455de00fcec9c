"""The rollout: one driving model along recorded leaders, for any number of followers at once.

Each step is `cfx.simulation.step.advance_vehicle`: forward Euler, and the model sees the leader
**at t**. This module says in which order, layout and precision steps are taken, and when they are
compiled.

Shapes: public tensors are `(*batch, time)`. Inside, time comes first, so that each step reads
contiguous memory, and leaders broadcast: a leader `(pairs, 1)` drives ahead of followers `(pairs,
candidates)` without a copy.
"""

from __future__ import annotations

import copy
import importlib.util
import itertools
import math
import sysconfig
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from cfx.core.component import Settings, folder_hash
from cfx.core.guest import same_environment
from cfx.core.threads import one_thread
from cfx.errors import ParameterError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.simulation.base import Simulator, SimulatorSettings, Stepper
from cfx.simulation.kernel import run as kernel
from cfx.simulation.kernel.compiler import find_compiler, torch_compiled
from cfx.simulation.step import advance_vehicle
from cfx.simulation.trajectory import (
    ComponentKey,
    Segments,
    Start,
    Terms,
    Trajectory,
    common_shape,
)

Compile = Literal["auto", "always", "never"]
_Parameters = dict[str, Tensor]
_Step = Callable[[Follower, Leader, _Parameters], tuple[Follower, Tensor, Tensor]]

_STEPS_OF_CALL = 5
"""Steps that one compiled call takes: a window of the paper. State and parameters stay in registers
meanwhile; more steps were not faster and take long to compile.
"""

_WORTH_COMPILING = 20_000_000
"""Vehicle steps in one call, or in calls that belong together (`for_work`), from which compiling
pays: about a second of eager work. The rule looks at these alone, so that the same call gives the
same bits whatever came before it.
"""

_ROUNDING = 1e-6
"""Share of a range by which rounding may put a value beyond its bound."""

_WORTH_A_KERNEL = 1_000_000
"""Vehicle steps in one call, or in calls that belong together, from which a kernel pays."""


class MemoryStepper(Stepper):
    """Advances followers of one model at one time step.

    Compiles the model's step once that pays (`compile="auto"`), where a compiler is found; runs it
    eagerly otherwise and whenever gradients are wanted. Both give the same numbers to the last few
    bits. A stepper has no state: compiled code is kept for the process, and steppers of equal
    models share it.
    """

    differentiable: ClassVar[bool] = True

    def __init__(self, model: DrivingModel, dt: float, *, compile: Compile = "auto") -> None:
        super().__init__(model, dt)
        self._mode: Compile = compile
        self._together = 0  # vehicle steps of calls that belong together

    def identity(self) -> str:
        return folder_hash(__file__) + folder_hash(kernel.__file__)

    def for_work(self, steps: int) -> MemoryStepper:
        stepper = copy.copy(self)
        stepper._together = max(steps, self._together)  # noqa: SLF001 - a copy of itself
        return stepper

    def advance(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]
    ) -> tuple[Follower, Tensor, Tensor]:
        steps, batch = len(leader.position), follower.speed.shape
        if steps == 0:
            nothing = follower.speed.new_empty((0, *batch))
            return follower, nothing, nothing
        eager = _stepper(self.model, self.dt, steps)
        inputs = (*follower, *leader, *p.values())
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
            return eager(follower, leader, dict(p))
        with torch.no_grad():
            compiled = self._compiles(steps, follower.speed)
            size = shard_size(follower.speed)
            if not compiled and follower.speed.numel() <= size:
                return eager(follower, leader, dict(p))
            return self._in_shards(follower, leader, p, size, compiled=compiled)

    def for_model(self, model: DrivingModel) -> MemoryStepper:
        stepper = copy.copy(self)
        stepper.model = model
        return stepper

    def _in_shards(
        self,
        follower: Follower,
        leader: Leader,
        p: Mapping[str, Tensor],
        size: int,
        *,
        compiled: bool,
    ) -> tuple[Follower, Tensor, Tensor]:
        """As `advance`, a shard of at most `size` followers after the other.

        A compiled call takes `_STEPS_OF_CALL` steps; those left over are taken one by one.
        """
        steps, batch = len(leader.position), follower.speed.shape
        new = follower.speed.new_empty
        end = Follower(
            new(batch),
            new(batch),
            new(batch),
            follower.memory.new_empty((*batch, follower.memory.shape[-1])),
        )
        position, speed = new((steps, *batch)), new((steps, *batch))
        in_calls = steps - steps % _STEPS_OF_CALL
        with one_thread():
            for shard in shards(batch, size):
                last, parameters = shard.follower(follower), shard.parameters(p)
                position_rows, speed_rows = shard.rows(position), shard.rows(speed)
                cuts, make = [0, steps], _stepper
                if compiled and len(shard) > 1:
                    cuts = [*range(0, in_calls, _STEPS_OF_CALL), *range(in_calls, steps + 1)]
                    make = _compiled_stepper
                for first, until in itertools.pairwise(cuts):
                    take = make(self.model, self.dt, until - first)
                    ahead = shard.leader(leader, first, until)
                    last, positions, speeds = take(last, ahead, parameters)
                    position_rows[first:until].copy_(positions.view(-1, *shard.shape))
                    speed_rows[first:until].copy_(speeds.view(-1, *shard.shape))
                shard.write(end, last)
        return end, position, speed

    def accumulates(self, p: Mapping[str, Tensor], terms: Terms) -> bool:
        if self._mode == "never" or next(iter(p.values())).device.type != "cpu":
            return False
        return kernel.exists(self.model, self.dt, p, terms)

    def accumulate(
        self,
        segments: Segments,
        p: Mapping[str, Tensor],
        terms: Terms,
        every: int | None = None,
        gain: Tensor | None = None,
    ) -> tuple[Tensor, ...] | None:
        candidates = 1
        for value in p.values():
            candidates = max(candidates, math.prod(value.shape[1:]))
        steps = segments.counted.numel() * candidates
        if segments.speed.device.type != "cpu" or not self._pays(steps, _WORTH_A_KERNEL):
            return None
        return kernel.accumulate(self.model, self.dt, segments, p, terms, every, gain)

    def _compiles(self, steps: int, speed: Tensor) -> bool:
        return self._pays(steps * speed.numel(), _WORTH_COMPILING) and can_compile(speed.device)

    def _pays(self, steps: int, worth: int) -> bool:
        work = max(steps, self._together)
        return self._mode == "always" or (self._mode == "auto" and work >= worth)


class MemorySettings(SimulatorSettings):
    """Settings of `memory`."""

    compile: Compile = Field("auto", description="compile the model's step: auto: where it pays")


class MemorySimulator(Simulator):
    """The model's own equations take the steps, for all followers at once."""

    differentiable = True
    schema: ClassVar[type[Settings]] = MemorySettings
    settings: MemorySettings

    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        self.require(model)
        return MemoryStepper(model, dt, compile=self.settings.compile)


def _stepper(model: DrivingModel, dt: float, steps: int) -> _Step:
    """Returns the function that takes some steps: `advance` without its layout."""

    def take(follower: Follower, leader: Leader, p: _Parameters) -> tuple[Follower, Tensor, Tensor]:
        positions, speeds = [], []
        for k in range(steps):
            now = Leader(leader.position[k], leader.speed[k], leader.acceleration[k], leader.length)
            follower = advance_vehicle(model, follower, now, p, dt)
            positions.append(follower.position)
            speeds.append(follower.speed)
        return follower, torch.stack(positions), torch.stack(speeds)

    return take


_COMPILED: dict[tuple[ComponentKey, float, float, int], _Step] = {}


def _compiled_stepper(model: DrivingModel, dt: float, steps: int) -> _Step:
    """Returns `_stepper`, compiled for a number of steps; equal models share it."""
    key = (kernel.model_key(model), float(model.temperature), dt, steps)
    if key not in _COMPILED:
        # Each model and number of steps has a cache of its own: torch counts recompilations per
        # function, and gives up after eight.
        take = _stepper(model, dt, steps)
        _COMPILED[key] = torch_compiled(take, dynamic=True, isolate_recompiles=True)
    return _COMPILED[key]


def can_compile(device: torch.device) -> bool:
    """Says whether `torch.compile` has what it needs here.

    That is a C++ compiler and Python's headers for the CPU, and Triton for CUDA.
    """
    if device.type == "cuda":
        return importlib.util.find_spec("triton") is not None
    if device.type != "cpu":
        return False
    # Debian's Python comes without: they are in python3-dev.
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        return False
    return find_compiler() is not None


@same_environment()
def simulate_follower(
    model: DrivingModel,
    parameters: Tensor | Mapping[str, Tensor | float] | None,
    leader: Leader,
    start: Start,
    dt: float,
    *,
    window: int | None = None,
    compile: Compile = "auto",
    outside: Literal["refuse", "allow"] = "refuse",
) -> Trajectory:
    """Simulates followers behind recorded leaders, as calibration, learning and evaluation do.

    Args:
        model: the driving model.
        parameters: `(*batch, n)` tuned parameters, constant; or `(*batch, windows, n)` with
            `window` given, one set for each `window` steps (the last set is kept if the rollout is
            longer); or a mapping name -> value, the others at their defaults; or None for all
            defaults.
        leader: `(*batch, time)` each, its length `(*batch,)`.
        start: the followers at frame 0, `(*batch,)`.
        dt: time step, s.
        window: steps for which one set of parameters holds.
        compile: `auto` compiles where that pays.
        outside: parameters outside the model's bounds, in which its equations are tested, are
            refused unless this is `allow`.

    The leading dimensions of `parameters`, `leader` and `start` broadcast: a leader `(pairs, 1,
    time)` drives ahead of candidates `(pairs, candidates, n)`.

    Returns:
        Frames 0 to time - 1, `(*batch, time)`.

    Raises:
        ParameterError: the number of parameters or a name does not fit the model, `window` does not
            fit their shape, or a value is outside its bounds.
    """
    if outside == "refuse":
        _check_bounds(model, parameters)
    windows = _windows(model, parameters, start.speed, leader.position.shape[-1] - 1, window)
    shapes = [leader.position.shape[:-1], leader.length.shape]
    for state in start:
        shapes.append(state.shape)
    for _, _, p in windows:
        for value in p.values():
            shapes.append(value.shape)
    batch = common_shape(shapes)
    stepper = MemoryStepper(model, dt, compile=compile)
    begin = Start(*(state.expand(batch) for state in start))
    follower = stepper.begin(begin)
    # (*batch, time) -> (time, *batch): a step reads contiguous memory.
    x = leader.position.movedim(-1, 0).contiguous()
    v = leader.speed.movedim(-1, 0).contiguous()
    a = leader.acceleration.movedim(-1, 0).contiguous()
    positions, speeds = [follower.position[None]], [follower.speed[None]]
    for first, last, p in windows:
        ahead = Leader(x[first:last], v[first:last], a[first:last], leader.length)
        follower, position, speed = stepper.advance(follower, ahead, p)
        positions.append(position)
        speeds.append(speed)
    position = torch.cat(positions).movedim(0, -1)
    gap = leader.position - leader.length[..., None] - position
    return Trajectory(position, torch.cat(speeds).movedim(0, -1), gap, gap < 0)


def _check_bounds(
    model: DrivingModel, parameters: Tensor | Mapping[str, Tensor | float] | None
) -> None:
    """Raises ParameterError for a value outside the bounds, those of adaptation where wider."""
    if parameters is None:
        return
    by_name: Mapping[str, Tensor | float]
    if isinstance(parameters, Tensor):
        if parameters.shape[-1] != len(model.space):
            return  # what is wrong with the shape is said where it is read
        columns = model.space.unpack(parameters)
        by_name = {name: columns[name] for name in model.space.names}
    else:
        by_name = parameters
    for name, value in by_name.items():
        calibrated, adapted = model.space[name], model.adaptation_space[name]
        low, high = min(calibrated.low, adapted.low), max(calibrated.high, adapted.high)
        values = torch.as_tensor(value)
        room = _ROUNDING * (high - low)
        wrong = (values < low - room) | (values > high + room)
        if bool(wrong.any()):
            first = float(values[wrong].flatten()[0])
            raise ParameterError(
                f"{name}={first:g} is outside its bounds, {low:g} to {high:g}"
                f" {calibrated.unit}; give a value within"
            )


def _windows(
    model: DrivingModel,
    parameters: Tensor | Mapping[str, Tensor | float] | None,
    speed: Tensor,
    steps: int,
    window: int | None,
) -> list[tuple[int, int, _Parameters]]:
    """Returns (first step, last step, parameters by name) of each stretch with constant ones.

    Numbers get the dtype and the device of `speed`.
    """
    space = model.space
    if not isinstance(parameters, Tensor):
        values: dict[str, Tensor | float] = {}
        for parameter in space:
            values[parameter.name] = parameter.default
        values.update(parameters or {})
        named = {}
        for name, value in values.items():
            parameter = space[name]  # raises where there is no such parameter
            named[parameter.name] = torch.as_tensor(value, dtype=speed.dtype, device=speed.device)
        return [(0, steps, named)]
    if window is None:
        return [(0, steps, space.unpack(_columns(parameters)))]
    if window < 1 or parameters.dim() < 2:
        raise ParameterError(
            f"window={window}: parameters per window need a window of at least one step and shape"
            " (*batch, windows, n)"
        )
    count = parameters.shape[-2]
    if count == 0:
        raise ParameterError("parameters per window: got no window")
    cuts = [*range(0, min(steps, count * window), window)]
    ends = [*cuts[1:], steps]
    columns = _columns(parameters)
    windows = []
    for k, (first, last) in enumerate(zip(cuts, ends, strict=True)):
        windows.append((first, last, space.unpack(columns[..., k, :])))
    return windows


def _columns(parameters: Tensor) -> Tensor:
    """Returns the same tensor with each parameter contiguous in memory, as a step reads them."""
    return parameters.movedim(-1, 0).contiguous().movedim(0, -1)


_SHARD_BYTES = 1 << 17
"""What one shard of followers takes for each value. A shard does all its steps before the next
begins, so that the twenty or so values that a model reads and writes stay in the cache; otherwise
memory sets the speed. Shards run on one thread: two would wait for each other after every small
operation, thirty times as long where another program wants the core.
"""


class Shard:
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
        """Returns the shard of a contiguous `(time, *batch)` as a view `(time, rows, columns)`."""
        return full.view(len(full), *self._grid)[:, self._rows, self._columns]

    def follower(self, follower: Follower) -> Follower:
        """Returns the shard's followers, each state `(n,)`."""
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
        """Returns the shard's leaders at frames `first` to `last - 1`, `(time, n)`."""
        return Leader(
            self._flat_frames(leader.position[first:last]),
            self._flat_frames(leader.speed[first:last]),
            self._flat_frames(leader.acceleration[first:last]),
            self._flat(leader.length),
        )

    def parameters(self, p: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the shard's parameters, `(n,)` each.

        Constants stay 0-dimensional: they cost no memory traffic.
        """
        flat = {}
        for name, value in p.items():
            if value.dim() == 0:
                flat[name] = value.clone()
            else:
                flat[name] = self._flat(value)
        return flat

    def write(self, end: Follower, last: Follower) -> None:
        """Writes the shard's last state into the full batch's."""
        self._write_state(end.position, last.position)
        self._write_state(end.speed, last.speed)
        self._write_state(end.acceleration, last.acceleration)
        width = end.memory.shape[-1]
        end.memory.view(*self._grid, width)[self._rows, self._columns].copy_(
            last.memory.view(*self.shape, width)
        )

    def _write_state(self, full: Tensor, of_shard: Tensor) -> None:
        self.rows(full[None])[0].copy_(of_shard.view(self.shape))

    def _flat(self, value: Tensor) -> Tensor:
        return self._copy(value.expand(self._batch).reshape(self._grid))

    def _flat_frames(self, signal: Tensor) -> Tensor:
        frames = len(signal)
        missing = (1,) * (len(self._batch) - signal.dim() + 1)
        full = signal.reshape(frames, *missing, *signal.shape[1:]).expand(frames, *self._batch)
        return self._copy(full.reshape(frames, *self._grid))

    def _copy(self, grid: Tensor) -> Tensor:
        """Copies the shard out of `(*time, all rows, all columns)` into a new `(*time, n)`."""
        time = grid.shape[:-2]
        copy = grid.new_empty((*time, len(self)))
        copy.view(*time, *self.shape).copy_(grid[..., self._rows, self._columns])
        return copy


def shard_size(speed: Tensor) -> int:
    """Returns how many followers one shard holds; on an accelerator, all."""
    if speed.device.type != "cpu":
        return max(1, speed.numel())
    return _SHARD_BYTES // speed.element_size()


def shards(batch: torch.Size, size: int) -> Iterator[Shard]:
    """Cuts a batch into shards of at most `size` followers: whole rows, or a stretch of one."""
    rows, columns = _grid(batch)
    width = min(size, columns)
    height = 1
    if width == columns:
        height = max(1, size // max(1, width))
    for top in range(0, rows, height):
        rows_of_shard = slice(top, min(top + height, rows))
        for left in range(0, columns, width):
            yield Shard(batch, rows_of_shard, slice(left, min(left + width, columns)))


def _grid(batch: torch.Size) -> tuple[int, int]:
    """Returns the numbers of rows and columns as which a batch is seen."""
    if not batch:
        return 1, 1
    return batch[:-1].numel(), batch[-1]
