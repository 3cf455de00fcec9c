"""Jobs that differ in the seed alone share a row, and no lucky seed is picked."""

from __future__ import annotations

import numpy as np
import pytest

from cfx_report.jobs import Runs
from cfx_report.names import rows_over_seeds
from cfx_report.page import summary
from cfx_report.runs import read_runs
from cfx_report.sections.comparison import SeedsSection, over_seeds
from tests.job_folders import ACROSS, write_job

SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """A policy and a calibration of two models, each with three seeds."""
    tmp_path = tmp_path_factory.mktemp("seeds")
    for model in ("krauss", "w99"):
        for policy in ("gru", "fixed"):
            for seed in SEEDS:
                settings = {"policy": {"name": policy}, "seed": seed}
                folder = tmp_path / f"{model}-{policy}-{seed}"
                write_job(folder, model=model, methods=ACROSS, seed=seed, settings=settings)
    return read_runs([str(tmp_path)])


def test_a_row_has_the_mean_over_seeds_and_their_range(runs: Runs) -> None:
    rows = rows_over_seeds(runs.jobs)
    assert [row.name for row in rows] == [
        "krauss · fixed",
        "krauss · gru",
        "w99 · fixed",
        "w99 · gru",
    ]
    sheet = over_seeds(rows)
    headings = [column.heading for column in sheet.columns]
    gains = rows[1].improvements("geometric", "driver_specific")
    assert len(gains) == len(SEEDS)
    cell = sheet.rows[1][headings.index("over driver-specific")]
    assert float(cell.sort) == pytest.approx(np.mean(gains))
    assert cell.second.count(" to ") == 1
    # A calibration has no policy's error and no improvement.
    assert sheet.rows[0][headings.index("policy")].sort == ""
    assert sheet.rows[0][headings.index("over driver-specific")].sort == ""
    assert sum(count for _, count in sheet.groups) == len(headings)


def test_the_summary_names_the_best_over_seeds(runs: Runs) -> None:
    (said,) = [line for line in summary(runs.jobs) if line.startswith("Closest to the drivers")]
    assert "krauss · gru" in said
    assert "seed" not in said


def test_jobs_without_seeds_of_their_own_have_no_such_section(runs: Runs) -> None:
    different = tuple(job for job in runs.jobs if job.config["seed"] == 1)
    assert len(different) == 4
    assert SeedsSection().context(Runs(different, ())) is None
    assert SeedsSection().context(runs) is not None
