"""The loops that a student would write: one driver, one candidate, one step after the other.

Equations by hand, the loss accumulated on the fly, compiled by numba, one thread. They are what
`test_calibration_benchmark.py` measures the compiled models against, and what `optimum.py` checks
their losses and optima with; nothing else uses them.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

FASTEST, HARDEST = 2.6, 9.0
"""Largest acceleration and hardest braking of any vehicle, m/s2: those of cfx's models."""

_jit = numba.njit(cache=False, fastmath=False, error_model="numpy")


@_jit
def _krauss(v: float, gap: float, v_l: float, a_l: float, a: float, dt: float, p: Any) -> float:
    t_r, t_i, accel, b, v_max, min_gap, _, b_l = p
    g = gap - min_gap
    lag = t_r + 0.5 * t_i
    radicand = b * b * lag * lag + b * (v_l * t_i + v_l * v_l / b_l + 2.0 * g)
    safe = math.sqrt(max(radicand, 0.0)) - b * lag
    return max(min(v + accel * dt, v_max, safe), 0.0)


@_jit
def _idm(v: float, gap: float, v_l: float, a_l: float, a: float, dt: float, p: Any) -> float:
    v0, headway, s0, accel, b, delta = p
    wanted = s0 + max(0.0, v * headway + v * (v - v_l) / (2.0 * math.sqrt(accel * b)))
    crowding = wanted / max(gap, 0.1)
    return max(v + accel * (1.0 - (v / v0) ** delta - crowding * crowding) * dt, 0.0)


@_jit
def _gipps(v: float, gap: float, v_l: float, a_l: float, a: float, dt: float, p: Any) -> float:
    tau, desired, accel, b, b_hat, s0 = p
    ratio = v / desired
    free = v + 2.5 * accel * tau * (1.0 - ratio) * math.sqrt(0.025 + ratio)
    room = 2.0 * (gap - s0) - v * tau + v_l * v_l / b_hat
    safe = math.sqrt(max(b * b * tau * tau + b * room, 0.0)) - b * tau
    return max(v + (min(free, safe) - v) * min(dt / tau, 1.0), 0.0)


@_jit
def _w99(v: float, gap: float, v_l: float, a_l: float, a: float, dt: float, p: Any) -> float:
    cc0, cc1, cc2, cc3, cc4, cc5, cc6, cc7, cc8, cc9, decel, hardest, v_max = p
    dv = v_l - v
    near = cc0 + cc1 * v if v_l > 0.0 else cc0
    far = near + cc2
    perceived = far + cc3 * (dv - cc4)
    sensitivity = cc6 * gap * gap * 1e-4
    closing = cc4 - sensitivity if v > 0.0 else 0.0
    opening = sensitivity + cc5 if v_l > cc5 else sensitivity
    wanted = cc8 + cc9 * min(v, 80.0 / 3.6)
    cap = cc8
    if dv < opening and gap <= near:
        acceleration = _too_close(v, gap, v_l, a_l, dv, opening, cc0, cc7, hardest, dt)
    elif dv < closing and gap < perceived:
        room = near - gap - 0.1
        acceleration = 0.5 * dv * dv / room if abs(room) > 0.0 else 0.0
    elif dv < opening and gap < far:
        acceleration = min(a, -cc7) if a <= 0.0 else max(a, cc7)
    elif gap > near:
        acceleration = min(dv * dv / (far - gap), wanted) if gap < far else wanted
    else:
        acceleration = 0.0
    plan = min(v + cap * dt, v_max, v + acceleration * dt)
    floor = min(max(v - decel * dt, 0.0), max(v - hardest * dt, 0.0))
    speed = max(plan, floor)
    return 0.0 if abs(speed) < 1e-5 else speed


@_jit
def _too_close(
    v: float,
    gap: float,
    v_l: float,
    a_l: float,
    dv: float,
    opening: float,
    cc0: float,
    cc7: float,
    hardest: float,
    dt: float,
) -> float:
    blocked = -hardest if gap < v * dt + 0.1 * cc0 else 0.0
    if v_l <= 0.0:
        return blocked
    if dv < 0.0:
        brake = a_l + (dv * dv / (cc0 - gap) if gap > cc0 else 0.5 * (dv - opening))
        brake = min(brake, 0.0)
    else:
        brake = blocked
    if brake > -cc7:
        return -cc7
    return max(brake, 0.5 * math.sqrt(v) - 10.0)


def loop_of(step: Any) -> Any:
    """Returns the loop over drivers, candidates and steps that gives RMSE of speed `(P, q)`."""

    @_jit
    def loop(
        leader_x: Any,
        leader_v: Any,
        leader_a: Any,
        length: Any,
        start_x: Any,
        start_v: Any,
        start_a: Any,
        measured: Any,
        steps: Any,
        candidates: Any,
        dt: float,
    ) -> Any:
        drivers, count = len(steps), len(candidates)
        losses = np.empty((drivers, count))
        for i in range(drivers):
            for c in range(count):
                x, v, a, total = start_x[i], start_v[i], start_a[i], 0.0
                for t in range(steps[i]):
                    gap = leader_x[i, t] - length[i] - x
                    wanted = step(v, gap, leader_v[i, t], leader_a[i, t], a, dt, candidates[c])
                    after = min(max(wanted, v - HARDEST * dt, 0.0), v + FASTEST * dt)
                    a = (after - v) / dt
                    v = after
                    x += v * dt
                    total += (v - measured[i, t]) ** 2
                losses[i, c] = math.sqrt(total / steps[i])
        return losses

    return loop


LOOPS = {
    "krauss": loop_of(_krauss),
    "idm": loop_of(_idm),
    "gipps": loop_of(_gipps),
    "w99": loop_of(_w99),
}
