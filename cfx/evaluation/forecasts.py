"""Forecasts: followers simulated from many moments of their trajectories.

An *origin* is a moment of a measured trajectory. Everything measured up to it may be read; of what
comes after it the follower is never read, and the leader only where their future is given. From
each origin the follower is simulated for some seconds, all origins in one batch.

Shapes: P pairs, Q origins, K simulated steps, T frames, n tuned parameters. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.data.pairs import PairBatch, PairSet
from cfx.data.signals import RECORDED
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.policies.agent import Agent, AgentState
from cfx.policies.context import DriverContext
from cfx.policies.history import measured_history
from cfx.simulation.base import Stepper

__all__ = [
    "LeaderFuture",
    "Origins",
    "Paths",
    "extrapolated",
    "measured_paths",
    "sample_from_origins",
]
"""What plugins may use, as `cfx.plugin.forecasts`."""


LeaderFuture = Literal["given", "constant_speed", "constant_acceleration"]
"""What is known of the leader after an origin.

`given`: what they did; the errors are the follower's alone. `constant_speed`,
`constant_acceleration`: what can be known at the origin, if the leader drives on as they do there.
"""

_SHARD_BYTES = 1 << 28
"""What one shard of origins takes at most, for signals and for the state of networks."""

_COPIES = 4
"""How many tensors of the networks' state are alive at once, and of the signals besides."""


@dataclass(frozen=True)
class Origins:
    """Q moments of P pairs, pair after pair.

    Attributes:
        pair: `(Q,)` int64, index of the pair.
        frame: `(Q,)` int64, the last measured frame that may be read.
    """

    pair: Tensor
    frame: Tensor

    @classmethod
    def every(cls, stride: int, first: Tensor, last: Tensor) -> Origins:
        """Returns an origin every `stride` frames of each pair.

        Args:
            stride: in frames.
            first: `(P,)`, the first origin of each pair.
            last: `(P,)`, the latest frame that an origin may be at; a pair that has none gets none.
        """
        counts = ((last - first).div(stride, rounding_mode="floor") + 1).clamp(min=0)
        pair = torch.repeat_interleave(torch.arange(len(first), device=first.device), counts)
        before = torch.cumsum(counts, 0) - counts
        number = torch.arange(len(pair), device=first.device) - before[pair]
        return cls(pair, first[pair] + number * stride)

    def columns(self, pairs: PairSet) -> dict[str, NDArray[np.object_]]:
        """Returns the columns with which a table of them begins: `pair_id` and `driver`."""
        index = self.pair.cpu().numpy()
        ids = np.asarray(pairs.ids, dtype=object)
        drivers = np.asarray(pairs.drivers, dtype=object)
        return {"pair_id": ids[index], "driver": drivers[index]}

    def __len__(self) -> int:
        """Q."""
        return len(self.pair)

    def __getitem__(self, index: slice) -> Origins:
        """Selects origins."""
        return Origins(self.pair[index], self.frame[index])


class Paths(NamedTuple):
    """Q paths from their origins on, frame 0 being the origin.

    Attributes:
        speed: `(Q, K + 1)`, m/s.
        travelled: `(Q, K + 1)`, m since the origin.
    """

    speed: Tensor
    travelled: Tensor


def measured_paths(batch: PairBatch, origins: Origins, steps: int) -> tuple[Paths, Tensor]:
    """Returns what followers did after origins.

    Args:
        batch: P pairs.
        origins: Q of them.
        steps: K.

    Returns:
        The paths, and which of their frames were recorded, bool `(Q, K + 1)`.
    """
    frames = origins.frame[:, None] + torch.arange(steps + 1, device=origins.frame.device)
    recorded = frames < batch.lengths[origins.pair][:, None]
    index = frames.clamp(max=batch.mask.shape[1] - 1)
    rows = origins.pair[:, None]
    position = batch.follower_position[rows, index]
    return Paths(batch.follower_speed[rows, index], position - position[:, :1]), recorded


def sample_from_origins(
    stepper: Stepper,
    agent: Agent,
    followers: Followers,
    origins: Origins,
    steps: int,
    generators: Sequence[torch.Generator | None] = (None,),
    *,
    leader: LeaderFuture = "given",
) -> Paths:
    """Samples paths of followers from origins on, with an agent in the loop.

    Up to an origin the agent observes what was measured (burn-in, driver features), once for all
    paths. From there on it sees the simulated follower only. One path of all origins is one batch,
    in shards that fit the memory.

    Args:
        stepper: the model and its time step.
        agent: chooses the parameters of each window; of any kind.
        followers: P pairs, and what the agent knows of them; it observes their history before each
            origin.
        origins: Q of them.
        steps: K, at least 1.
        generators: S of them, on the CPU, one for each path; None: what a stochastic agent does if
            nothing is drawn.
        leader: what is known of the leader after the origin.

    Returns:
        Paths `(S, Q, K + 1)`.
    """
    speeds, travelled = [], []
    batch, base = followers.batch, followers.base
    for shard in _shards(agent, batch, origins):
        state = None
        if followers.history is None and not agent.core.driver_features:
            state = _observed(agent, followers, shard)
        part = _with_future(batch[shard.pair], shard.frame, steps, leader)
        base_of_origin = None if base is None else base[shard.pair]
        followers_here = Followers(
            part, followers.network[shard.pair], base_of_origin, followers.history
        )
        index = shard.frame[:, None] + torch.arange(steps + 1, device=shard.frame.device)
        index = index.clamp(max=part.mask.shape[1] - 1)
        leader_position = part.leader_position.gather(1, index)
        speed, moved = [], []
        for generator in generators:
            loop = simulate_closed_loop(
                stepper, agent, followers_here, shard.frame, state=state, generator=generator
            )
            position = leader_position - loop.gap
            speed.append(loop.speed)
            moved.append(position - position[:, :1])
        speeds.append(torch.stack(speed))
        travelled.append(torch.stack(moved))
    return Paths(torch.cat(speeds, 1), torch.cat(travelled, 1))


@torch.no_grad()
def _observed(agent: Agent, followers: Followers, origins: Origins) -> AgentState:
    """Returns the agent's state at origins, each pair being observed once.

    What was observed up to an origin is the beginning of what is observed up to the next one. Not
    so where driver features condition the networks: each origin has its own.
    """
    pairs, row = torch.unique(origins.pair, return_inverse=True)
    at_origins = _begun(agent, followers, origins.pair)
    state = _begun(agent, followers, pairs)
    stride = agent.windows.stride
    last = torch.zeros_like(pairs).scatter_reduce(0, row, origins.frame, "amax")
    windows = origins.frame.add(stride - 1).div(stride, rounding_mode="floor")
    for window in range(int(windows.max()) + 1):
        due = (windows == window).nonzero()[:, 0]
        places = (at_origins.network[due], at_origins.place[due])
        at_origins.state[places] = state.state[state.network[row[due]], state.place[row[due]]]
        frame = torch.full_like(last, window * stride)
        history = measured_history(followers.batch, pairs, frame, agent.windows.length)
        state = agent.observe(history, state, frame < last)
    return at_origins


def _begun(agent: Agent, followers: Followers, pairs: Tensor) -> AgentState:
    """Returns the state of drivers of some pairs before their first window."""
    base = None if followers.base is None else followers.base[pairs]
    return agent.begin(followers.network[pairs], DriverContext(base))


def _shards(agent: Agent, batch: PairBatch, origins: Origins) -> Iterator[Origins]:
    """Cuts origins into shards whose signals and states fit the memory."""
    frames = batch.mask.shape[1]
    per_origin = _COPIES * (len(RECORDED) + len(batch.surroundings) + 2) * frames
    states = agent.core.network.initial_state(len(agent.names), 1)
    per_origin += _COPIES * math.prod(states.shape[2:])
    size = max(1, _SHARD_BYTES // (8 * per_origin))
    for first in range(0, len(origins), size):
        yield origins[first : first + size]


def _with_future(batch: PairBatch, origin: Tensor, steps: int, leader: LeaderFuture) -> PairBatch:
    """Returns Q pairs that last to the end of their forecasts, one for each origin `(Q,)`.

    Frames after a recording's end hold something, and are in no error (`measured_paths`).
    """
    frames = torch.arange(batch.mask.shape[1], device=origin.device)
    after = frames - origin[:, None]
    lasting = replace(batch, lengths=origin + steps + 1, mask=after <= steps)
    if leader == "given":
        return lasting
    rows = torch.arange(len(origin), device=origin.device)
    speed = batch.leader_speed[rows, origin]
    acceleration = torch.zeros_like(speed)
    if leader == "constant_acceleration":
        acceleration = batch.leader_acceleration[rows, origin]
    ahead = extrapolated(speed, acceleration, steps, batch.dt)
    step = after.clamp(min=0, max=steps)
    position = batch.leader_position[rows, origin][:, None] + ahead.travelled.gather(1, step)
    speeds = ahead.speed.gather(1, step)
    measured = after <= 0
    surroundings = {}
    for signal, values in batch.surroundings.items():
        # As for the leader, nothing is known of the future: what is ahead goes on as the leader is
        # expected to, and everything else stays as it is.
        expected = values[rows, origin][:, None].expand_as(values)
        if signal.quantity == "gap":
            expected = expected + ahead.travelled.gather(1, step)
        elif signal.quantity == "acceleration":
            expected = torch.zeros_like(values)
        surroundings[signal] = torch.where(measured, values, expected)
    return replace(
        lasting,
        surroundings=surroundings,
        leader_position=torch.where(measured, batch.leader_position, position),
        leader_speed=torch.where(measured, batch.leader_speed, speeds),
        leader_acceleration=torch.where(
            measured, batch.leader_acceleration, while_moving(speeds, acceleration)
        ),
    )


def while_moving(speed: Tensor, acceleration: Tensor) -> Tensor:
    """Returns accelerations `(Q, T)`: constant `(Q,)` while moving, and 0 once standing."""
    standing = (speed <= 0.0) & (acceleration < 0.0)[:, None]
    return torch.where(standing, 0.0, acceleration[:, None])


def extrapolated(speed: Tensor, acceleration: Tensor, steps: int, dt: float) -> Paths:
    """Returns paths at constant acceleration, `(Q, K + 1)`, in the steps of the simulation."""
    time = dt * torch.arange(steps + 1, dtype=speed.dtype, device=speed.device)
    speeds = (speed[:, None] + acceleration[:, None] * time).clamp(min=0.0)
    moved = speeds * dt
    moved[:, 0] = 0.0
    return Paths(speeds, moved.cumsum(1))
