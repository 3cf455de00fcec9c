"""Roads full of drivers, all simulated at once: rings, open roads with a bottleneck, platoons.

Each vehicle follows the one ahead of it on its own lane; nobody overtakes. A step takes all
vehicles of all roads together: each sees the vehicle ahead at t, so no order is needed.

Shapes: D vehicles of all roads, W stored frames, L frames of a token. SI units.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from cfx.core import threads
from cfx.data.signals import OBSERVED
from cfx.models import composed
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.agent import Agent, AgentState
from cfx.policies.inputs import require_no_further_signals
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Start

__all__ = [
    "FREE_M",
    "START_HEADWAY",
    "Bottleneck",
    "Driven",
    "Lanes",
    "Road",
    "RoadKind",
    "joined",
    "open_roads",
    "platoons",
    "ring_roads",
    "simulate_roads",
]
"""What plugins may use, as `cfx.plugin.roads`."""

RoadKind = Literal["ring", "open", "platoon"]

START_HEADWAY = 2.0
"""s: gap at the start, over the speed, where the road says nothing of the speed."""

FREE_M = 200.0
"""m: where nobody is ahead a driver sees a vehicle this far ahead that drives as they do."""


@dataclass(frozen=True)
class Road:
    """One road.

    Attributes:
        kind: `ring`, `open` or `platoon`.
        level: what it differs in from others of its kind: the density of a ring (vehicles/km), the
            demand of an open road (vehicles/h), the speed of a platoon's leader (m/s).
        repetition: which of several with the same level.
        vehicles: which of the D vehicles drive on it, the first one first.
        circumference: of a ring, m.
    """

    kind: RoadKind
    level: float
    repetition: int
    vehicles: slice
    circumference: float = torch.inf


@dataclass(frozen=True)
class Bottleneck:
    """A part of an open road with a lower speed limit.

    Attributes:
        begin, end: m from where vehicles enter.
        limit: m/s.
    """

    begin: float = 1500.0
    end: float = 2000.0
    limit: float = 6.0


@dataclass(frozen=True)
class Lanes:
    """All roads with their D vehicles; tensors `(D,)`.

    Attributes:
        roads: one behind the other.
        position, speed: at the start, m (front bumper) and m/s.
        ahead: index of the vehicle ahead; of itself where nobody is.
        offset: m to be added to the position of the vehicle ahead: the circumference, for the first
            vehicle of a ring.
        steady: bool, vehicles that keep their speed whatever is ahead.
        entry: m/s, speed limit before position 0; infinity on roads without an entry.
        has_bottleneck: bool.
        bottleneck: of the open roads.
        length: of every vehicle, m.
    """

    roads: tuple[Road, ...]
    position: Tensor
    speed: Tensor
    ahead: Tensor
    offset: Tensor
    steady: Tensor
    entry: Tensor
    has_bottleneck: Tensor
    bottleneck: Bottleneck
    length: float

    def __len__(self) -> int:
        """D."""
        return len(self.position)

    def to(self, device: torch.device) -> Lanes:
        """Returns the same on a device."""
        return dataclasses.replace(
            self,
            position=self.position.to(device),
            speed=self.speed.to(device),
            ahead=self.ahead.to(device),
            offset=self.offset.to(device),
            steady=self.steady.to(device),
            entry=self.entry.to(device),
            has_bottleneck=self.has_bottleneck.to(device),
        )

    def limit(self, position: Tensor) -> Tensor:
        """Returns the speed limits where vehicles are, `(D,)`, m/s."""
        open_road = torch.full_like(position, torch.inf)
        limit = torch.where(position < 0.0, self.entry, open_road)
        inside = (position >= self.bottleneck.begin) & (position < self.bottleneck.end)
        return torch.where(self.has_bottleneck & inside, self.bottleneck.limit, limit)

    def leader(self, follower: Follower) -> Leader:
        """Returns the vehicle ahead of each, `(D,)`."""
        return Leader(
            follower.position[self.ahead] + self.offset,
            follower.speed[self.ahead],
            follower.acceleration[self.ahead],
            follower.position.new_tensor(self.length),
        )


class Driven(NamedTuple):
    """What D vehicles did.

    Attributes:
        position, speed: `(D, W)`, frames `interval` apart, from the start on.
        interval: s between stored frames.
        min_gap: the smallest gap at any step, `(D,)`, m; negative: a collision.
        outside: share of the windows that began outside what the agent learned from, `(D,)`.
    """

    position: Tensor
    speed: Tensor
    interval: float
    min_gap: Tensor
    outside: Tensor


def ring_roads(
    densities: Sequence[float],
    vehicles: int,
    repetitions: int,
    length: float,
    perturbation: float,
    generator: torch.Generator,
) -> Lanes:
    """Returns ring roads with equally many vehicles; their circumference follows from the density.

    Vehicles start at equal distances but for a random shift of each, and at the speed at which the
    mean gap is 2 s, at most 15 m/s.

    Args:
        densities: vehicles/km.
        vehicles: of each ring.
        repetitions: rings of each density.
        length: of every vehicle, m.
        perturbation: largest shift, as a share of the mean gap; below a half.
        generator: draws the shifts.
    """
    parts = []
    for density in densities:
        spacing = 1000.0 / density
        gap = spacing - length
        for repetition in range(repetitions):
            shift = torch.rand(vehicles, generator=generator, dtype=torch.float64) * 2.0 - 1.0
            place = -spacing * torch.arange(vehicles, dtype=torch.float64)
            circumference = spacing * vehicles
            ahead = (torch.arange(vehicles) - 1) % vehicles
            offset = torch.zeros_like(place)
            offset[0] = circumference
            parts.append(
                _lane(
                    Road("ring", density, repetition, slice(0, vehicles), circumference),
                    place + perturbation * gap * shift,
                    min(gap / START_HEADWAY, 15.0),
                    ahead,
                    offset,
                    length,
                )
            )
    return joined(parts)


def open_roads(
    demands: Sequence[float],
    entry_speed: float,
    seconds: float,
    bottleneck: Bottleneck,
    length: float,
) -> Lanes:
    """Returns open roads with a bottleneck, which vehicles enter as often as the demand says.

    Vehicles come to position 0 from a queue upstream, in which nobody is faster than the speed of
    entry; they have that speed at the start, and the spacing that makes it the demand. Where the
    road or the drivers do not take that much, the queue jams. Behind the bottleneck the road goes
    on, and the first vehicle has nobody ahead.

    Args:
        demands: vehicles/h.
        entry_speed: m/s.
        seconds: for which vehicles enter.
        bottleneck: where the limit is lower.
        length: of every vehicle, m.
    """
    parts = []
    for demand in demands:
        count = max(2, round(demand * seconds / 3600.0))
        spacing = entry_speed * 3600.0 / demand
        offset = torch.zeros(count, dtype=torch.float64)
        offset[0] = FREE_M + length
        lane = _lane(
            Road("open", demand, 0, slice(0, count)),
            -spacing * torch.arange(count, dtype=torch.float64),
            entry_speed,
            (torch.arange(count) - 1).clamp(min=0),
            offset,
            length,
        )
        entry = torch.full_like(lane.entry, entry_speed)
        is_open = torch.ones_like(lane.steady)
        parts.append(
            dataclasses.replace(lane, entry=entry, has_bottleneck=is_open, bottleneck=bottleneck)
        )
    return joined(parts)


def platoons(speeds: Sequence[float], vehicles: int, repetitions: int, length: float) -> Lanes:
    """Returns platoons behind a leader that keeps its speed, as in the experiments of Jiang et al.

    R. Jiang et al. (2014), *Traffic experiment reveals the nature of car-following*, PLOS ONE 9(4),
    e94351.

    Args:
        speeds: of the leaders, m/s.
        vehicles: of each platoon, its leader included.
        repetitions: platoons behind each leader.
        length: of every vehicle, m.
    """
    parts = []
    for speed in speeds:
        spacing = length + START_HEADWAY * speed
        for repetition in range(repetitions):
            lane = _lane(
                Road("platoon", speed, repetition, slice(0, vehicles)),
                -spacing * torch.arange(vehicles, dtype=torch.float64),
                speed,
                (torch.arange(vehicles) - 1).clamp(min=0),
                torch.zeros(vehicles, dtype=torch.float64),
                length,
            )
            steady = torch.zeros_like(lane.steady)
            steady[0] = True
            lane.offset[0] = FREE_M + length
            parts.append(dataclasses.replace(lane, steady=steady))
    return joined(parts)


def joined(parts: Sequence[Lanes]) -> Lanes:
    """Returns all roads of several lanes, to be simulated together."""
    roads: list[Road] = []
    ahead = []
    before = 0
    for part in parts:
        for road in part.roads:
            vehicles = slice(road.vehicles.start + before, road.vehicles.stop + before)
            roads.append(dataclasses.replace(road, vehicles=vehicles))
        ahead.append(part.ahead + before)
        before += len(part)
    columns = {}
    for name in ("position", "speed", "offset", "steady", "entry", "has_bottleneck"):
        columns[name] = torch.cat([getattr(part, name) for part in parts])
    bottleneck = Bottleneck()
    for part in parts:
        if bool(part.has_bottleneck.any()):
            bottleneck = part.bottleneck
    return Lanes(
        roads=tuple(roads),
        ahead=torch.cat(ahead),
        bottleneck=bottleneck,
        length=parts[0].length,
        **columns,
    )


def _lane(
    road: Road, position: Tensor, speed: float, ahead: Tensor, offset: Tensor, length: float
) -> Lanes:
    """Returns one road without limits."""
    nowhere = torch.zeros_like(ahead, dtype=torch.bool)
    return Lanes(
        roads=(road,),
        position=position,
        speed=torch.full_like(position, speed),
        ahead=ahead,
        offset=offset,
        steady=nowhere,
        entry=torch.full_like(position, torch.inf),
        has_bottleneck=nowhere,
        bottleneck=Bottleneck(),
        length=length,
    )


@torch.no_grad()
@threads.one_thread()
def simulate_roads(
    model: DrivingModel,
    agent: Agent,
    state: AgentState,
    lanes: Lanes,
    seconds: float,
    generator: torch.Generator | None = None,
    pace: Tensor | None = None,
) -> Driven:
    """Simulates all vehicles of all roads with an agent that drives each of them.

    What vehicles have seen before the start is the first frame, again and again, and whatever
    `state` remembers.

    Args:
        model: the job's driving model; its own equations take the steps.
        agent: chooses the parameters of each window of each vehicle.
        state: where the D drivers stand.
        lanes: the roads.
        seconds: how long; whole windows are simulated.
        generator: draws, on the CPU, what a stochastic agent leaves to chance; None: nothing is
            drawn.
        pace: m/s that vehicles which keep their speed are faster after each time step than at the
            start, `(S,)`; afterwards as at its end. None: nothing.
    """
    require_no_further_signals(agent.core.inputs, "simulated traffic")
    dt, windows = agent.dt, agent.windows
    stepper = agent.stepper(MemoryStepper(model, dt, compile="never"))
    stepper = stepper.for_model(composed.WithSpeedLimit(stepper.model))
    follower = stepper.begin(Start(lanes.position, lanes.speed, torch.zeros_like(lanes.speed)))
    ahead = lanes.leader(follower)
    observed = deque([_seen(follower, ahead)] * windows.length, maxlen=windows.length)
    positions, speeds = [follower.position], [follower.speed]
    min_gap = ahead.position - ahead.length - follower.position
    outside = torch.zeros_like(min_gap)
    count = max(1, round(seconds / (windows.stride * dt)))
    steps = count * windows.stride
    if pace is None:
        pace = lanes.speed.new_zeros(1)
    paces = iter(pace[torch.arange(steps, device=pace.device).clamp(max=len(pace) - 1)])
    for _ in range(count):
        history = {}
        for number, name in enumerate(OBSERVED):
            history[name] = torch.stack([frame[number] for frame in observed], -1)
        chosen, state = agent.act(history, state, generator)
        outside += state.score > 1.0
        p = agent.space.unpack(chosen)
        for _ in range(windows.stride):
            p[composed.SPEED_LIMIT] = lanes.limit(follower.position)
            now = Leader(
                ahead.position[None], ahead.speed[None], ahead.acceleration[None], ahead.length
            )
            moved, _, _ = stepper.advance(follower, now, p)
            steady_speed = lanes.speed + next(paces)
            follower = _kept_steady(moved, follower, steady_speed, lanes.steady, dt)
            ahead = lanes.leader(follower)
            observed.append(_seen(follower, ahead))
            min_gap = torch.minimum(min_gap, observed[-1][-1])
        positions.append(follower.position)
        speeds.append(follower.speed)
    return Driven(
        torch.stack(positions, -1),
        torch.stack(speeds, -1),
        windows.stride * dt,
        min_gap,
        outside / count,
    )


def _seen(follower: Follower, ahead: Leader) -> tuple[Tensor, ...]:
    """Returns one frame of the signals that drivers observe, in the order of `OBSERVED`."""
    gap = ahead.position - ahead.length - follower.position
    return ahead.speed, ahead.acceleration, follower.speed, follower.acceleration, gap


def _kept_steady(
    moved: Follower, before: Follower, speed: Tensor, steady: Tensor, dt: float
) -> Follower:
    """Returns vehicles after a step; those with a prescribed speed `(D,)` keep it."""
    return moved._replace(
        position=torch.where(steady, before.position + speed * dt, moved.position),
        speed=torch.where(steady, speed, moved.speed),
        acceleration=torch.where(steady, (speed - before.speed) / dt, moved.acceleration),
    )
