"""The closed loop: an agent chooses parameters, the model drives, the agent sees the result.

From the last measured state before the test part on, the follower is simulated against the measured
leader. The agent sees the *simulated* follower there, never the measured one. Before that it has
observed the measured history (burn-in).

Shapes: P pairs, K simulated frames, L frames of a token, T = L + K columns, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.core import memory
from cfx.core.engine import Engine, Report
from cfx.core.threads import one_thread
from cfx.data.pairs import PairBatch
from cfx.models.base import Leader
from cfx.models.composed import Combined, for_both
from cfx.models.limits import at_limits
from cfx.policies.agent import Agent, AgentState, TrainedOn
from cfx.policies.context import DriverContext
from cfx.policies.history import History
from cfx.policies.known_drivers import driver_features_of
from cfx.policies.valid_range import share_in_words
from cfx.simulation.base import Stepper
from cfx.simulation.trajectory import Start


@dataclass(frozen=True)
class ParametersBeside:
    """Constant parameters of P drivers that drive beside an agent (`cfx.models.composed`).

    They drive the model as the agent does: with its residual, if it has one, they start with the
    acceleration that the driver has.

    Attributes:
        values: of the driving model, `(P, n)`, SI units.
        weight: the agent's share of the acceleration, `(P,)`, 0 to 1.
    """

    values: Tensor
    weight: Tensor

    def __getitem__(self, index: Tensor) -> ParametersBeside:
        """Selects drivers by their numbers."""
        return ParametersBeside(self.values[index], self.weight[index])


@dataclass(frozen=True)
class Followers:
    """P recorded followers and what an agent knows of each.

    Attributes:
        batch: P pairs, complete.
        network: `(P,)`, which of the agent's networks drives each pair.
        base: `(P, n)` in SI units, the drivers' base parameters; None: the agent's own base.
        history: seconds of measured history before a simulation that the agent observes, and in
            which driver features are measured; None: all there is.
        beside: constant parameters that drive beside the agent; None: it drives alone.
    """

    batch: PairBatch
    network: Tensor
    base: Tensor | None = None
    history: float | None = None
    beside: ParametersBeside | None = None


class ClosedLoop(NamedTuple):
    """P simulated trajectories, frame 0 being the last measured state; SI units.

    Attributes:
        speed, gap: `(P, K + 1)`.
        parameters: of the driving model, `(P, K + 1, n)`, what held on the way to each frame (at
            frame 0: what holds next).
        counted: `(P, K + 1)` bool, frames within the recording; frame 0 does not count.
        at_limits: `(P, K + 1)` bool, frames at a limit of acceleration (`model.limits`).
        outside: `(P, K + 1)` bool, frames of windows that began outside what the agent learned
            from (`cfx.policies.valid_range`).
        beyond: `(2 f,)` float64, at how many frames that count each signal alone was too low, then
            too high.

    The last three are None where nobody looked.
    """

    speed: Tensor
    gap: Tensor
    parameters: Tensor
    counted: Tensor
    at_limits: Tensor | None = None
    outside: Tensor | None = None
    beyond: Tensor | None = None


@torch.no_grad()
@one_thread()
def simulate_closed_loop(
    stepper: Stepper,
    agent: Agent,
    followers: Followers,
    first: Tensor,
    *,
    state: AgentState | None = None,
    generator: torch.Generator | None = None,
) -> ClosedLoop:
    """Simulates the test part of P pairs with an agent in the loop.

    Args:
        stepper: the model and its time step.
        agent: chooses the parameters of each window.
        followers: P pairs, simulated to the end of the longest, and what the agent knows of them.
        first: `(P,)`, the frame of the last measured state.
        state: of the agent after what it has observed up to `first`; None: it observes that here.
        generator: draws, on the CPU, what a stochastic agent leaves to chance; None: nothing is
            drawn.
    """
    stepper = agent.stepper(stepper)
    model = stepper.model
    if followers.beside is not None:
        stepper = stepper.for_model(Combined(model, model))
    if state is None:
        state = burnt_in(agent, followers, first, stepper.dt)
    track = _Track(followers.batch, first, agent.windows.length)
    position, speed, acceleration = track.now()
    follower = stepper.begin(Start(position, speed, acceleration))
    width = len(agent.core.head.model_space)
    parameters = track.speed.new_empty((len(first), track.steps + 1, width))
    outside = torch.zeros(parameters.shape[:2], dtype=torch.bool, device=parameters.device)
    beyond = torch.zeros(state.beyond.shape[1], dtype=torch.float64, device=parameters.device)
    _, _, counted = track.result()
    driver_specific: Mapping[str, Tensor] = {}
    if followers.beside is not None:
        driver_specific = agent.space.unpack(agent.core.head.completed(followers.beside.values))
    for begin in range(0, track.steps, agent.windows.stride):
        end = min(begin + agent.windows.stride, track.steps)
        chosen, state = agent.act(track.history(begin), state, generator)
        p = agent.space.unpack(chosen)
        if followers.beside is not None:
            p = for_both(p, driver_specific, followers.beside.weight)
        follower, positions, speeds = stepper.advance(follower, track.leader(begin, end), p)
        track.write(begin, end, positions.T, speeds.T, stepper.dt)
        simulated = slice(begin + 1, end + 1)
        parameters[:, simulated] = chosen[:, None, :width]
        is_outside = state.score > 1.0
        outside[:, simulated] = is_outside[:, None]
        frames = counted[:, simulated].sum(1) * is_outside
        beyond += (state.beyond * frames[:, None]).sum(0)
        if begin == 0:
            parameters[:, 0] = chosen[:, :width]
    speed, gap, counted = track.result()
    at_limit = at_limits(stepper.model.limits, speed, stepper.dt)
    return ClosedLoop(speed, gap, parameters, counted, at_limit, outside, beyond)


def burnt_in(agent: Agent, followers: Followers, first: Tensor, dt: float) -> AgentState:
    """Returns an agent's state after what it has observed of P pairs up to a frame.

    Args:
        agent, followers, first: as for `simulate_closed_loop`.
        dt: time step, s.
    """
    since = None
    if followers.history is not None:
        since = (first - round(followers.history / dt)).clamp(min=0)
    features = driver_features_of(agent, followers.batch, first, since)
    state = agent.begin(followers.network, DriverContext(followers.base, features))
    return agent.burn_in(followers.batch, first, state, since)


class _Track:
    """Signals of P pairs: `L - 1` measured columns, frame 0, then K columns that are simulated.

    Attributes:
        steps: K.
        speed: of the followers, `(P, T)`; NaN where nothing was simulated yet.
    """

    def __init__(self, batch: PairBatch, first: Tensor, length: int) -> None:
        self.steps = int((batch.lengths - 1 - first).max())
        self._length = length
        self._now = length - 1
        self._lengths = batch.lengths
        columns = torch.arange(1 - length, self.steps + 1, device=first.device)
        self._frames = first[:, None] + columns
        index = self._frames.clamp(min=0, max=batch.mask.shape[1] - 1)
        self._leader = Leader(
            batch.leader_position.gather(1, index),
            batch.leader_speed.gather(1, index),
            batch.leader_acceleration.gather(1, index),
            batch.leader_length[:, None],
        )
        self._surroundings = {}
        for declared, stored in batch.surroundings.items():
            self._surroundings[declared] = stored.gather(1, index)
        self._position = batch.follower_position.gather(1, index)
        self.speed = batch.follower_speed.gather(1, index)
        self._acceleration = batch.follower_acceleration.gather(1, index)
        # The agent must see nothing measured of the follower from here on. What reads a value too
        # early shows as NaN in the results, not as a good result.
        for signal in (self._position, self.speed, self._acceleration):
            signal[:, self._now + 1 :] = torch.nan
        self._gap = self._leader.position - self._leader.length - self._position

    def now(self) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the followers' last measured position, speed and acceleration, `(P,)` each."""
        return (
            self._position[:, self._now],
            self.speed[:, self._now],
            self._acceleration[:, self._now],
        )

    def history(self, begin: int) -> History:
        """Returns the L frames up to step `begin`, `(P, L)` each."""
        recent = slice(begin, begin + self._length)
        history = {
            "leader_speed": self._leader.speed[:, recent],
            "leader_acceleration": self._leader.acceleration[:, recent],
            "follower_speed": self.speed[:, recent],
            "follower_acceleration": self._acceleration[:, recent],
            "gap": self._gap[:, recent],
        }
        for signal, stored in self._surroundings.items():
            values = signal.seen_from(self._position[:, recent], stored[:, recent])
            history[signal.name] = values
        return history

    def leader(self, begin: int, end: int) -> Leader:
        """Returns the leaders at steps `begin` to `end - 1`, time first."""
        ahead = slice(self._now + begin, self._now + end)
        return Leader(
            self._leader.position[:, ahead].T,
            self._leader.speed[:, ahead].T,
            self._leader.acceleration[:, ahead].T,
            self._leader.length[:, 0],
        )

    def write(self, begin: int, end: int, position: Tensor, speed: Tensor, dt: float) -> None:
        """Writes what was simulated between two steps, `(P, end - begin)` each."""
        done = slice(self._now + begin + 1, self._now + end + 1)
        before = slice(self._now + begin, self._now + end)
        self._position[:, done] = position
        self.speed[:, done] = speed
        self._acceleration[:, done] = (self.speed[:, done] - self.speed[:, before]) / dt
        leader_rear = self._leader.position[:, done] - self._leader.length
        self._gap[:, done] = leader_rear - self._position[:, done]

    def result(self) -> tuple[Tensor, Tensor, Tensor]:
        """Returns speed, gap and which frames count, `(P, K + 1)` each."""
        counted = self._frames[:, self._now :] < self._lengths[:, None]
        counted[:, 0] = False
        return self.speed[:, self._now :], self._gap[:, self._now :], counted


def outside_of_scopes(
    agent: Agent, scopes: Mapping[str, Mapping[str, ClosedLoop]]
) -> dict[str, str]:
    """Returns `Evaluation.outside`: by scope what was outside of what the policy has learned.

    Such as "37 % of steps outside what the policy has learned (speed above 18 m/s)".

    Args:
        agent: what drove as `policy`.
        scopes: by scope and method the closed loops.
    """
    by_scope = {}
    for scope, loops in scopes.items():
        loop = loops.get("policy")
        if loop is None or loop.outside is None or loop.beyond is None:
            continue
        if agent.valid_range is not None:
            steps = int(loop.counted.sum())
            outside = int((loop.outside & loop.counted).sum())
            words = share_in_words(agent.valid_range, outside, steps, loop.beyond)
            if words:
                by_scope[scope] = words
    return by_scope


PAIRS_AT_ONCE = 1024
"""Pairs that are simulated together: enough for batches, few enough for a worker's memory."""

_TENSORS = 12
"""Tensors as large as these that an evaluation holds at once: several methods, several of each."""


@dataclass(frozen=True)
class ClosedLoopShard:
    """Some pairs, and what drives them: the arguments of `simulate_closed_loop`."""

    stepper: Stepper
    agent: Agent
    followers: Followers
    first: Tensor


def simulate_shard(shard: ClosedLoopShard, _report: Report) -> ClosedLoop:
    """Simulates the pairs of a shard, wherever it is; nobody is shown the progress of seconds."""
    return simulate_closed_loop(shard.stepper, shard.agent, shard.followers, shard.first)


def simulate_in_shards(
    engine: Engine,
    stepper: Stepper,
    agent: Agent,
    followers: Followers,
    first: Tensor,
) -> ClosedLoop:
    """Simulates P pairs as `simulate_closed_loop` does, in shards where there are many.

    How pairs are cut follows from their number alone, so that every engine gives the same bits.

    Args:
        engine: where shards are simulated; few pairs are simulated here.
        stepper, agent, followers, first: as for `simulate_closed_loop`.
    """
    # What it has learned from is a long list, and drives nothing.
    agent = replace(agent, trained_on=TrainedOn())
    batch = followers.batch
    if len(batch) <= PAIRS_AT_ONCE:
        return simulate_closed_loop(stepper, agent, followers, first)
    joined = _Joined(len(batch), 1 + int((batch.lengths - 1 - first).max()))
    shards = _cut(ClosedLoopShard(stepper, agent, followers, first))
    with closing(engine.map(simulate_shard, shards, lambda _: None)) as results:
        for number, part in results:
            joined.put(number, part)
    memory.give_back()
    return joined.whole()


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
        beside = None if followers.beside is None else followers.beside[part]
        followers_of_shard = Followers(
            followers.batch[part].trimmed(), network, base, followers.history, beside
        )
        yield ClosedLoopShard(whole.stepper, agent, followers_of_shard, whole.first[part])


class _Joined:
    """Closed loops of P pairs, put together from shards in any order.

    Those of many pairs lie in files (`cfx.core.memory`). Frames that a shard has not, because all
    its pairs end before, repeat its last one and do not count, as frames after the end of a pair.
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
        memory.release()

    def _empty(self, values: Tensor) -> Tensor:
        """Returns room for values `(pairs, columns, ...)` of all shards, on their device."""
        shape = (*self._shape, *values.shape[2:])
        if values.device.type != "cpu":
            return values.new_empty(shape)
        kind = values.new_empty(0).numpy().dtype
        return torch.as_tensor(memory.empty(shape, kind, together=_TENSORS))

    def whole(self) -> ClosedLoop:
        """Returns the closed loops of all shards, `(P, K + 1)`."""
        beyond = None
        if self._beyond:
            # In the order of the shards: the sum of floating point numbers depends on it.
            beyond = torch.stack([self._beyond[number] for number in sorted(self._beyond)]).sum(0)
        return ClosedLoop(**self._tensors, beyond=beyond)
