"""A report in a real browser."""

from __future__ import annotations

from pathlib import Path

from cfx_report.page import write_report
from cfx_report.runs import read_runs
from tests.browser import Browser
from tests.job_folders import write_job


def test_figures_change_headings_sort_and_nothing_is_asked_for(
    tmp_path: Path, browser: Browser
) -> None:
    write_job(tmp_path / "0", pairs=4)
    write_job(tmp_path / "1", model="w99", pairs=4, seed=1)
    path = write_report(read_runs([str(tmp_path)]), tmp_path / "report.html")
    page = browser.page
    page.goto(path.as_uri())

    for plot in page.locator(".plot").all():
        if plot.is_visible():
            assert plot.locator("svg").first.is_visible()
    assert page.locator("#drivers .view:visible title", has_text="pair ").count() == 8

    heading = page.locator("#results th", has_text="RMSE of speed")
    column = "#results table:has(th:text('Method')) tbody td:nth-child(4)"
    heading.click()
    page.locator("#results th[aria-sort=descending]").wait_for()
    page.wait_for_function(
        "column => { const v = [...document.querySelectorAll(column)].map(c => +c.dataset.sort);"
        " return v.every((x, k) => k == 0 || v[k - 1] >= x); }",
        arg="#results .scroll:nth-of-type(2) td:nth-child(4)",
    )
    shown = [float(text) for text in page.locator(column).all_inner_texts()]
    assert shown == sorted(shown, reverse=True)
    heading.click()
    page.locator("#results th[aria-sort=ascending]").wait_for()
    page.wait_for_timeout(50)
    assert [float(text) for text in page.locator(column).all_inner_texts()] == sorted(shown)

    assert page.locator("#drivers .view:visible").count() == 1
    page.locator("#drivers select").select_option("against default parameters")
    assert page.locator("#drivers .view:visible", has_text="default parameters").count() == 1

    assert browser.over_network() == []
    assert browser.errors == []
