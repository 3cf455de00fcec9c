"""Small drives that tests build."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from cfx.data.pairs import Pair, PairSet
from cfx.evaluation.closed_loop import Followers
from cfx.evaluation.forecasts import LeaderFuture, Origins, Paths, sample_from_origins
from cfx.models.base import DrivingModel, Leader
from cfx.policies.agent import Agent
from cfx.simulation.base import Stepper
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.trajectory import Start


def straight_pairs(frames: Sequence[int], speed: float = 10.0) -> PairSet:
    """Followers 20 m behind leaders at constant speed, one pair for each number of frames."""
    return PairSet(
        tuple(_straight(f"p{i}", count, speed) for i, count in enumerate(frames)), "test"
    )


def _straight(name: str, frames: int, speed: float) -> Pair:
    time = np.arange(frames) * 0.1
    zero, constant = np.zeros(frames), np.full(frames, speed)
    return Pair(
        name,
        "test",
        "1",
        name,
        0,
        0.1,
        5.0,
        25 + speed * time,
        constant,
        zero,
        speed * time,
        constant,
        zero,
    )


def wavy_pairs(
    model: DrivingModel, parameters: torch.Tensor, frames: int = 300, seed: int = 0
) -> PairSet:
    """Followers with `parameters` `(pairs, n)`, behind leaders that brake and accelerate."""
    generator = np.random.default_rng(seed)
    count = len(parameters)
    time = np.arange(frames) * 0.1
    phase, period = generator.uniform(0, 6, (count, 1)), generator.uniform(12, 25, (count, 1))
    leader_speed = np.clip(
        9
        + 6 * np.sin(2 * np.pi * time / period + phase)
        + 2 * np.sin(2 * np.pi * time / 7 + phase),
        0.2,
        None,
    )
    position = (
        np.concatenate([np.zeros((count, 1)), np.cumsum(leader_speed[:, 1:] * 0.1, axis=1)], axis=1)
        + 30
    )
    acceleration = np.gradient(leader_speed, 0.1, axis=1)
    leader = Leader(
        *(torch.as_tensor(x) for x in (position, leader_speed, acceleration)),
        torch.full((count,), 5.0, dtype=torch.float64),
    )
    zeros = torch.zeros(count, dtype=torch.float64)
    out = simulate_follower(
        model, parameters, leader, Start(zeros, torch.as_tensor(leader_speed[:, 0]), zeros), 0.1
    )
    speed = out.speed.numpy()
    own = np.diff(speed, axis=1, prepend=speed[:, :1]) / 0.1
    return PairSet(
        tuple(
            Pair(
                f"p{i}",
                "test",
                "0",
                str(i),
                0,
                0.1,
                5.0,
                position[i],
                leader_speed[i],
                acceleration[i],
                out.position[i].numpy(),
                speed[i],
                own[i],
            )
            for i in range(count)
        ),
        "test",
    )


def simulate_from_origins(
    stepper: Stepper,
    agent: Agent,
    followers: Followers,
    origins: Origins,
    steps: int,
    *,
    leader: LeaderFuture = "given",
) -> Paths:
    """Simulates followers from origins on, where nothing is drawn."""
    found = sample_from_origins(stepper, agent, followers, origins, steps, leader=leader)
    return Paths(found.speed[0], found.travelled[0])
