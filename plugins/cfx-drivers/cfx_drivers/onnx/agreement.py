"""How far an exported driver's speeds are from cfx's, in a platoon behind a leader that varies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from cfx.plugin import DriverState, DriverStep, Motion, Signal
from cfx_drivers.onnx.graph import kept_of, signals_of

VEHICLES, STEPS, LENGTH_M = 5, 300, 5.0
FREE = range(200, 220)
"""Steps in which the platoon's first vehicle has nobody ahead."""

Array = NDArray[np.float64]

Run = Callable[[Mapping[str, Array]], Array]


def in_onnx_runtime(graph: bytes) -> Run:
    """Returns what runs an ONNX graph.

    Args:
        graph: the ONNX model.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options)

    def run(given: Mapping[str, Array]) -> Array:
        speed: Array = session.run(["next_speed"], dict(given))[0]
        return speed

    return run


def largest_difference(step: DriverStep, run: Run) -> float:
    """Returns the largest difference of any speed, m/s.

    In each step both get the same: signals, random numbers and what cfx's drivers remember.
    Otherwise rounding in single precision, in which networks are, would add up.

    Args:
        step: cfx's own.
        run: the exported one: takes all inputs by name and returns the next speeds, `(V,)`.
    """
    kept = kept_of(step)
    generator = torch.Generator().manual_seed(0)
    state = step.begin(VEHICLES)
    speed, acceleration = np.full(VEHICLES, 10.0), np.zeros(VEHICLES)
    position = -25.0 * np.arange(1.0, VEHICLES + 1)
    ahead, leader = 0.0, 10.0
    worst = 0.0
    for number in range(STEPS):
        was = leader
        leader = max(0.0, 12.0 + 12.0 * math.sin(0.05 * number))
        ahead += leader * step.dt
        values = [
            speed,
            acceleration,
            np.concatenate([[leader], speed[:-1]]),
            np.concatenate([[(leader - was) / step.dt], acceleration[:-1]]),
            np.concatenate([[ahead], position[:-1]]) - LENGTH_M - position,
        ]
        if number in FREE:
            values[-1][0] = math.inf
        for number_of_signal, signal in enumerate(step.further_signals, 1):
            values.append(_varying(signal, number + number_of_signal))
        noise = torch.randn((VEHICLES, step.noise_width), generator=generator, dtype=torch.float64)
        given = dict(zip(signals_of(step), values, strict=True))
        for name, value in state._asdict().items():
            if name in kept:
                given[name] = value.numpy()
        if step.noise_width:
            given["noise"] = noise.numpy()
        computed = run(given)
        expected, state = _expected(step, state, values, noise)
        difference = float(np.abs(computed - expected).max())
        worst = float(np.maximum(worst, difference))  # NaN, if there is one
        acceleration = (expected - speed) / step.dt
        position = position + expected * step.dt
        speed = expected
    return worst


def _varying(signal: Signal, number: int) -> Array:
    """Returns values of a further signal in its range that change from step to step, `(V,)`."""
    low, high = max(signal.low, -10.0), min(signal.high, 50.0)
    phase = 0.1 * number + np.arange(VEHICLES)
    return np.asarray(low + (high - low) * (0.5 + 0.5 * np.sin(phase)))


def _expected(
    step: DriverStep, state: DriverState, values: list[Array], noise: torch.Tensor
) -> tuple[Array, DriverState]:
    """Returns cfx's next speeds, and what its drivers remember then."""
    v, a, v_l, a_l, gap, *further = (torch.from_numpy(value) for value in values)
    drawn = noise if step.noise_width else None
    names = [signal.name for signal in step.further_signals]
    surroundings = dict(zip(names, further, strict=True))
    speed, state = step(state, Motion(v, a), Motion(v_l, a_l), gap, drawn, surroundings)
    return speed.numpy(), state
