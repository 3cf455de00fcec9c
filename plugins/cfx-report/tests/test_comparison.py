"""All jobs side by side: their errors, their safety, their platoons, and what history is worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from cfx.evaluation.result import Purpose
from cfx.results.result import Result
from cfx_report.page import render, summary
from cfx_report.runs import read_runs
from cfx_report.section import Sheet
from cfx_report.sections.comparison import absolute, closeness, safety
from cfx_report.sections.results import safety_of_methods
from tests.browser import Browser
from tests.job_folders import ACROSS, write_job

from .rendered import page_of

Jobs = tuple[Sequence[Result], dict[str, dict[str, float | None]]]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two models that follow, and one that is set its acceleration."""
    folder = tmp_path_factory.mktemp("sweep")
    for seed, model in enumerate(("krauss", "w99", "direct")):
        write_job(
            folder / model,
            model=model,
            methods=ACROSS,
            seed=seed,
            purpose=Purpose.POLICY if model == "direct" else Purpose.ADAPTATION,
            further=True,
        )
    return folder


def cells(sheet: Sheet, job: str) -> dict[str, list[str]]:
    """Returns the texts of a job's row by heading, with the second lines."""
    (row,) = (row for row in sheet.rows if row[0].text == job)
    found: dict[str, list[str]] = {}
    for column, cell in zip(sheet.columns, row, strict=True):
        found.setdefault(column.heading, []).append(f"{cell.text} {cell.second}".strip())
    return found


def test_errors_of_all_jobs_stand_in_one_table_in_metres(sweep: Path) -> None:
    jobs = read_runs([str(sweep)]).jobs
    sheet = closeness(jobs)
    for job in jobs:
        row = cells(sheet, job.name)
        expected = []
        for where in ("", "full_trajectory/"):
            speed = job.metrics[f"{where}rmse_speed/policy"]
            gap = job.metrics[f"{where}rmse_gap/policy"]
            expected.append(f"{speed:.3f} {gap:.2f}")
        assert row["policy"] == expected
        if job.purpose is Purpose.ADAPTATION:
            assert row["driver-specific"] == [
                f"{job.metrics['rmse_speed/driver_specific']:.3f} {job.metrics['rmse_gap/driver_specific']:.2f}"
            ]
            assert row["over driver-specific"][0].startswith(
                f"{100 * job.metrics['improvement/rmse_speed/driver_specific/geometric']:+.1f} %".replace(
                    "-", "\u2212"
                )
            )
    assert sum(span for _, span in sheet.groups) == len(sheet.columns)


@pytest.mark.usefixtures("blank_figures")
def test_jobs_with_and_without_a_baseline_stand_in_one_report(tmp_path: Path) -> None:
    """A shrunk set is a baseline of jobs that learn by rollout alone."""
    write_job(tmp_path / "rollout", model="krauss", methods=(*ACROSS, "shrunk"), seed=0)
    write_job(tmp_path / "imitation", model="w99", methods=ACROSS, seed=1)
    runs = read_runs([str(tmp_path)])
    sheet, page = closeness(runs.jobs), render(runs)
    with_base, without = (
        next(job for job in runs.jobs if ("shrunk" in job.methods) is there)
        for there in (True, False)
    )
    assert cells(sheet, with_base.name)["shrunk"][0].startswith(
        f"{with_base.metrics['rmse_speed/shrunk']:.3f}"
    )
    assert set(cells(sheet, without.name)["shrunk"]) == {"\N{EN DASH}"}
    assert "shrunk towards the default" in page


def test_the_best_is_marked_where_the_pairs_are_the_same(sweep: Path, tmp_path: Path) -> None:
    jobs = read_runs([str(sweep)]).jobs
    best = min(jobs, key=lambda job: job.metrics["rmse_speed/policy"])
    marked = [row[0].text for row in closeness(jobs).rows if row[4].best]
    assert marked == [best.name]
    write_job(tmp_path / "0", pairs=4)
    write_job(tmp_path / "1", pairs=5, seed=1)
    others = closeness(read_runs([str(tmp_path)]).jobs)
    assert not [cell for row in others.rows for cell in row if cell.best]


def test_constant_parameters_of_a_model_that_does_not_follow_are_compared_with_nowhere(
    sweep: Path,
) -> None:
    jobs = read_runs([str(sweep)]).jobs
    (direct,) = (job for job in jobs if job.component("model") == "direct")
    row = cells(closeness(jobs), direct.name)
    assert {
        *row["default"],
        *row["pooled"],
        *row["driver-specific"],
        *row["over driver-specific"],
    } == {"\u2013"}
    assert direct.baselines() == ()
    said = " ".join(summary(jobs))
    assert "direct: the policy sets the acceleration itself. RMSE of speed" in said
    assert "direct: yes" not in said
    assert {row[1].text for row in safety_of_methods([direct]).rows} == {"real", "policy"}


@pytest.mark.usefixtures("blank_figures")
def test_a_report_of_such_a_job_alone_has_no_comparison_with_fixed_parameters(
    tmp_path: Path,
) -> None:
    write_job(
        tmp_path / "job",
        model="direct",
        pairs=4,
        methods=ACROSS,
        purpose=Purpose.POLICY,
        further=True,
    )
    page = page_of(tmp_path)
    assert {"comparison", "safety", "history", "trajectories"} <= set(page.having("id"))
    assert not {"drivers", "clusters"} & set(page.having("id"))
    assert "over fixed;" not in page.words


def test_safety_is_told_of_the_policy_and_below_it_of_a_baseline(sweep: Path) -> None:
    jobs = read_runs([str(sweep)]).jobs
    row = cells(safety(jobs), "krauss")
    assert row["Hard braking"] == ["8 8"]
    assert row["full trajectory"] == ["0 0", "16 16"]
    assert row["Jerk (m/s\u00b3)"] == ["2.50 2.50"]
    assert row["At bounds"] == ["25 % 25 %"]
    assert row["Amplification"] == [f"{(0.9**10 + 1) / 2:.2f} {(0.9**10 + 1) / 2:.2f}"]
    assert row["Least gap (m)"] == ["\u22125.0 \u22125.0"]
    assert cells(safety(jobs), "direct")["Hard braking"] == ["8"]


@pytest.mark.usefixtures("blank_figures")
def test_jobs_of_an_older_version_have_a_page_without_what_they_did_not_measure(
    tmp_path: Path,
) -> None:
    write_job(tmp_path / "job", pairs=4)
    jobs = read_runs([str(tmp_path)]).jobs
    assert [column.heading for column in safety(jobs).columns] == ["Job", "Collisions"]
    page = page_of(tmp_path)
    assert "history" not in page.having("id")
    assert "Ten followers in a row" not in page.words


def test_a_default_far_off_does_not_shrink_the_others(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=4)
    (job,) = read_runs([str(tmp_path)]).jobs
    view = absolute([job])["speed, test part"]
    assert "1 job with default parameters further off" in view.note


@pytest.mark.usefixtures("blank_figures")
def test_history_has_a_plot_and_a_table(sweep: Path) -> None:
    page = page_of(sweep)
    (table,) = (table for table in page.tables if "Burn-in" in table[0])
    assert len(table) == 1 + 3 * 4
    labels = page.having("aria-label")
    assert labels.count("Improvement by the amount of burn-in") == 3


@pytest.mark.usefixtures("blank_figures")
def test_the_comparison_fits_a_laptop_and_sorts(
    sweep: Path, tmp_path: Path, browser: Browser
) -> None:
    path = tmp_path / "report.html"
    path.write_text(render(read_runs([str(sweep)])), encoding="utf-8")
    page = browser.page
    page.set_viewport_size({"width": 1366, "height": 900})
    page.goto(path.as_uri())
    widths = page.evaluate(
        "[...document.querySelectorAll('#comparison .scroll')]"
        ".map(s => s.scrollWidth - s.clientWidth)"
    )
    assert set(widths) == {0}
    names = page.locator("#comparison .compact").first.locator("tbody td:first-child")
    heading = page.locator("#comparison .compact").first.locator("thead tr:nth-child(2) th").nth(4)
    assert heading.inner_text().strip().startswith("policy")
    heading.click()
    page.locator("#comparison th[aria-sort]").wait_for()
    page.wait_for_timeout(50)
    once = names.all_inner_texts()
    heading.click()
    page.wait_for_timeout(50)
    assert names.all_inner_texts() == once[::-1]
    for plot in page.locator("#comparison .plot, #safety .plot, #history .plot").all():
        if plot.is_visible():
            assert plot.locator("svg").first.is_visible()
    assert browser.errors == []
