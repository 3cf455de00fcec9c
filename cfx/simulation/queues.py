"""Simulated drivers who leave a queue at a light.

A platoon comes to a red light, stands, leaves and drives on; each vehicle is the leader of the
next. No openly licensed recording has a signal, and networks that never saw a queue start let too
few vehicles through. The drivers' parameters are drawn so that the queue has the saturation flow
and the start-up lost time of the *Highway Capacity Manual* (Transportation Research Board, 2016,
chapter 31): 1,700 to 1,950 vehicles/h, and 1.5 to 2.5 s for a first vehicle that starts at once.

Shapes: S platoons, F frames.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from cfx.data.pairs import Pair, PairSet
from cfx.errors import DataError
from cfx.models.idm import IDM
from cfx.simulation.synthetic import LENGTH_M, Floats, differences, simulate_platoons

__all__ = ["QUEUE", "queue_leader_speed", "queue_pairs"]

QUEUE = 12
"""Vehicles behind the first of a queue."""

PARAMETERS = {
    "v0": (16.0, 33.0),
    "s0": (1.5, 3.0),
    "a": (1.6, 2.4),
    "b": (1.5, 2.5),
}
"""Between which IDM's parameters are drawn, in the units of the model."""

TIME_GAP_S, TIME_GAP_SPREAD, TIME_GAPS_S = 1.1, 0.3, (0.6, 2.2)
"""IDM's T: the median, the standard deviation of its logarithm, and the bounds. People of open
recordings differ as much in their time gaps at 10 m/s. Treiber and Kesting (2013, table 11.2) have
T = 1 s, s0 = 2 m, a = 1 m/s2: as many vehicles leave, but the first four lose twice the time that
is usual, since they accelerate slowly; with twice the acceleration T has to be longer."""

_CRUISE_MPS = (8.0, 17.0)  # of streets with lights
_SETTLE_S = 20.0  # behind the first vehicle, before the recording begins
_APPROACH_S = (5.0, 10.0)  # from the beginning to the first vehicle's braking
_BRAKING_MPS2, _ACCELERATION_MPS2 = (1.2, 2.2), (1.3, 2.0)  # of the first vehicle
_RED_S = (10.0, 20.0)  # for which the first vehicle stands
_JERK_MPS3 = 1.5  # how fast its acceleration grows as it leaves


def queue_pairs(count: int, dt: float, frames: int, seed: int) -> PairSet:
    """Simulates drivers in queues.

    Args:
        count: drivers, in platoons of `QUEUE`.
        dt: time step, s.
        frames: of each.
        seed: same seed, same drivers.
    """
    rng = np.random.default_rng(seed)
    platoons = math.ceil(count / QUEUE)
    settle = round(_SETTLE_S / dt)
    first = queue_leader_speed(platoons, frames, dt, rng)
    cruise = np.repeat(first[:, :1], settle, axis=1)
    model = IDM()
    names = model.space.names
    drawn = []
    for name in names:
        if name == "T":
            spread = TIME_GAP_SPREAD * rng.standard_normal((platoons, QUEUE, 1))
            drawn.append((TIME_GAP_S * np.exp(spread)).clip(*TIME_GAPS_S))
        else:
            drawn.append(rng.uniform(*PARAMETERS[name], (platoons, QUEUE, 1)))
    length = rng.uniform(*LENGTH_M, (platoons, QUEUE + 1))
    position, speed, collided = simulate_platoons(
        model,
        torch.from_numpy(np.stack(drawn, -1)),
        torch.from_numpy(np.concatenate([cruise, first], 1)),
        torch.from_numpy(length),
        settle + frames,
        dt,
    )
    if collided:
        raise DataError(f"a simulated driver of a queue collides with seed {seed}; take another")
    acceleration = differences(speed.numpy(), dt)
    signals = {
        "position": position.numpy()[..., settle:],
        "speed": speed.numpy()[..., settle:],
        "acceleration": acceleration[..., settle:],
    }
    pairs = []
    for number in range(count):
        platoon, place = divmod(number, QUEUE)
        columns: dict[str, Any] = {}
        for name, values in signals.items():
            columns[f"leader_{name}"] = np.ascontiguousarray(values[platoon, place])
            columns[f"follower_{name}"] = np.ascontiguousarray(values[platoon, place + 1])
        vehicle = platoon * (QUEUE + 1) + place
        pairs.append(
            Pair(
                pair_id=f"queue {vehicle + 1}",
                recording="queue",
                leader_id=str(vehicle),
                follower_id=str(vehicle + 1),
                first_frame=0,
                dt=dt,
                leader_length=float(length[platoon, place]),
                **columns,
            )
        )
    return PairSet(tuple(pairs), "queues")


def queue_leader_speed(platoons: int, frames: int, dt: float, rng: np.random.Generator) -> Floats:
    """Returns the speed of the first vehicles: they cruise, stop, stand, leave and cruise.

    Accelerations are constant but where they begin: jerk is bounded while a vehicle starts.

    Returns:
        `(S, F)`, m/s.
    """
    cruise = rng.uniform(*_CRUISE_MPS, platoons)
    braking = rng.uniform(*_BRAKING_MPS2, platoons)
    acceleration = rng.uniform(*_ACCELERATION_MPS2, platoons)
    brakes = rng.uniform(*_APPROACH_S, platoons)
    leaves = brakes + cruise / braking + rng.uniform(*_RED_S, platoons)
    speed = np.empty((platoons, frames))
    v, a = cruise.copy(), np.zeros(platoons)
    for frame in range(frames):
        speed[:, frame] = v
        time = frame * dt
        is_stopping = (time >= brakes) & (time < leaves)
        growing = np.minimum(a + _JERK_MPS3 * dt, acceleration)
        a = np.where(is_stopping, -braking, np.where(time >= leaves, growing, 0.0))
        v = np.clip(v + a * dt, 0.0, cruise)
        a = np.where(is_stopping, 0.0, a)
    return speed
