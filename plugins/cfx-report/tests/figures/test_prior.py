"""The curve that the prior's strength was chosen from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfx.results.result import Result
from cfx_report.figures.prior import PriorStrengths
from cfx_report.runs import read_runs
from tests.job_folders import write_job

CHOICE = {"weight": 0.2, "pairs": 3, "held_out_error": {"0.1": 0.6, "0.3": 0.5, "1": 0.7}}


@pytest.fixture
def result(tmp_path: Path) -> Result:
    write_job(tmp_path / "job", pairs=3)
    (job,) = read_runs([str(tmp_path / "job")]).jobs
    return job


def test_it_shows_what_was_tried_and_what_was_taken(result: Result) -> None:
    chosen = replace(result, data={**result.data, "priors": [CHOICE], "objective": {"unit": "m/s"}})
    figure = PriorStrengths().draw(chosen)
    assert figure is not None
    (axes,) = figure.axes
    curve, taken = axes.lines
    assert np.asarray(curve.get_xdata()).tolist() == [0.1, 0.3, 1.0]
    assert np.asarray(curve.get_ydata()).tolist() == [0.6, 0.5, 0.7]
    assert np.asarray(taken.get_xdata())[0] == 0.2
    assert axes.get_ylabel() == "held-out error (m/s)"


def test_nothing_is_drawn_where_nothing_was_chosen(result: Result) -> None:
    untried = {"weight": 0.01, "pairs": 0, "held_out_error": {"0.1": float("nan")}}
    for priors in ([], [untried]):
        assert (
            PriorStrengths().draw(replace(result, data={**result.data, "priors": priors})) is None
        )
