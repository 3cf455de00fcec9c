"""Brings recorded signals to another time step or scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cfx.data.pairs import Dropped, Pair, PairSet
from cfx.data.signals import RECORDED

_ROUNDING = 1e-6
"""Share of a step by which a recording may end before a frame of the new step and still have it."""

COARSE_S = 0.15
"""Time step above which calibrated parameters are biased noticeably (docs/readers.md)."""


def resampled(pairs: PairSet, step: float) -> PairSet:
    """Returns the same trajectories in frames `step` seconds apart.

    Pairs that have this step already stay as they are. Between frames every signal is interpolated
    by a monotone cubic (Fritsch and Butland 1984, SciPy's `PchipInterpolator`), which does not
    overshoot: no speed is negative or above the fastest recorded one. Signals are not low-pass
    filtered before. True parameters are those of the last frame before. A
    trajectory ends at its last new frame; one with fewer than two is left out and counted.

    Args:
        step: s.
    """
    resampled_pairs = pairs.changed(lambda pair: _pair(pair, step))
    lost = len(pairs) - len(resampled_pairs)
    if not lost:
        return resampled_pairs
    dropped = Dropped(f"shorter than two steps of {step:g} s", lost)
    return replace(resampled_pairs, dropped=(*pairs.dropped, dropped))


def frames_in_steps(frames: int, dt: float, step: float) -> int:
    """Returns how many frames a trajectory has in another step.

    Args:
        frames: recorded, `dt` seconds apart.
        dt, step: s.
    """
    return int((frames - 1) * dt / step + _ROUNDING) + 1


def _pair(pair: Pair, step: float) -> Pair | None:
    """Returns one pair in the new step; None if it has fewer than two frames then."""
    if np.isclose(pair.dt, step, rtol=0, atol=1e-9):
        return pair
    from scipy.interpolate import PchipInterpolator

    frames = frames_in_steps(len(pair), pair.dt, step)
    if frames < 2:
        return None
    at = np.arange(frames) * (step / pair.dt)  # in recorded frames
    at = at.clip(max=len(pair) - 1)  # the last one may lie behind the recording by rounding
    recorded = []
    for name in RECORDED:
        recorded.append(np.asarray(getattr(pair, name), dtype=np.float64))
    for values in pair.surroundings.values():
        recorded.append(np.asarray(values, dtype=np.float64))
    # The interpolator divides by slopes; an infinite quotient of a slope near 0 makes the slope 0.
    with np.errstate(over="ignore"):
        values = PchipInterpolator(np.arange(len(pair)), np.stack(recorded), axis=1)(at)
    signals = dict(zip(RECORDED, values[: len(RECORDED)], strict=True))
    surroundings = dict(zip(pair.surroundings, values[len(RECORDED) :], strict=True))
    before = np.floor(at + _ROUNDING).astype(np.int64)
    truth = {name: np.asarray(value)[before] for name, value in pair.truth.items()}
    return replace(pair, dt=step, truth=truth, surroundings=surroundings, **signals)


def scaled(pairs: PairSet, factor: float) -> PairSet:
    """Returns pairs with all distances, speeds and accelerations multiplied by a factor.

    Time and vehicles' lengths stay as they are, so every gap is multiplied too.
    """
    if factor == 1.0:
        return pairs

    def scale(pair: Pair) -> Pair:
        signals = {name: getattr(pair, name) * factor for name in RECORDED}
        # The leader's rear bumper is scaled, then its length added again.
        signals["leader_position"] = signals["leader_position"] + pair.leader_length * (1 - factor)
        surroundings = {}
        for signal, values in pair.surroundings.items():
            surroundings[signal] = values
            if signal.is_scaled:
                surroundings[signal] = values * factor
        return replace(pair, **signals, surroundings=surroundings)

    source = f"{pairs.source}, {factor:g} times as fast"
    return replace(pairs.changed(scale), source=source)
