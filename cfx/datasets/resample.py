"""Bringing recordings to another time step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cfx.pairs import SIGNALS, Dropped, Pair, PairSet

_ROUNDING = 1e-6
"""Of a step: by so much a recording's last frame may fall short of a frame of the new step and still make one."""


def resampled(pairs: PairSet, step: float) -> PairSet:
    """Returns the same drives in frames `step` seconds apart; pairs that have this step already as they are.

    Between frames every signal is interpolated by a monotone cubic (Fritsch and Butland 1984, SciPy's `PchipInterpolator`),
    which overshoots nowhere: nobody reverses, and no speed is above the fastest one recorded. What is faster than the new step
    is not filtered out before. True parameters are those of the last frame before. A drive ends at its last new frame; one
    with fewer than two is left out and counted.

    Args:
        step: s.
    """
    kept = [one for pair in pairs if (one := _pair(pair, step)) is not None]
    lost = len(pairs) - len(kept)
    dropped = (Dropped(f"shorter than two steps of {step:g} s", lost),) if lost else ()
    return replace(pairs, pairs=tuple(kept), dropped=(*pairs.dropped, *dropped))


def _pair(pair: Pair, step: float) -> Pair | None:
    if np.isclose(pair.dt, step, rtol=0, atol=1e-9):
        return pair
    from scipy.interpolate import PchipInterpolator

    last = len(pair) - 1
    at = np.arange(int(last * pair.dt / step + _ROUNDING) + 1) * (
        step / pair.dt
    )  # in recorded frames
    if len(at) < 2:
        return None
    at = at.clip(max=last)
    signals = np.stack([np.asarray(getattr(pair, name), dtype=np.float64) for name in SIGNALS])
    values = PchipInterpolator(np.arange(len(pair)), signals, axis=1)(at)
    before = np.floor(at + _ROUNDING).astype(np.int64)
    return replace(
        pair,
        dt=step,
        **dict(zip(SIGNALS, values, strict=True)),
        truth={name: np.asarray(value)[before] for name, value in pair.truth.items()},
    )
