"""The rollout: one driving model along recorded leaders, for any number of followers at once.

This is the only place that integrates. Forward Euler, as the paper prints it and SUMO does it by default:
`v' = model(...)`, then `x' = x + v' dt`; the model sees the leader **at t**.

Shapes: public tensors are `(*batch, time)`. Inside, time comes first, so that each step reads contiguous memory, and
leaders broadcast: a leader `(pairs, 1)` drives ahead of followers `(pairs, candidates)` without a copy.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from cfx.errors import ParameterError
from cfx.models.base import DrivingModel, Follower, Leader

Compile = Literal["auto", "always", "never"]

_BLOCK = 5
"""Steps that one compiled call takes: a window of the paper, and enough to hide the call's overhead."""

_WORTH_COMPILING = 20_000_000
"""Vehicle steps in one call from which compiling pays: about two seconds of eager work. The rule looks at the call alone, so that
the same call gives the same bits whatever came before it."""


class Start(NamedTuple):
    """A follower's state when a rollout begins; all tensors `(*batch,)`, SI units."""

    position: Tensor
    speed: Tensor
    acceleration: Tensor


class Trajectory(NamedTuple):
    """What a rollout gives; all tensors `(*batch, time)`, frame 0 being the start.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        gap: bumper to bumper, m; negative from a collision on.
        collided: bool, the gap is negative. A rollout goes on after a collision: nothing is hidden.
    """

    position: Tensor
    speed: Tensor
    gap: Tensor
    collided: Tensor


class Simulator:
    """Advances followers of one model at one time step.

    Compiles the model's step once that pays (`compile="auto"`), where a C++ compiler is found; runs it eagerly otherwise and
    whenever gradients are wanted. Both give the same numbers to the last few bits. Its only state is the compiled function.
    """

    def __init__(self, model: DrivingModel, dt: float, *, compile: Compile = "auto") -> None:
        self.model = model
        self.dt = dt
        self._mode: Compile = compile
        self._compiled: Callable[..., tuple[Tensor, ...]] | None = None

    def begin(self, start: Start) -> Follower:
        """Returns the follower at the start of a rollout."""
        return Follower(*start, self.model.initial_memory(start.speed))

    def advance(self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]) -> tuple[Follower, Tensor, Tensor]:
        """Takes K steps with constant parameters.

        Args:
            follower: state at the first frame, `(*batch,)`.
            leader: frames 0 to K - 1, `(K, *batch)` each (the length without time), broadcasting to the follower's batch.
            p: one tensor per parameter, broadcasting to `(*batch,)`.

        Returns:
            The follower at frame K, and positions and speeds `(K, *batch)` of frames 1 to K.
        """
        steps = len(leader.position)
        take = self._stepper(follower, steps)
        positions, speeds = [], []
        done = 0
        while done < steps:
            size = _BLOCK if steps - done >= _BLOCK else 1
            block = slice(done, done + size)
            out = take(*follower, leader.position[block], leader.speed[block], leader.acceleration[block], leader.length, dict(p))
            follower = Follower(*out[:4])
            positions.append(out[4])
            speeds.append(out[5])
            done += size
        return follower, torch.cat(positions), torch.cat(speeds)

    def _stepper(self, follower: Follower, steps: int) -> Callable[..., tuple[Tensor, ...]]:
        worth_it = self._mode == "always" or (self._mode == "auto" and steps * follower.speed.numel() >= _WORTH_COMPILING)
        if not worth_it or torch.is_grad_enabled() or not can_compile(follower.speed.device):
            return self._take
        if self._compiled is None:
            self._compiled = torch.compile(self._take, dynamic=True)
        return self._compiled

    def _take(
        self,
        position: Tensor,
        speed: Tensor,
        acceleration: Tensor,
        memory: Tensor,
        leader_position: Tensor,
        leader_speed: Tensor,
        leader_acceleration: Tensor,
        leader_length: Tensor,
        p: dict[str, Tensor],
    ) -> tuple[Tensor, ...]:
        follower = Follower(position, speed, acceleration, memory)
        positions, speeds = [], []
        for k in range(leader_position.shape[0]):
            leader = Leader(leader_position[k], leader_speed[k], leader_acceleration[k], leader_length)
            next_speed = self.model.next_speed(follower, leader, p, self.dt)
            next_memory = self.model.next_memory(follower, leader, p, self.dt, next_speed)
            follower = Follower(
                follower.position + next_speed * self.dt, next_speed, (next_speed - follower.speed) / self.dt, next_memory
            )
            positions.append(follower.position)
            speeds.append(next_speed)
        return (*follower, torch.stack(positions), torch.stack(speeds))


def can_compile(device: torch.device) -> bool:
    """Says whether `torch.compile` has what it needs here: a C++ compiler for the CPU, Triton for CUDA."""
    if device.type == "cuda":
        return torch.utils._triton.has_triton()
    return any(shutil.which(name) for name in ("g++", "clang++", "c++"))


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
        leader: `(*batch, time)` each, its length `(*batch,)`; broadcasts over the followers' batch.
        start: the followers at frame 0, `(*batch,)`.
        dt: time step, s.
        window: steps for which one set of parameters holds.

    Returns:
        Frames 0 to time - 1, `(*batch, time)`.

    Raises:
        ParameterError: the number of parameters, a name or a value does not fit the model.
    """
    simulator = Simulator(model, dt, compile=compile)
    follower = simulator.begin(start)
    frames = leader.position.shape[-1]
    windows = _windows(model, parameters, start.speed, frames - 1, window)
    in_time = Leader(_time_first(leader.position), _time_first(leader.speed), _time_first(leader.acceleration), leader.length)
    positions, speeds = [start.position[None]], [start.speed[None]]
    for first, last, p in windows:
        step = slice(first, last)
        ahead = Leader(in_time.position[step], in_time.speed[step], in_time.acceleration[step], leader.length)
        follower, position, speed = simulator.advance(follower, ahead, p)
        positions.append(position)
        speeds.append(speed)
    position = torch.cat([piece.expand(-1, *follower.speed.shape) for piece in positions]).movedim(0, -1)
    speed = torch.cat([piece.expand(-1, *follower.speed.shape) for piece in speeds]).movedim(0, -1)
    gap = leader.position - leader.length[..., None] - position
    return Trajectory(position, speed, gap, gap < 0)


def _time_first(signal: Tensor) -> Tensor:
    return signal.movedim(-1, 0).contiguous()


def _windows(
    model: DrivingModel,
    parameters: Tensor | Mapping[str, Tensor | float] | None,
    like: Tensor,
    steps: int,
    window: int | None,
) -> list[tuple[int, int, dict[str, Tensor]]]:
    """Returns (first step, last step, parameters by name) of each stretch with constant parameters."""
    space = model.space
    if not isinstance(parameters, Tensor):
        given = dict(parameters or {})
        for name in given:
            space[name]
        return [
            (
                0,
                steps,
                {p.name: torch.as_tensor(given.get(p.name, p.default), dtype=like.dtype, device=like.device) for p in space},
            )
        ]
    if window is None:
        return [(0, steps, space.unpack(parameters))]
    if window < 1 or parameters.dim() < 2:
        raise ParameterError(
            f"window={window}: parameters per window need a window of at least one step and shape (*batch, windows, n)"
        )
    count = parameters.shape[-2]
    if count == 0:
        raise ParameterError("parameters per window: got no window")
    cuts = [*range(0, min(steps, count * window), window)]
    ends = [*cuts[1:], steps]
    return [(a, b, space.unpack(parameters[..., k, :])) for k, (a, b) in enumerate(zip(cuts, ends, strict=True))]
