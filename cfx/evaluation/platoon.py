"""String stability: ten followers in a row behind a leader that brakes and recovers.

A policy is trained and tested behind one recorded leader. In traffic its followers follow one
another, and what each adds to a disturbance multiplies. A platoon is string stable if no vehicle
slows down more than the vehicle ahead. A platoon that has not settled before the leader brakes, or
in which vehicles collide, does not count as stable.

Information flows downstream only, and a model sees its leader at t. So all vehicles of all platoons
take each step at once.

Shapes: N platoons, V vehicles of each, T frames, n tuned parameters.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.core.threads import one_thread
from cfx.evaluation.metrics.safety import hard_braking_frames
from cfx.evaluation.result import METHODS, Array, Platoon
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.agent import Agent, AgentState
from cfx.policies.history import History
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.trajectory import Start

log = logging.getLogger(__name__)

VEHICLES = 10
"""Followers of a platoon."""

LENGTH = 5.0
"""m, of every vehicle."""

START_HEADWAY = 2.0
"""s: time gap of every follower at the start, at the leader's speed. During `Manoeuvre.settle` each
moves from there to the gap that its own parameters ask for."""

TOLERANCE = 0.1
"""m/s: how much more than the vehicle ahead a vehicle may slow down in a string stable platoon."""

CALM = 0.5
"""m/s: how much speeds may differ from the leader's in a platoon that has settled. It is not
smaller because Wiedemann's models oscillate about the leader's speed for ever."""

SETTLED_FOR = 5.0
"""s before the leader brakes, in which speeds of a settled platoon are near the leader's."""


@dataclass(frozen=True)
class Manoeuvre:
    """What the leader does: it drives steadily, brakes, drives slowly, speeds up, drives steadily.

    Attributes:
        cruise, low: the two speeds, m/s.
        settle, hold, after: how long it keeps cruise, low and cruise again, s.
        brake, recover: acceleration from one to the other, m/s2.
    """

    cruise: float = 15.0
    low: float = 7.0
    settle: float = 60.0
    brake: float = -2.0
    hold: float = 10.0
    recover: float = 1.0
    after: float = 60.0

    def speed(self, dt: float) -> Array:
        """Returns the leader's speed `(T,)`, m/s, in steps of `dt` s."""
        braking = (self.low - self.cruise) / self.brake
        recovering = (self.cruise - self.low) / self.recover
        durations = np.array([0.0, self.settle, braking, self.hold, recovering, self.after])
        accelerations = np.array([0.0, 0.0, self.brake, 0.0, self.recover, 0.0])
        times = np.cumsum(durations)
        speeds = self.cruise + np.cumsum(durations * accelerations)
        return np.asarray(np.interp(np.arange(round(times[-1] / dt) + 1) * dt, times, speeds))


class _Road:
    """N simulated platoons; all tensors `(V + 1, N, T)`, vehicle 0 being the leader, SI units."""

    def __init__(self, leader_speed: Tensor, platoons: int, dt: float) -> None:
        shape = (VEHICLES + 1, platoons, len(leader_speed))
        self.position = leader_speed.new_full(shape, torch.nan)
        self.speed = torch.full_like(self.position, torch.nan)
        self.acceleration = torch.full_like(self.position, torch.nan)
        cruise = leader_speed[0]
        spacing = LENGTH + START_HEADWAY * cruise
        vehicle = torch.arange(VEHICLES + 1, dtype=cruise.dtype, device=cruise.device)
        self.position[..., 0] = -spacing * vehicle[:, None]
        self.speed[..., 0] = cruise
        self.acceleration[..., 0] = 0.0
        self.speed[0] = leader_speed
        self.acceleration[0, :, 1:] = leader_speed.diff() / dt
        # Integrated as followers are, by the new speed: x' = x + v' dt.
        travelled = (leader_speed[1:] * dt).cumsum(0)
        self.position[0] = torch.cat([leader_speed.new_zeros(1), travelled])

    @property
    def gap(self) -> Tensor:
        """Gaps of the followers, `(V, N, T)`."""
        return self.position[:-1] - LENGTH - self.position[1:]

    def leader(self, frame: int) -> Leader:
        """Returns the vehicle ahead of each follower, one frame `(1, V N)`."""
        return Leader(
            self.position[:-1, :, frame].reshape(1, -1),
            self.speed[:-1, :, frame].reshape(1, -1),
            self.acceleration[:-1, :, frame].reshape(1, -1),
            self.position.new_tensor(LENGTH),
        )

    def start(self) -> Start:
        """Returns the followers' first state, `(V N,)`."""
        return Start(
            self.position[1:, :, 0].reshape(-1),
            self.speed[1:, :, 0].reshape(-1),
            self.acceleration[1:, :, 0].reshape(-1),
        )

    def write(self, frame: int, follower: Follower) -> None:
        """Writes the followers' state at a frame."""
        self.position[1:, :, frame] = follower.position.view(VEHICLES, -1)
        self.speed[1:, :, frame] = follower.speed.view(VEHICLES, -1)
        self.acceleration[1:, :, frame] = follower.acceleration.view(VEHICLES, -1)

    def history(self, frame: int, length: int, platoons: slice) -> History:
        """Returns the last frames that followers of n platoons have seen, `(V n, length)` each.

        Before the start there is none: the first frame stands for those.
        """
        index = torch.arange(frame - length + 1, frame + 1, device=self.speed.device).clamp(min=0)
        speed = self.speed[:, platoons, index]
        acceleration = self.acceleration[:, platoons, index]
        position = self.position[:, platoons, index]
        gap = position[:-1] - LENGTH - position[1:]
        return {
            "leader_speed": speed[:-1].reshape(-1, length),
            "leader_acceleration": acceleration[:-1].reshape(-1, length),
            "follower_speed": speed[1:].reshape(-1, length),
            "follower_acceleration": acceleration[1:].reshape(-1, length),
            "gap": gap.reshape(-1, length),
        }


def measure_platoons(
    model: DrivingModel,
    agents: Mapping[str, tuple[Agent, Sequence[str]]],
    manoeuvre: Manoeuvre | None = None,
) -> Platoon | None:
    """Simulates a platoon for every network of every method and measures how a disturbance travels.

    Args:
        model: the driving model. Its own equations take the steps, whatever simulator a job has.
        agents: for each method what chooses the parameters, and a name for each of its networks.
            Their windows are equally long.
        manoeuvre: what the leader does; None for the standard one.

    Returns:
        None for a model without equations, or if no method is simulated: one whose policy reads
        further signals, such as the weather, is not, as nothing gives them here.
    """
    if model.needs_simulator:
        return None
    methods = []
    for method in METHODS:
        if method in agents and not agents[method][0].core.further_signals:
            methods.append(method)
        elif method in agents:
            log.info("No platoon of the method %s: its inputs read further signals", method)
    if not methods:
        return None
    driving = [agents[method][0] for method in methods]
    dt = driving[0].dt
    simulated = []
    for together in _grouped(model, driving):
        simulated += simulate_platoons(model, together, manoeuvre or Manoeuvre())
    tables = []
    measures = []
    for method, (speed, gap) in zip(methods, simulated, strict=True):
        names = agents[method][1]
        tables.append(_table(method, names, speed, gap, dt))
        measures.append(_measures(method, names, speed, gap, dt))
    return Platoon(pd.concat(tables, ignore_index=True), pd.concat(measures, ignore_index=True))


def _grouped(model: DrivingModel, agents: Sequence[Agent]) -> list[list[Agent]]:
    """Returns neighbouring agents in groups that can be simulated as one batch.

    An agent whose head puts another model around the driving model is alone in its group.
    """
    groups: list[list[Agent]] = []
    for agent in agents:
        is_alone = agent.core.head.driven_model(model) is not model
        if is_alone or not groups or groups[-1][-1].core.head.driven_model(model) is not model:
            groups.append([])
        groups[-1].append(agent)
    return groups


@torch.no_grad()
@one_thread()
def simulate_platoons(
    model: DrivingModel,
    agents: Sequence[Agent],
    manoeuvre: Manoeuvre,
    generator: torch.Generator | None = None,
) -> list[tuple[Tensor, Tensor]]:
    """Simulates a platoon for each network of each agent, without any history before.

    Args:
        model: the driving model.
        agents: what chooses the parameters; their windows and time steps are the same, and so is
            the model that each drives (`Agent.stepper`).
        manoeuvre: what the leader does.
        generator: draws the noise of stochastic agents, on the CPU; None: there is no noise.
            `measure_platoons` gives none, since noise that grows along the platoon could not be
            told from instability.

    Returns:
        For each agent the speeds of its N platoons `(V + 1, N, T)`, vehicle 0 being the leader, and
        the gaps of the followers `(V, N, T)`.
    """
    dt, windows, device = agents[0].dt, agents[0].windows, agents[0].core.scaler.mean.device
    bounds = np.cumsum([0] + [len(agent.names) for agent in agents]).tolist()
    parts = [slice(first, last) for first, last in pairwise(bounds)]
    road = _Road(torch.as_tensor(manoeuvre.speed(dt), device=device), bounds[-1], dt)
    states = []
    for agent in agents:
        network = torch.arange(len(agent.names), device=device).repeat(VEHICLES)
        states.append(agent.begin(network))
    stepper = agents[0].stepper(MemoryStepper(model, dt, compile="never"))
    follower = stepper.begin(road.start())
    parameters: dict[str, Tensor] = {}
    for frame in range(road.speed.shape[-1] - 1):
        if frame % windows.stride == 0:
            histories = [road.history(frame, windows.length, part) for part in parts]
            chosen, states = _choose(agents, histories, states, generator)
            parameters = agents[0].space.unpack(chosen)
        follower, _, _ = stepper.advance(follower, road.leader(frame), parameters)
        road.write(frame + 1, follower)
    return [(road.speed[:, part], road.gap[:, part]) for part in parts]


def _choose(
    agents: Sequence[Agent],
    histories: Sequence[History],
    states: Sequence[AgentState],
    generator: torch.Generator | None,
) -> tuple[Tensor, list[AgentState]]:
    """Returns the parameters of all followers `(V N, n)` and each agent's state afterwards."""
    chosen = []
    after = []
    for agent, history, state in zip(agents, histories, states, strict=True):
        parameters, state_after = agent.act(history, state, generator)
        chosen.append(parameters.view(VEHICLES, len(agent.names), -1))
        after.append(state_after)
    return torch.cat(chosen, dim=1).flatten(0, 1), after


def _table(
    method: str, names: Sequence[str], speed: Tensor, gap: Tensor, dt: float
) -> pd.DataFrame:
    """Returns the simulated trajectories in long form, single precision."""
    vehicles, platoons, frames = speed.shape
    of_leader = torch.full_like(gap[:1], torch.nan)
    vehicle, network, frame = np.indices((vehicles, platoons, frames)).reshape(3, -1)
    return pd.DataFrame(
        {
            "method": method,
            "network": np.asarray(names, dtype=object)[network],
            "vehicle": vehicle.astype(np.int16),
            "time_s": np.round(frame * dt, 6),
            "speed": speed.reshape(-1).float().cpu().numpy(),
            "gap": torch.cat([of_leader, gap]).reshape(-1).float().cpu().numpy(),
        }
    )


def _measures(
    method: str, names: Sequence[str], speed: Tensor, gap: Tensor, dt: float
) -> pd.DataFrame:
    """Returns a row per platoon; the columns are those of `Platoon.measures`."""
    cruise = speed[0, 0, 0]
    braking = int((speed[0, 0] < cruise).int().argmax()) - 1
    before = slice(max(braking - round(SETTLED_FOR / dt), 0), braking + 1)
    after = slice(braking, None)
    drop = slowing(speed[..., after])
    first, last = drop[1], drop[-1]
    settled = ((speed[..., before] - cruise).abs() <= CALM).all(2).all(0)
    # All but `settled` is measured from where the leader brakes on; collisions always count.
    collisions = (gap < 0).any(2).sum(0)
    apart = collisions == 0
    counted = torch.ones(speed.shape[-1] - braking, dtype=torch.bool, device=speed.device)
    columns = {
        "drop_leader": drop[0],
        "drop_first": first,
        "drop_last": last,
        # A first follower that does not slow down does not follow: there is nothing to amplify.
        "amplification": torch.where((first > TOLERANCE) & apart, last / first, torch.nan),
        "head_to_tail": torch.where(apart, last / drop[0], torch.nan),
        "string_stable": (drop.diff(dim=0) <= TOLERANCE).all(0) & settled & apart,
        "settled": settled,
        "min_gap": gap[..., after].amin((0, 2)),
        "collisions": collisions,
        "hard_braking": hard_braking_frames(speed[1:, :, after], counted, dt).sum(0),
    }
    table = pd.DataFrame({"method": method, "network": list(names)})
    for name, column in columns.items():
        table[name] = column.double().cpu().numpy()
    return table


def slowing(speed: Tensor) -> Tensor:
    """Returns by how much each vehicle slows down: its lowest speed below its highest before that.

    A higher speed after the lowest one is an overshoot while recovering, and does not count.

    Args:
        speed: `(*batch, T)`, m/s, from the frame on at which the leader begins to brake.

    Returns:
        `(*batch,)`, m/s.
    """
    lowest, when = speed.min(dim=-1)
    highest_so_far = speed.cummax(dim=-1).values.gather(-1, when[..., None])[..., 0]
    return highest_so_far - lowest
