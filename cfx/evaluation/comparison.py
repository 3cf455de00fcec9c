"""Compares jobs pair by pair: which one is closest to the drivers, and is it chance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from cfx.evaluation.headline import lower_by, opposite
from cfx.evaluation.statistics import Improvement, improvement_statistics

_SIGNIFICANT = 0.05
"""p below which a difference counts, corrected for how many are tested."""


class Against(NamedTuple):
    """The best job against another one, over the pairs that both have.

    Attributes:
        best, other: what they are called.
        found: by which share the best one's errors are smaller.
        of_means: by which share its mean error over these pairs is smaller.
        p_value: of the Wilcoxon test, corrected for all comparisons (Holm 1979).
        left_out: pairs that only one of both has.
    """

    best: str
    other: str
    found: Improvement
    of_means: float
    p_value: float
    left_out: int


def against_the_best(errors: Mapping[str, pd.DataFrame]) -> list[Against]:
    """Compares the job with the smallest mean error with each other one, the next best first.

    Args:
        errors: of each job a row per pair: `pair_id`, `driver`, `frames` (that were simulated) and
            `error` (RMSE of speed, m/s). A pair counts where both simulated the same frames.

    Returns:
        Nothing where there are fewer than two jobs that share pairs.
    """
    means = {name: float(table["error"].mean()) for name, table in errors.items()}
    ranked = sorted((mean, name) for name, mean in means.items() if math.isfinite(mean))
    if len(ranked) < 2:
        return []
    best = ranked[0][1]
    compared = []
    for _, other in ranked[1:]:
        both = errors[best].merge(errors[other], on=["pair_id", "frames"], suffixes=("", "_other"))
        if both.empty:
            continue
        before, after = both["error_other"].to_numpy(float), both["error"].to_numpy(float)
        drivers = both["driver"].astype(str).tolist()
        found = improvement_statistics(before, after, drivers, seed=0)
        known = np.isfinite(before) & np.isfinite(after)
        sums = float(before[known].sum()), float(after[known].sum())  # of as many pairs as means
        left_out = len(errors[best]) + len(errors[other]) - 2 * len(both)
        compared.append(Against(best, other, found, lower_by(*sums), found.p_value, left_out))
    corrected = _holm([one.p_value for one in compared])
    return [one._replace(p_value=p) for one, p in zip(compared, corrected, strict=True)]


def _holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for how many there are, by the step-down method of Holm."""
    corrected = list(p_values)
    highest = 0.0
    for place, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        highest = max(highest, min(1.0, p_values[index] * (len(p_values) - place)))
        corrected[index] = highest
    return corrected


def verdict(compared: Sequence[Against]) -> str:
    """Returns in one sentence which job is closest to the drivers; "" if nothing was compared."""
    if not compared:
        return ""
    least = compared[0]
    ahead = [one for one in compared if one.p_value < _SIGNIFICANT and one.found.mean > 0]
    text = f"Closest to the drivers: {least.best}"
    if not ahead:
        text += ", but not significantly"
    elif len(ahead) == len(compared):
        text += ", significantly"
    else:
        text += f", significantly closer than {len(ahead)} of {len(compared)} others"
    found = least.found
    interval = "one driver"
    if math.isfinite(found.ci95_low):
        interval = f"{100 * found.ci95_low:+.1f} to {100 * found.ci95_high:+.1f}"
    otherwise = opposite(found.mean, least.of_means)
    if otherwise:
        interval += f"; {otherwise}"
    text += (
        f"; over the next best, {least.other}, {100 * found.mean:+.1f} % ({interval}), better for"
        f" {found.win_rate * found.pairs:.0f} of {found.pairs} pairs, p = {least.p_value:.2g}"
    )
    if len(compared) > 1:
        text += " after Holm"
    if least.left_out:
        text += f"; {least.left_out} pairs that only one of both has do not count"
    return f"{text}."
