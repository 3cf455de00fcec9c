"""Jobs are compared pair by pair, and what chance explains is not called a difference."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from cfx.evaluation.statistics import against_the_best, verdict

PAIRS = 40


def errors(scale: float, noise: float, seed: int, pairs: int = PAIRS) -> pd.DataFrame:
    random = np.random.default_rng(seed)
    own = np.random.default_rng(9).uniform(0.5, 1.5, PAIRS)[:pairs]
    names = [f"p{number}" for number in range(pairs)]
    drawn = scale * own * np.exp(noise * random.standard_normal(pairs))
    return pd.DataFrame({"pair_id": names, "driver": names, "frames": 100, "error": drawn})


def test_the_best_is_named_with_its_lead_over_the_next() -> None:
    jobs = {"model=a": errors(1.0, 0.05, 0), "model=b": errors(0.8, 0.05, 1)}
    (one,) = against_the_best(jobs)
    assert (one.best, one.other) == ("model=b", "model=a")
    assert one.found.mean == pytest.approx(0.2, abs=0.03)
    text = verdict([one])
    assert text.startswith("Closest to the drivers: model=b, significantly; over the next best")
    assert f"of {PAIRS} pairs" in text


def test_a_difference_within_chance_is_not_significant() -> None:
    jobs = {"a": errors(1.0, 0.3, 0), "b": errors(1.01, 0.3, 1), "c": errors(2.0, 0.1, 2)}
    first, second = against_the_best(jobs)
    assert first.p_value > 0.05 > second.p_value
    text = verdict([first, second])
    assert "significantly closer than 1 of 2 others" in text
    assert "after Holm" in text


def test_several_comparisons_are_corrected() -> None:
    many = {str(number): errors(1.0 + 0.01 * number, 0.1, number) for number in range(6)}
    alone = against_the_best({name: many[name] for name in ("0", "1")})
    together = against_the_best(many)
    assert together[-1].p_value >= together[-1].found.p_value
    assert alone[0].p_value == alone[0].found.p_value


def test_only_pairs_with_the_same_frames_count() -> None:
    longer = errors(1.2, 0.1, 1).assign(frames=200)
    assert against_the_best({"a": errors(1.0, 0.1, 0), "b": longer}) == []
    (one,) = against_the_best({"a": errors(1.0, 0.1, 0), "b": errors(1.2, 0.1, 1, pairs=30)})
    assert (one.found.pairs, one.left_out) == (30, 10)
    assert "10 pairs that only one of both has do not count" in verdict([one])
    assert verdict([]) == ""


def test_means_that_say_the_opposite_are_told() -> None:
    a = errors(1.0, 0.0, 0)
    b = a.assign(error=0.7 * a["error"])
    b.loc[0, "error"], a.loc[0, "error"] = 1.0, 0.03
    (one,) = against_the_best({"a": a, "b": b})
    assert one.best == "b"
    assert one.found.mean < 0 < one.of_means
    said = f"mean of the pairs' improvements; of the mean RMSE {100 * one.of_means:+.1f} %"
    assert said in verdict([one])


def test_jobs_without_any_error_are_not_said_to_disagree() -> None:
    perfect = errors(1.0, 0.0, 0).assign(error=0.0)
    (one,) = against_the_best({"a": perfect, "b": perfect})
    assert math.isnan(one.of_means)
    assert "of the mean RMSE" not in verdict([one])
