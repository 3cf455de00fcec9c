"""Numbers in documents come from files: `docs/results.json`, and the cards of ready-made policies."""

from __future__ import annotations

import re

import pytest

from tests.checkout import ROOT, module_of

MEASURE = module_of(ROOT / "docs" / "measure.py")
TABLES = module_of(ROOT / "docs" / "tables.py")
RESULTS = TABLES.results()
PAGES = [path.relative_to(ROOT).as_posix() for path in TABLES.pages()]
MARKED_PAGES = [name for name in PAGES if TABLES.MARKED.search((ROOT / name).read_text("utf-8"))]


def test_every_job_was_measured_with_its_command() -> None:
    stated = {key: job["command"] for key, job in RESULTS.items()}
    listed = {key: MEASURE.command_of(job.words) for key, job in MEASURE.JOBS.items()}
    assert stated == listed, "make results"


@pytest.mark.parametrize("key", RESULTS)
def test_a_result_says_where_it_comes_from(key: str) -> None:
    job = RESULTS[key]
    assert re.fullmatch(r"[0-9a-f]{12}", job["commit"]), "of unchanged code"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", job["date"])
    assert " cores; Python 3." in job["machine"]
    assert job["seed"] >= 0
    assert job["cpu_minutes"] > 0
    assert {"rmse_speed/policy", "rmse_speed/driver_specific"} & set(job["numbers"])
    for name in job["numbers"]:
        assert MEASURE.KEPT.fullmatch(name)


@pytest.mark.parametrize("name", MARKED_PAGES)
def test_a_document_states_the_numbers_of_the_files(name: str) -> None:
    page = (ROOT / name).read_text(encoding="utf-8")
    assert TABLES.text(page) == page, "make tables"


@pytest.mark.parametrize("name", MARKED_PAGES)
def test_marks_are_whole_and_do_not_end_a_paragraph(name: str) -> None:
    page = (ROOT / name).read_text(encoding="utf-8")
    places = list(TABLES.MARKED.finditer(page))
    assert page.count("<!--=") == page.count("<!--/-->") == len(places)
    for place in places:
        begins_line = page[: place.start()].endswith("\n")
        assert begins_line == (place[1].split()[0] in TABLES.TABLES), place[1]


def test_other_figures_have_another_source() -> None:
    unused = set(TABLES.MEASURED_OTHERWISE)
    for name in PAGES:
        page = (ROOT / name).read_text(encoding="utf-8")
        stray = TABLES.stray_figures(page)
        if not stray:
            continue
        entry = TABLES.entry_of(name)
        assert entry, f"{name}: {stray}"
        unused.discard(entry)
    assert not unused, "pages without such figures"


@pytest.mark.parametrize(
    "sentence",
    [
        "The policy is better by +12.3 % (+10.1 to +14.4).",
        "They improve by 12.3 %.",
        "Worse: \N{MINUS SIGN}2.5 %.",
        "An error of 0.583 m/s.",
        "| idm | 0.583 / **0.571** |",
        "The gap is wrong by 3.5 m.",
        "It gains 12 % (10 to 14).",
    ],
)
def test_a_figure_that_comes_from_nowhere_is_noticed(sentence: str) -> None:
    assert TABLES.stray_figures(sentence)


def test_settings_are_no_figures() -> None:
    page = "The last 20 % of `learner.jerk_weight=0.015` at 18 m/s, 95 % intervals.\n```\n0.583 m/s\n```"
    assert not TABLES.stray_figures(page)


def test_a_number_that_differs_from_the_file_is_written_anew() -> None:
    key, job = next(iter(RESULTS.items()))
    right = f"{job['numbers']['rmse_speed/policy']:.3f} m/s"
    page = f"It has <!--={key}:rmse_speed/policy-->9.999 m/s<!--/-->."
    assert TABLES.text(page) == page.replace("9.999 m/s", right)
    with pytest.raises(KeyError):
        TABLES.text(f"It has <!--={key}:rmse_sped/policy-->1.000 m/s<!--/-->.")


def test_summaries_that_disagree_stand_beside_each_other() -> None:
    numbers = {"a/geometric": 0.38, "a/ci95_low": 0.3, "a/ci95_high": 0.45, "a/ratio_of_means": 0.3}
    assert TABLES.improvement(numbers, "a") == "+38.0 (+30.0 to +45.0), of the mean errors +30.0"
    close = {**numbers, "a/ratio_of_means": 0.37}
    assert TABLES.improvement(close, "a", unit=True) == "+38.0 % (+30.0 to +45.0)"
