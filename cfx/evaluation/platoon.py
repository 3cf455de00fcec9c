"""String stability: ten drivers in a row, each driven by the same method, behind a leader that brakes and recovers.

A policy is trained and tested behind one recorded leader. In traffic its followers follow one another, and what each adds to a
disturbance multiplies. A platoon is string stable if nobody slows down more than the vehicle ahead. One that has not settled
before the leader brakes, or in which vehicles collide, does not count as stable.

Information flows downstream only, and a model sees its leader at t: so all vehicles of all platoons take each step at once.
Shapes: N platoons, V vehicles of each, T frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.agents.agent import Agent
from cfx.evaluation.result import METHODS, Array, Platoon
from cfx.metrics.safety import hard_braking_frames
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.features import History
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.threads import one_thread
from cfx.simulation.trajectory import Start

VEHICLES = 10
"""Followers of a platoon."""

LENGTH = 5.0
"""m, of every vehicle."""

START_HEADWAY = 2.0
"""s: the gap of every follower at the start, as a time at the common speed. From there each settles as its method has it."""

TOLERANCE = 0.1
"""m/s: so much more than the vehicle ahead a vehicle may slow down in a string stable platoon."""

CALM = 0.5
"""m/s: so much a speed may differ from the leader's in a platoon that has settled; Wiedemann's drivers never stop swinging."""


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
        braking, recovering = (
            (self.low - self.cruise) / self.brake,
            (self.cruise - self.low) / self.recover,
        )
        phases = [
            (self.settle, 0.0),
            (braking, self.brake),
            (self.hold, 0.0),
            (recovering, self.recover),
            (self.after, 0.0),
        ]
        times = np.cumsum([0.0, *(length for length, _ in phases)])
        speeds = self.cruise + np.cumsum(
            [0.0, *(length * acceleration for length, acceleration in phases)]
        )
        return np.asarray(np.interp(np.arange(round(times[-1] / dt) + 1) * dt, times, speeds))


class _Road:
    """N platoons as they drive; all tensors `(V + 1, N, T)`, vehicle 0 being the leader, SI units."""

    def __init__(self, leader_speed: Tensor, platoons: int, dt: float) -> None:
        frames = len(leader_speed)
        shape = (VEHICLES + 1, platoons, frames)
        self.position, self.speed, self.acceleration = (
            leader_speed.new_full(shape, torch.nan) for _ in range(3)
        )
        cruise = leader_speed[0]
        spacing = LENGTH + START_HEADWAY * cruise
        self.position[..., 0] = (
            -spacing * torch.arange(VEHICLES + 1, dtype=cruise.dtype, device=cruise.device)[:, None]
        )
        self.speed[..., 0], self.acceleration[..., 0] = cruise, 0.0
        self.speed[0] = leader_speed
        self.acceleration[0, :, 1:] = leader_speed.diff() / dt
        # As the followers' own: x' = x + v' dt.
        self.position[0] = torch.cat([leader_speed.new_zeros(1), (leader_speed[1:] * dt).cumsum(0)])

    @property
    def gap(self) -> Tensor:
        """Gaps of the followers, `(V, N, T)`."""
        return self.position[:-1] - LENGTH - self.position[1:]

    def leader(self, frame: int) -> Leader:
        """Returns whom each follower follows, one frame `(1, V N)`."""
        position, speed, acceleration = (
            x[:-1, :, frame].reshape(1, -1) for x in (self.position, self.speed, self.acceleration)
        )
        return Leader(position, speed, acceleration, self.position.new_tensor(LENGTH))

    def start(self) -> Start:
        """Returns the followers' first state, `(V N,)`."""
        return Start(
            *(
                signal[1:, :, 0].reshape(-1)
                for signal in (self.position, self.speed, self.acceleration)
            )
        )

    def put(self, frame: int, follower: Follower) -> None:
        """Writes down where the followers are."""
        for signal, value in zip(
            (self.position, self.speed, self.acceleration), follower, strict=False
        ):
            signal[1:, :, frame] = value.view(VEHICLES, -1)

    def history(self, frame: int, length: int, platoons: slice) -> History:
        """Returns the last frames that each follower of some platoons has seen, `(V n, length)`.

        The first frame stands for those before it.
        """
        index = torch.arange(frame - length + 1, frame + 1, device=self.speed.device).clamp(min=0)
        speed, acceleration, position = (
            x[:, platoons, index] for x in (self.speed, self.acceleration, self.position)
        )
        gap = position[:-1] - LENGTH - position[1:]
        seen = (speed[:-1], acceleration[:-1], speed[1:], acceleration[1:], gap)
        return History(*(signal.reshape(-1, length) for signal in seen))


def measure_platoons(
    model: DrivingModel,
    policies: Mapping[str, tuple[Agent, Sequence[str]]],
    manoeuvre: Manoeuvre | None = None,
) -> Platoon | None:
    """Lets every network of every method drive a platoon of its own, and measures how a disturbance travels through it.

    Args:
        model: the driving model. Its own equations take the steps, whatever simulator a job has.
        policies: for each method what chooses the parameters, and a name for each of its networks; all choose equally often.
        manoeuvre: what the leader does; None for the standard one.

    Returns:
        None for a model without equations.
    """
    if model.needs_simulator:
        return None
    chosen = {method: policies[method] for method in METHODS if method in policies}
    dt = next(iter(chosen.values()))[0].dt
    drives = drive_platoons(
        model, [policy for policy, _ in chosen.values()], manoeuvre or Manoeuvre()
    )
    found = [
        (method, names, *drive)
        for (method, (_, names)), drive in zip(chosen.items(), drives, strict=True)
    ]
    return Platoon(
        pd.concat([_table(*one, dt) for one in found], ignore_index=True),
        pd.concat([_measures(*one, dt) for one in found], ignore_index=True),
    )


@torch.no_grad()
@one_thread()
def drive_platoons(
    model: DrivingModel, policies: Sequence[Agent], manoeuvre: Manoeuvre
) -> list[tuple[Tensor, Tensor]]:
    """Lets each network of each policy drive a platoon. It has read no history: it knows only what it sees here.

    Returns:
        For each policy the speeds of its N platoons `(V + 1, N, T)`, vehicle 0 being the leader, and the gaps of the followers
        `(V, N, T)`.
    """
    dt, windows, device = policies[0].dt, policies[0].windows, policies[0].scaler.mean.device
    sizes = [len(policy.names) for policy in policies]
    parts = [slice(sum(sizes[:k]), sum(sizes[: k + 1])) for k in range(len(sizes))]
    road = _Road(torch.as_tensor(manoeuvre.speed(dt), device=device), sum(sizes), dt)
    simulator = MemoryStepper(model, dt, compile="never")
    states = [
        policy.begin(torch.arange(n, device=device).repeat(VEHICLES))
        for policy, n in zip(policies, sizes, strict=True)
    ]
    follower, parameters = simulator.begin(road.start()), {}
    for frame in range(road.speed.shape[-1] - 1):
        if frame % windows.stride == 0:
            seen = [road.history(frame, windows.length, part) for part in parts]
            answers = [
                policy.act(history, state)
                for policy, history, state in zip(policies, seen, states, strict=True)
            ]
            states = [state for _, state in answers]
            chosen = [
                answer.view(VEHICLES, n, -1) for (answer, _), n in zip(answers, sizes, strict=True)
            ]
            parameters = model.space.unpack(torch.cat(chosen, dim=1).flatten(0, 1))
        follower, _, _ = simulator.advance(follower, road.leader(frame), parameters)
        road.put(frame + 1, follower)
    return [(road.speed[:, part], road.gap[:, part]) for part in parts]


def _table(
    method: str, names: Sequence[str], speed: Tensor, gap: Tensor, dt: float
) -> pd.DataFrame:
    """Returns the drives in long form, single precision."""
    vehicles, platoons, frames = speed.shape
    nobody = torch.full_like(gap[:1], torch.nan)
    vehicle, network, frame = np.indices((vehicles, platoons, frames)).reshape(3, -1)
    return pd.DataFrame(
        {
            "method": method,
            "network": np.asarray(names, dtype=object)[network],
            "vehicle": vehicle.astype(np.int16),
            "time_s": np.round(frame * dt, 6),
            "speed": speed.reshape(-1).float().cpu().numpy(),
            "gap": torch.cat([nobody, gap]).reshape(-1).float().cpu().numpy(),
        }
    )


def _measures(
    method: str, names: Sequence[str], speed: Tensor, gap: Tensor, dt: float
) -> pd.DataFrame:
    """Returns a row per platoon; the columns are those of `Platoon.measures`."""
    cruise = speed[0, 0, 0]
    braking = int((speed[0, 0] < cruise).int().argmax()) - 1
    before, after = slice(max(braking - round(5.0 / dt), 0), braking + 1), slice(braking, None)
    drop = slowing(speed[..., after])
    first, last = drop[1], drop[-1]
    settled = ((speed[..., before] - cruise).abs() <= CALM).all(2).all(0)
    collisions = (gap < 0).any(2).sum(0)
    # How they find their places from the common start is no part of what is measured, unless they collide there.
    counted = torch.ones(speed.shape[-1] - braking, dtype=torch.bool, device=speed.device)
    columns = {
        "drop_leader": drop[0],
        "drop_first": first,
        "drop_last": last,
        # Who does not slow down at all does not follow, and has nothing to amplify; who has driven through another neither.
        "amplification": torch.where(
            (first > TOLERANCE) & (collisions == 0), last / first, torch.nan
        ),
        "head_to_tail": torch.where(collisions == 0, last / drop[0], torch.nan),
        "string_stable": (drop.diff(dim=0) <= TOLERANCE).all(0) & settled & (collisions == 0),
        "settled": settled,
        "min_gap": gap[..., after].amin((0, 2)),
        "collisions": collisions,
        "hard_braking": hard_braking_frames(speed[1:, :, after], counted, dt).sum(0),
    }
    values = {name: np.asarray(column.double().cpu().numpy()) for name, column in columns.items()}
    return pd.DataFrame({"method": method, "network": list(names), **values})


def slowing(speed: Tensor) -> Tensor:
    """Returns by how much each vehicle slows down, m/s: from its highest speed so far to its lowest of all.

    What it overshoots on the way back does not count.

    Args:
        speed: `(*batch, T)`, from the frame on at which the leader begins to brake.
    """
    lowest, when = speed.min(dim=-1)
    highest_so_far = speed.cummax(dim=-1).values.gather(-1, when[..., None])[..., 0]
    return highest_so_far - lowest
