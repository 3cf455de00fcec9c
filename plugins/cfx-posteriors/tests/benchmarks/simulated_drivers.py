"""Drivers with known parameters and noise, simulated without cfx: NumPy and pandas alone.

Equations are written down again from the papers, so that a mistake in cfx's cannot hide. Each driver
follows a recorded leader (I-80), or one that is made up where the recording is absent.

    noise        what is drawn for each driver
    trajectory   AR(1) errors of the speed that is written, 0.15 to 0.5 m/s, 1 to 3 s
    acceleration AR(1) errors of the acceleration that is driven, 0.1 to 0.4 m/s2, 0.5 to 3 s
    measurement  white errors of speed (0.1 to 0.4 m/s) and position (0.2 to 0.8 m) that are written
    both         the last two
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

DT = 0.1
LENGTH = 4.5

PARAMETERS = {
    "idm": {
        "v0": (1.0, 33.33, 70.0),
        "T": (0.1, 1.6, 5.0),
        "s0": (0.1, 2.0, 8.0),
        "a": (0.1, 0.73, 6.0),
        "b": (0.1, 1.67, 6.0),
    },
    "krauss": {"t_r": (0.1, 1.5, 10.0), "t_i": (0.0, 0.15, 2.0)},
    "w99": {
        "cc0": (0.1, 2.5, 5.0),
        "cc1": (0.1, 1.3, 6.0),
        "cc2": (0.5, 8.0, 20.0),
        "cc3": (-30.0, -12.0, -2.0),
        "cc4": (-2.0, -0.25, -0.01),
        "cc5": (0.01, 0.35, 2.0),
        "cc6": (0.0, 6.0, 20.0),
        "cc7": (0.01, 0.25, 1.0),
        "cc8": (0.5, 2.0, 5.0),
    },
    "gipps": {
        "tau": (0.4, 1.0, 2.0),
        "s0": (0.5, 2.0, 5.0),
        "a": (0.5, 1.5, 3.0),
        "b": (1.0, 2.5, 5.0),
        "V": (15.0, 25.0, 40.0),
    },
}
"""Lower bound, default and upper bound of each parameter."""

SPREAD = 1.5
"""Standard deviation of the logit of each parameter between its bounds, around its default: the
prior's. Only then must 90 % intervals hold 90 % of parameters that a recording does not determine
(S. Talts et al. 2018, *Validating Bayesian inference algorithms with simulation-based
calibration*)."""

STRONGEST, HARDEST = 2.6, 9.0
"""Acceleration and deceleration, m/s2, that vehicles of IDM and Krauss can do."""

State = tuple[np.ndarray, np.ndarray, np.ndarray]
Parameters = dict[str, np.ndarray]


def idm(state: State, leader: State, p: Parameters) -> np.ndarray:
    """Returns accelerations: Treiber, Hennecke and Helbing (2000)."""
    x, v, _ = state
    gap = np.maximum(leader[0] - LENGTH - x, 0.1)
    wanted = p["s0"] + np.maximum(
        0.0, v * p["T"] + v * (v - leader[1]) / (2.0 * np.sqrt(p["a"] * p["b"]))
    )
    return p["a"] * (1.0 - (v / p["v0"]) ** 4 - (wanted / gap) ** 2)


def krauss(state: State, leader: State, p: Parameters) -> np.ndarray:
    """Returns accelerations: Krauß (1998) with a brake build-up time (Yang et al. 2021)."""
    x, v, _ = state
    gap, a, b = leader[0] - LENGTH - x, 2.6, 4.5
    lag = p["t_r"] + 0.5 * p["t_i"]
    root = (b * lag) ** 2 + b * (leader[1] * p["t_i"] + leader[1] ** 2 / b + 2.0 * gap)
    safe = np.sqrt(np.maximum(root, 0.0)) - b * lag
    return (np.maximum(np.minimum(np.minimum(v + a * DT, 55.0), safe), 0.0) - v) / DT


def w99(state: State, leader: State, p: Parameters) -> np.ndarray:
    """Returns accelerations: Wiedemann (1999) as SUMO has it, a branch of each case after another."""
    x, v, old = state
    dx, dv = leader[0] - LENGTH - x, leader[1] - v
    found = np.empty_like(v)
    for i in range(len(v)):
        q = {name: float(value[i]) for name, value in p.items()}
        found[i] = _w99(dx[i], dv[i], v[i], old[i], leader[1][i], leader[2][i], q)
    return found


def _w99(
    dx: float, dv: float, v: float, old: float, v_l: float, a_l: float, q: dict[str, float]
) -> float:
    near = q["cc0"] + (q["cc1"] * v if v_l > 0 else 0.0)
    far = near + q["cc2"]
    perceived = far + q["cc3"] * (dv - q["cc4"])
    s = q["cc6"] * dx * dx / 1e4
    close = q["cc4"] - s if v > 0 else 0.0
    opening = s + q["cc5"] if v_l > q["cc5"] else s
    if dv < opening and dx <= near:
        blocked = -9.0 if dx < v * DT + 0.1 * q["cc0"] else 0.0
        if v_l <= 0:
            return blocked
        if dv >= 0:
            a = blocked
        elif dx > q["cc0"]:
            a = min(0.0, a_l + dv * dv / (q["cc0"] - dx))
        else:
            a = min(0.0, a_l + 0.5 * (dv - opening))
        a = -q["cc7"] if a > -q["cc7"] else max(a, -10.0 + 0.5 * np.sqrt(max(v, 0.0)))
    elif dv < close and dx < perceived:
        room = near - dx - 0.1
        a = 0.5 * dv * dv / (room if abs(room) > 1e-9 else 1e-9)
    elif dv < opening and dx < far:
        a = min(old, -q["cc7"]) if old <= 0 else max(old, q["cc7"])
    elif dx > near:
        a = min(dv * dv / (far - dx), q["cc8"]) if dx < far else q["cc8"]
    else:
        a = 0.0
    return float(min(max(a, -9.0), q["cc8"]))


def gipps(state: State, leader: State, p: Parameters) -> np.ndarray:
    """Returns accelerations: Gipps (1981), for drivers whom no parameters of IDM describe.

    At equilibrium the gap is `s0 + 1.5 v tau`.
    """
    x, v, _ = state
    gap, b, tau = leader[0] - LENGTH - x - p["s0"], p["b"], p["tau"]
    share = v / p["V"]
    free = v + 2.5 * p["a"] * tau * (1.0 - share) * np.sqrt(0.025 + share)
    root = (b * tau) ** 2 + b * (2.0 * gap - v * tau + leader[1] ** 2 / b)
    safe = np.sqrt(np.maximum(root, 0.0)) - b * tau
    return (np.maximum(np.minimum(free, safe), 0.0) - v) / tau


MODELS: dict[str, Callable[[State, State, Parameters], np.ndarray]] = {
    "idm": idm,
    "krauss": krauss,
    "w99": w99,
    "gipps": gipps,
}


def leaders(path: Path, count: int, seconds: float) -> np.ndarray:
    """Returns speeds of leaders, `(count, frames)`, m/s."""
    frames = round(seconds / DT) + 1
    if not path.is_file():
        time = np.arange(frames) * DT
        draw = np.random.default_rng(0)
        phase, period = draw.uniform(0, 6.3, (count, 2)), draw.uniform(15, 60, (count, 2))
        waves = np.sin(2 * np.pi * time[:, None, None] / period + phase) * (2.5, 2.5)
        return np.maximum(8.0 + waves.sum(-1).T, 0.0)
    table = pd.read_parquet(path)
    rows = []
    for _, one in table.groupby("pair_id", sort=True):
        speed = one["leader_speed_mps"].to_numpy(float)
        while len(speed) < frames:  # driven there and back again
            speed = np.concatenate([speed, speed[-2::-1]])
        rows.append(speed[:frames])
    return np.stack([rows[number % len(rows)] for number in range(count)])


def ar1(
    draw: np.random.Generator, deviation: np.ndarray, time: np.ndarray, frames: int
) -> np.ndarray:
    """Returns stationary AR(1) noise, `(drivers, frames)`: deviations, and correlation times in s."""
    keep = np.exp(-DT / time)
    found = np.empty((len(time), frames))
    found[:, 0] = deviation * draw.standard_normal(len(time))
    for k in range(1, frames):
        step = np.sqrt(1.0 - keep**2) * deviation * draw.standard_normal(len(time))
        found[:, k] = keep * found[:, k - 1] + step
    return found


def simulate(
    model: str,
    noise: str,
    drivers: int,
    seconds: float,
    *,
    seed: int,
    recording: Path,
    spread: float = SPREAD,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Returns recordings in cfx's tidy layout, and the drivers' parameters."""
    draw = np.random.default_rng(seed)
    p: Parameters = {}
    for name, (low, default, high) in PARAMETERS[model].items():
        logit = np.log((default - low) / (high - default)) + spread * draw.standard_normal(drivers)
        p[name] = low + (high - low) / (1.0 + np.exp(-logit))
    lead_v = leaders(recording, drivers, seconds)
    frames = lead_v.shape[1]
    lead_a = np.gradient(lead_v, DT, axis=1)
    gap = {"idm": lambda v: p["s0"] + v * p["T"], "krauss": lambda v: v * p["t_r"]}
    gap["gipps"] = lambda v: p["s0"] + 1.5 * v * p["tau"]
    gap["w99"] = lambda v: p["cc0"] + p["cc1"] * v + 0.5 * p["cc2"]
    start = np.maximum(gap[model](lead_v[:, 0]), 2.0)
    lead_x = np.cumsum(lead_v * DT, axis=1) - lead_v[:, :1] * DT + LENGTH + start[:, None]

    push = np.zeros((drivers, frames))
    if noise in {"acceleration", "both"}:
        push = ar1(draw, draw.uniform(0.1, 0.4, drivers), draw.uniform(0.5, 3.0, drivers), frames)
    x, v, a = np.zeros(drivers), lead_v[:, 0].copy(), np.zeros(drivers)
    positions, speeds = [x], [v]
    for k in range(frames - 1):
        wanted = MODELS[model]((x, v, a), (lead_x[:, k], lead_v[:, k], lead_a[:, k]), p)
        if model != "w99":  # which has brakes and a cap of its own
            wanted = np.clip(wanted, -HARDEST, STRONGEST)
        room = (lead_x[:, k + 1] - LENGTH - 0.1 - x) / DT  # nobody drives into their leader
        new = np.maximum(np.minimum(v + DT * (wanted + push[:, k]), room), 0.0)
        a, v = (new - v) / DT, new
        x = x + v * DT
        positions.append(x)
        speeds.append(v)
    speed, position = np.stack(speeds, 1), np.stack(positions, 1)
    if noise == "trajectory":
        speed = speed + ar1(
            draw, draw.uniform(0.15, 0.5, drivers), draw.uniform(1, 3, drivers), frames
        )
    if noise in {"measurement", "both"}:
        sizes = draw.uniform(0.1, 0.4, (drivers, 1))
        speed = speed + sizes * draw.standard_normal(speed.shape)
        position = position + 2.0 * sizes * draw.standard_normal(speed.shape)
        # A recording with vehicles inside one another is refused.
        position = np.minimum(position, lead_x - LENGTH - 0.1)
    rows = []
    for i in range(drivers):
        columns = {
            "pair_id": f"{i:03d}",
            "frame": np.arange(frames),
            "time_s": np.arange(frames) * DT,
            "leader_position_m": lead_x[i],
            "leader_speed_mps": lead_v[i],
            "leader_acceleration_mps2": lead_a[i],
            "leader_length_m": LENGTH,
            "follower_position_m": position[i],
            "follower_speed_mps": np.maximum(speed[i], 0.0),
            "follower_acceleration_mps2": np.gradient(speed[i], DT),
        }
        rows.append(pd.DataFrame(columns))
    return pd.concat(rows, ignore_index=True), pd.DataFrame(p)
