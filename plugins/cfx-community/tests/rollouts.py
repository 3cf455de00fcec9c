"""Followers of a leader with a smooth speed: by cfx in steps, by SciPy as an equation."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from scipy.integrate import solve_ivp

from cfx.plugin import DrivingModel, Leader, Start
from cfx.simulation.rollout import simulate_follower

LENGTH = 5.0
MEAN, SWING, PACE = 14.0, 3.0, 0.25  # the leader's speed is MEAN + SWING sin(PACE t), m/s
END = 40.0  # s

Acceleration = Callable[[float, float, float, Mapping[str, float]], float]
"""dv/dt, m/s2, of the gap, the speed and the leader's speed."""


def leader_position(t: float | np.ndarray) -> float | np.ndarray:
    return MEAN * t + SWING / PACE * (1.0 - np.cos(PACE * t))


def leader_speed(t: float | np.ndarray) -> float | np.ndarray:
    return MEAN + SWING * np.sin(PACE * t)


def stepped(
    model: DrivingModel, p: Mapping[str, float], gap: float, speed: float, dt: float
) -> np.ndarray:
    """Returns the follower's speeds at every step until END."""
    t = np.arange(round(END / dt) + 1) * dt
    ahead = (leader_position(t), leader_speed(t), SWING * PACE * np.cos(PACE * t))
    leader = Leader(
        *(torch.from_numpy(values)[None] for values in ahead),
        torch.tensor([LENGTH], dtype=torch.float64),
    )
    begin = Start(
        *(torch.tensor([value], dtype=torch.float64) for value in (-LENGTH - gap, speed, 0.0))
    )
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in p.items()}
    return simulate_follower(model, values, leader, begin, dt).speed[0].numpy()


def integrated(
    acceleration: Acceleration, p: Mapping[str, float], gap: float, speed: float, times: np.ndarray
) -> np.ndarray:
    """Returns the speeds of the continuous model, by a Runge-Kutta method of order 8."""

    def slope(t: float, state: np.ndarray) -> tuple[float, float]:
        x, v = state
        return v, acceleration(float(leader_position(t)) - LENGTH - x, v, float(leader_speed(t)), p)

    found = solve_ivp(
        slope,
        (0.0, END),
        (-LENGTH - gap, speed),
        method="DOP853",
        t_eval=times,
        rtol=1e-10,
        atol=1e-10,
    )
    assert found.success, found.message
    return found.y[1]


def order(
    model: DrivingModel,
    acceleration: Acceleration,
    p: Mapping[str, float],
    gap: float,
    speed: float,
) -> float:
    """Returns the order of convergence to the continuous model."""
    errors = []
    for dt in (0.1, 0.05, 0.025):
        exact = integrated(acceleration, p, gap, speed, np.arange(round(END / dt) + 1) * dt)
        errors.append(np.abs(stepped(model, p, gap, speed, dt) - exact).max())
    assert errors[0] < 0.2, f"far from the differential equation: {errors}"
    return float(np.log2(errors[0] / errors[2]) / 2)
