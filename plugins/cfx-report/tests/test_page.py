"""What a report's page holds."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.evaluation.result import Purpose
from cfx_report.page import summary
from cfx_report.runs import read_runs
from cfx_report.sections import improvements, paper
from cfx_report.sections.calibration import sheet, spreads_of
from cfx_report.sections.comparison import absolute
from cfx_report.sections.figures import chosen_pairs, pair_of
from cfx_report.sections.improvements import cluster_series, pairs_of, per_driver
from cfx_report.sections.results import overview
from cfx_report.sections.run import duration
from tests.job_folders import ACROSS, write_job
from tests.pages import HOSTILE, Page

from .rendered import blank_drawings, page_of

SECTIONS = (
    "summary",
    "comparison",
    "run",
    "results",
    "safety",
    "metrics",
    "drivers",
    "clusters",
    "calibration",
    "style",
    "trajectories",
    "errors",
    "learning",
    "configs",
)


Clusters = tuple[Path, dict[str, dict[str, float | None]], Page]


@pytest.fixture(scope="module")
def clusters(tmp_path_factory: pytest.TempPathFactory) -> Clusters:
    """Jobs of both models, one for each of two clusters, across drivers; without drawings."""
    folder, metrics = tmp_path_factory.mktemp("clusters"), {}
    for model in ("krauss", "w99"):
        for seed, cluster in enumerate(("conservative", "aggressive")):
            name = f"{model} · {cluster}"
            metrics[name] = write_job(
                folder / f"{model}-{cluster}",
                model=model,
                methods=ACROSS,
                cluster=cluster,
                experiment="paper/clusters",
                seed=seed,
            )
    with blank_drawings():
        return folder, metrics, page_of(folder)


def test_the_page_has_every_section(clusters: Clusters) -> None:
    _, _, page = clusters
    ids = page.having("id")
    assert set(SECTIONS) | {"paper"} <= set(ids)
    assert len(ids) == len(set(ids))
    assert {link.removeprefix("#") for link in page.having("href") if link != "data:,"} == {
        *SECTIONS,
        "paper",
    }
    figures = [a for _, a in page.elements if a.get("class") == "plot"]
    assert figures
    assert all(one["role"] == "img" and one["aria-label"] for one in figures)
    assert sum(tag == "svg" for tag, _ in page.elements) >= len(figures)
    assert "12 pairs (shorter than 70 s)" in page.words
    assert "secret" not in page.words


def outside(page: Page) -> list[str]:
    """Returns the addresses that are neither in the page nor of its own parts."""
    found = []
    for attribute in ("src", "href", "action", "srcset", "data", "poster"):
        for value in page.having(attribute):
            if not value.startswith(("#", "data:")):
                found.append(value)
    return found


def test_the_page_asks_for_nothing_and_runs_only_its_own_scripts(
    clusters: Clusters,
) -> None:
    _, _, page = clusters
    assert outside(page) == []
    (policy,) = (
        a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"
    )
    hashes = {
        f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'"
        for one in page.scripts
    }
    assert set(re.findall(r"'sha256-[^']+'", str(policy))) == hashes
    assert len(page.scripts) == 3
    assert str(policy).startswith("default-src 'none';")
    assert "http" not in str(policy)


def test_the_tables_hold_the_numbers_of_metrics_json(clusters: Clusters) -> None:
    _, metrics, page = clusters
    gains, errors = (
        next(table for table in page.tables if heading in table[0])
        for heading in ("Policy against", "Method")
    )
    assert len(errors) == 1 + 4 * 4
    assert len(gains) == 1 + 4 * (3 + 2)
    for name, values in metrics.items():
        for method, shown in (
            ("default", "default"),
            ("pooled", "pooled"),
            ("driver_specific", "driver-specific"),
            ("policy", "policy"),
        ):
            (row,) = (row for row in errors if row[:2] == [name, shown])
            expected = [
                values[f"{column}/{method}"] for column in ("rmse_speed", "rmse_gap", "collisions")
            ]
            assert [float(cell) for cell in row[3:6]] == expected
            whole = values.get(f"full_trajectory/rmse_speed/{method}")
            assert row[6] == ("" if whole is None else repr(whole))
        for prefix, shown, frames in (
            ("improvement/rmse_speed/driver_specific", "driver-specific", "test part"),
            ("improvement/rmse_speed/default", "default", "test part"),
            ("improvement/rmse_speed/pooled", "pooled", "test part"),
            ("full_trajectory/improvement/rmse_speed/default", "default", "full trajectory"),
            ("full_trajectory/improvement/rmse_speed/pooled", "pooled", "full trajectory"),
        ):
            (row,) = (
                row
                for row in gains
                if row[:3] == [name, shown, frames.replace(" ", "\N{NO-BREAK SPACE}")]
            )
            names = (
                "geometric",
                "ci95_low",
                "ratio_of_means",
                "median",
                "win_rate",
                "p_value",
            )
            assert [float(cell) for cell in row[3:9]] == [
                values[f"{prefix}/{one}"] for one in names
            ]
            low, high = (
                100 * (values[f"{prefix}/{end}"] or 0.0) for end in ("ci95_low", "ci95_high")
            )
            assert f"{low:+.1f} % to {high:+.1f} %".replace("-", "\N{MINUS SIGN}") in page.words


def test_names_from_data_are_text_and_nothing_else(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=4, source=HOSTILE, overrides=[f"data.path={HOSTILE}"])
    for file in ("pairs.csv", "style.csv"):
        table = pd.read_csv(tmp_path / "job" / file)
        table["driver"] = table["driver"].astype(str) + HOSTILE
        if "pair_id" in table:
            table["pair_id"] = table["pair_id"].astype(str) + HOSTILE
        table.to_csv(tmp_path / "job" / file, index=False)
    drives = pd.read_parquet(tmp_path / "job" / "trajectories.parquet")
    drives["pair_id"] = drives["pair_id"].astype(str) + HOSTILE
    drives.to_parquet(tmp_path / "job" / "trajectories.parquet")
    page = page_of(tmp_path)
    assert "img" not in {tag for tag, _ in page.elements}
    assert HOSTILE in page.words
    assert outside(page) == []
    assert len(page.scripts) == 3


def test_few_very_bad_pairs_do_not_shrink_the_others(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=12)
    table = pd.read_csv(tmp_path / "job" / "pairs.csv")
    worst = table.index[table["method"] == "policy"][3]
    table.loc[worst, "improvement_over_driver_specific"] = -40.0
    table.to_csv(tmp_path / "job" / "pairs.csv", index=False)
    runs = read_runs([str(tmp_path)])
    view = per_driver(runs.jobs)["against driver-specific calibration"]
    assert "1 of 12 improvements are lower" in view.note
    assert "\N{MINUS SIGN}4000 %" in view.note
    assert "\N{MINUS SIGN}4000.0 %</title>" in view.svg


def test_every_pair_stands_in_a_table_that_sorts(tmp_path: Path) -> None:
    write_job(tmp_path / "0", pairs=6)
    write_job(tmp_path / "1", model="w99", pairs=6, seed=1)
    runs = read_runs([str(tmp_path)])
    for job in runs.jobs:
        sheet = pairs_of(job)
        headings = [column.heading for column in sheet.columns]
        assert headings[:5] == ["Pair", "Driver", "Cluster", "Style score", "over driver-specific"]
        table = job.by_pair.set_index("pair_id")
        for row in sheet.rows:
            pair = table.loc[row[0].text]
            assert float(row[4].sort) == pair["improvement/driver_specific"]
            assert float(row[headings.index("policy")].sort) == pair["rmse_speed/policy"]


def test_clusters_come_from_one_job_or_from_a_job_each(tmp_path: Path) -> None:
    write_job(tmp_path / "all", pairs=9)
    for cluster in ("aggressive", "conservative"):
        write_job(tmp_path / cluster, pairs=4, cluster=cluster)
    series = cluster_series(read_runs([str(tmp_path)]).jobs)
    assert {name: list(found) for name, found in series.items()} == {
        "krauss · all": ["conservative", "normal", "aggressive"],
        "krauss, a job for each cluster": ["conservative", "aggressive"],
    }
    assert [len(table) for table in series["krauss · all"].values()] == [3, 3, 3]


def test_best_median_and_worst_drives_alone_are_shown(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=9)
    (job,) = read_runs([str(tmp_path)]).jobs
    gain = job.by_pair.set_index("pair_id")["improvement/driver_specific"].sort_values(
        ascending=False
    )
    chosen = chosen_pairs(job)
    assert [(one.rank, one.pair_id) for one in chosen] == [
        ("best", gain.index[0]),
        ("median", gain.index[4]),
        ("worst", gain.index[8]),
    ]
    svg = pair_of(job, chosen[0].pair_id)[""].svg
    for words in ("speed (m/s)", "gap (m)", "t_r (s)", "t_i (s)", "real driver"):
        assert words in svg
    with blank_drawings():
        labels = page_of(tmp_path).having("aria-label")
    assert len([one for one in labels if one.startswith("Speed, gap and parameters")]) == 3


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("pairs", [1, 2])
def test_a_job_of_very_few_pairs_and_of_a_model_that_is_not_installed_has_a_page(
    tmp_path: Path, pairs: int
) -> None:
    write_job(tmp_path / "job", model="not-installed-here", pairs=pairs)
    assert set(SECTIONS) <= set(page_of(tmp_path).having("id"))


@pytest.mark.usefixtures("blank_figures")
def test_a_job_of_an_older_version_has_a_page_that_says_what_is_missing(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=3)
    for name in ("trajectories.parquet", "curves.parquet", "style.csv"):
        (tmp_path / "job" / name).unlink()
    words = page_of(tmp_path).words
    for name in ("trajectories.parquet", "curves.parquet", "style.csv"):
        assert f"this job has no {name}" in words


def test_what_is_gained_after_the_start_has_a_view_of_its_own(tmp_path: Path) -> None:
    write_job(tmp_path / "a")
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    views = [
        overview(read_runs([tmp_path / "a"]).jobs),
        absolute(read_runs([tmp_path / "a"]).jobs),
    ]
    assert not any("5 s" in name for view in views for name in view)  # test parts may be no longer
    steady = {
        f"steady/improvement/rmse_speed/driver_specific/{name}": 0.1
        for name in ("geometric", "ci95_low", "ci95_high", "ratio_of_means", "median")
    }
    errors = {
        f"steady/rmse_speed/{method}": 0.5 for method in ("default", "driver_specific", "policy")
    }
    (tmp_path / "a" / "metrics.json").write_text(json.dumps(metrics | steady | errors))
    jobs = read_runs([tmp_path / "a"]).jobs
    assert "against driver-specific calibration, test part after the first 5 s" in overview(jobs)
    assert "speed, test part after the first 5 s" in absolute(jobs)


@pytest.mark.usefixtures("blank_figures")
def test_the_page_says_who_was_trained_on_whom(tmp_path: Path) -> None:
    write_job(
        tmp_path / "a",
        methods=ACROSS,
        settings={"protocol": {"name": "across_drivers", "folds": 2, "together": "recording"}},
    )
    assert (
        "2 folds of whole recordings; driver-specific calibration uses"
        in page_of(tmp_path / "a").words
    )
    write_job(
        tmp_path / "b",
        methods=ACROSS,
        settings={"protocol": {"name": "transfer", "run": "/runs/motorway"}},
    )
    words = page_of(tmp_path / "b").words
    assert "gru, as it was learned in /runs/motorway" in words
    assert "nothing is trained" in words
    names = [job.name for job in read_runs([tmp_path / "a", tmp_path / "b"]).jobs]
    assert "imitation" in names[0]
    assert "imitation" not in names[1]  # the learner of its configuration did nothing


@pytest.mark.usefixtures("blank_figures")
def test_unfinished_jobs_are_named_in_the_page(tmp_path: Path) -> None:
    write_job(tmp_path / "0", pairs=3)
    (tmp_path / "1" / ".hydra").mkdir(parents=True)
    words = page_of(tmp_path).words
    assert "1: not finished: it has no metrics.json" in words
    assert str(tmp_path) not in words


def test_the_summary_answers_by_the_interval(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=8)
    path = tmp_path / "job" / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8"))
    for low, high, answer in ((0.1, 0.3, "yes"), (-0.3, -0.1, "no"), (-0.1, 0.1, "undecided")):
        changed = {
            "improvement/rmse_speed/driver_specific/geometric": 0.123,
            "improvement/rmse_speed/driver_specific/ci95_low": low,
            "improvement/rmse_speed/driver_specific/ci95_high": high,
        }
        path.write_text(json.dumps(metrics | changed), encoding="utf-8")
        question, said, warning = summary(read_runs([str(tmp_path)]).jobs)
        assert "with fewer than 10, an improvement says little" in warning
        assert question.startswith("8 pairs of leader and follower from recording.parquet")
        assert said.startswith(f"krauss: {answer}. Improvement of the RMSE of speed: +12.3 %")


def test_a_calibration_is_none_of_the_policies_that_adapt(tmp_path: Path) -> None:
    for name, policy in (("still", "fixed"), ("moves", "gru")):
        write_job(tmp_path / name, settings={"policy": {"name": policy}})
    runs = read_runs([str(tmp_path)])
    said = summary(runs.jobs)
    assert any("a calibration; its parameters stay constant" in line for line in said)
    assert sum("Improvement of the RMSE of speed" in line for line in said) == 1
    view = overview(runs.jobs)["against driver-specific calibration"]
    assert view.svg.count("<title>") == 3, "improvement, that of the means and median of one job"
    alone = [job for job in runs.jobs if job.purpose is Purpose.CALIBRATION]
    assert "with constant parameters?" in summary(alone)[0]
    page = page_of(tmp_path / "still")
    assert "Improvement of every pair" not in page.words
    assert "The numbers are those of driver-specific calibration" in page.words
    for said_of_policies in ("The numbers are the policy", "policy has learned", "is learned"):
        assert said_of_policies not in page.words
    assert "policy" not in alone[0].shown_methods, "a constant set is shown once"
    (moves,) = [job for job in runs.jobs if job.purpose is Purpose.ADAPTATION]
    sheet = improvements.clusters(cluster_series([moves]), "driver_specific")
    found = improvements.ClustersSection().context(runs)
    assert found is not None
    assert found["sheets"]["driver-specific calibration"].rows == sheet.rows
    assert "over driver-specific calibration" not in page.words.split("Trajectories")[-1]


@pytest.mark.usefixtures("blank_figures")
def test_calibrated_parameters_have_their_bounds_and_shares(tmp_path: Path) -> None:
    write_job(tmp_path / "job", methods=ACROSS)
    table = pd.read_csv(tmp_path / "job" / "pairs.csv")
    axes = json.loads((tmp_path / "job" / "data.json").read_text())["parameters"]
    first = axes[0]
    fixed = table["method"] == "driver_specific"
    values = np.linspace(first["low"], first["high"], fixed.sum())
    table.loc[fixed, f"parameter_{first['name']}"] = values
    table.to_csv(tmp_path / "job" / "pairs.csv", index=False)
    (job,) = read_runs([str(tmp_path / "job")]).jobs
    spreads = spreads_of(job)
    assert [spread.axis.name for spread in spreads] == [one["name"] for one in axes]
    assert spreads[0].at_low == spreads[0].at_high == pytest.approx(1 / fixed.sum())
    row = sheet(spreads).rows[0]
    assert float(row[4].sort) == pytest.approx(np.median(values))
    page = page_of(tmp_path / "job")
    assert page.words.count("Calibrated parameters") >= 1


def test_the_papers_figures_stand_beside_those_of_its_experiments(
    tmp_path: Path, clusters: Clusters
) -> None:
    write_job(tmp_path / "pair", pairs=1, experiment="paper/pair")
    write_job(tmp_path / "pairs", pairs=5, experiment="paper/pairs")
    write_job(tmp_path / "own", pairs=5)
    found = paper.PaperSection().context(read_runs([str(tmp_path)]))
    assert found is not None
    assert [one["heading"] for one in found["experiments"]] == [
        "One pair: follower 11 behind leader 1",
        "A network for each pair",
    ]
    pair, pairs = (one["sheet"].rows for one in found["experiments"])
    texts = [cell.text for cell in pair[0]]
    assert texts == ["paper", "11/1", "krauss", "3.393", "1.033", "0.666", "+35.5 %"]
    assert pair[1][1].text == "1000/990"
    assert [row[3].text for row in pairs[:2]] == ["below 0 %", "below 0 %"]
    assert pairs[2][2].text == "5"
    said = found["experiments"][-1]["differences"]
    assert "the number of pairs (here 5; there 94 in all)" in said
    assert "the search (here random; there Bayesian optimization)" in said
    _, metrics, page = clusters
    low, high = (
        metrics[f"w99 · {c}"]["improvement/rmse_speed/pooled/mean_ratio"] or 0.0
        for c in ("conservative", "aggressive")
    )
    does = "fares better" if high > low else "fares no better"
    assert (
        f"w99: the policy {does} with aggressive than with conservative here; better in the paper."
        in page.words
    )
    assert re.search(r"Above 0 % in [0-4] of 4 jobs here", page.words)


def test_the_best_of_a_grid_search_is_chosen_by_the_validation_loss(tmp_path: Path) -> None:
    for epochs, loss in ((100, 0.03), (500, 0.02)):
        folder = tmp_path / str(epochs)
        learner = {"name": "imitation", "epochs": epochs, "batch_size": 1}
        metrics = write_job(folder, pairs=3, experiment="paper/grid", settings={"learner": learner})
        (folder / "metrics.json").write_text(
            json.dumps(metrics | {"validation_loss/best": loss}), encoding="utf-8"
        )
    found = paper.PaperSection().context(read_runs([str(tmp_path)]))
    assert found is not None
    (one,) = found["experiments"]
    assert [row[1].text for row in one["sheet"].rows] == ["500", "500", "100"]
    assert one["verdicts"][0] == "The smallest of the last column here: krauss · epochs=500."


def test_durations_are_said_as_one_says_them() -> None:
    assert [duration(value) for value in (None, 0.4, 59.6, 61, 7260)] == [
        "not recorded",
        "0 s",
        "1 min 0 s",
        "1 min 1 s",
        "2 h 1 min",
    ]
