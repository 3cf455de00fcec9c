"""What is claimed where nothing differs: the level of intervals and of verdicts, simulated.

Two policies are equally good, and their errors differ by noise: the logarithm of the ratio of a
driver's two errors is normal. The table stands in `docs/method.md`.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cfx.evaluation.statistics import improvement_statistics, ranking_of, verdict
from tests.checkout import ROOT

pytestmark = pytest.mark.slow

REPETITIONS = 10_000
FAMILIES = 1_000


def test_the_interval_of_equal_policies_excludes_zero_in_five_percent() -> None:
    """Ten thousand repetitions know a share of 5 % to 0.22 points: 4 to 6 % is five times that."""
    lines = []
    for noise in (0.12, 0.25, 0.5):
        for drivers in (5, 10, 20, 71):
            rng = np.random.default_rng(0)
            ratios = np.exp(rng.normal(0.0, noise, (REPETITIONS, drivers)))
            excludes, geometric, mean_ratio = 0, 0.0, 0.0
            for repetition in ratios:
                found = improvement_statistics(np.ones(drivers), repetition)
                excludes += found.ci95_low > 0 or found.ci95_high < 0
                geometric += found.geometric / REPETITIONS
                mean_ratio += found.mean_ratio / REPETITIONS
            share = excludes / REPETITIONS
            assert 0.04 < share < 0.06, f"{drivers} drivers, noise {noise}"
            lines.append(
                f"| {noise:g} | {drivers} | {share:.1%} | {geometric:+.1%} | {mean_ratio:+.1%} |"
            )
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    assert "\n".join(lines) in page, "\n".join(lines)


def test_the_best_of_equal_jobs_is_called_closer_in_at_most_five_percent() -> None:
    lines = []
    for count in (2, 4, 8):
        for drivers in (10, 71):
            rng = np.random.default_rng(count)
            wrong = 0
            for _ in range(FAMILIES):
                level = rng.normal(0.0, 0.3, drivers)  # of a driver, whoever drives
                logarithms = level + rng.normal(0.0, 0.25, (count, drivers))
                ids = [str(number) for number in range(drivers)]
                errors = {}
                for number, values in enumerate(np.exp(logarithms)):
                    table = {"pair_id": ids, "driver": ids, "frames": 1, "error": values}
                    errors[f"job {number}"] = [pd.DataFrame(table)]
                wrong += ", but not significantly" not in verdict(ranking_of(errors))
            # Of 1,000 families 5 % are 50; 71 are three standard deviations more.
            assert wrong <= 71, f"{count} jobs, {drivers} drivers"
            lines.append(f"| {count} | {drivers} | {wrong / FAMILIES:.1%} |")
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    assert "\n".join(lines) in page, "\n".join(lines)
