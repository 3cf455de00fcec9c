"""The table of a report for a paper."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from cfx.app.cli import main
from cfx.core.job_folder import without_folders
from cfx_report.runs import read_runs
from tests.job_folders import ACROSS, write_job

SEEDS = (0, 1, 2)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two models, each with three seeds."""
    place = tmp_path_factory.mktemp("paper") / "sweep"
    for model in ("krauss", "w99"):
        for seed in SEEDS:
            folder = place / f"{model}-{seed}"
            write_job(folder, model=model, methods=ACROSS, seed=seed, settings={"seed": seed})
            hydra = folder / ".hydra"
            hydra.mkdir(exist_ok=True)
            typed = [f"model={model}", f"seed={seed}", "data.path=/home/ann/secret/pairs.parquet"]
            (hydra / "overrides.yaml").write_text(yaml.safe_dump(typed))
    return place


def written(sweep: Path, *arguments: str) -> str:
    output = sweep.parent / "table"
    assert main(["report", str(sweep), "--output", str(output), *arguments]) == 0
    return output.read_text(encoding="utf-8")


def test_a_row_of_seeds_has_their_mean_and_spread(sweep: Path) -> None:
    table = pd.read_csv(io.StringIO(written(sweep, "--tables", "csv", "--group-by", "seed")))
    assert list(table["row"]) == ["krauss", "w99"]
    assert list(table["jobs"]) == [3, 3]
    for model, row in table.set_index("row").iterrows():
        values, gains = [], []
        for seed in SEEDS:
            metrics = json.loads((sweep / f"{model}-{seed}" / "metrics.json").read_text())
            values.append(metrics["rmse_speed/policy"])
            gains.append(metrics["improvement/rmse_speed/driver_specific/geometric"])
        assert row["rmse_speed_mps/policy"] == pytest.approx(np.mean(values))
        assert row["rmse_speed_mps/policy/sd"] == pytest.approx(np.std(values, ddof=1))
        assert row["improvement/driver_specific"] == pytest.approx(np.mean(gains))


def test_each_job_has_a_row_with_its_interval(sweep: Path) -> None:
    table = pd.read_csv(io.StringIO(written(sweep, "--tables", "csv")))
    assert len(table) == 6
    assert "krauss · seed 1" in set(table["row"])
    low, high = (
        table["improvement/driver_specific/ci95_low"],
        table["improvement/driver_specific/ci95_high"],
    )
    assert bool(
        (
            (low <= table["improvement/driver_specific"])
            & (table["improvement/driver_specific"] <= high)
        ).all()
    )


def test_the_order_of_rows_is_that_of_the_jobs(sweep: Path) -> None:
    names = [job.name for job in read_runs([str(sweep)]).jobs]
    table = pd.read_csv(io.StringIO(written(sweep, "--tables", "csv")))
    assert list(table["row"]) == names


def test_latex_has_a_row_each_and_says_how_it_came_about(sweep: Path) -> None:
    text = written(sweep, "--tables", "latex", "--group-by", "seed")
    body = text[text.index("\\midrule") : text.index("\\bottomrule")].strip().splitlines()[1:]
    assert len(body) == 2
    assert body[0].startswith("krauss & 3 & ")
    assert body[0].count("$\\pm$") >= 5
    columns = text[text.index("\\toprule") :].splitlines()[1].count("&")
    assert all(line.count("&") == columns for line in body)
    comments = [line for line in text.splitlines() if line.startswith("%")]
    assert any("python -m cfx model=w99 seed=2 data.path=pairs.parquet" in one for one in comments)
    assert "/home/ann" not in text


def test_names_are_text_and_no_commands_of_latex(tmp_path: Path) -> None:
    for number in range(2):
        settings = {"style": {"cluster": f"a_b%{number}\\input{{x}}"}}
        write_job(tmp_path / "sweep" / str(number), settings=settings)
    text = written(tmp_path / "sweep", "--tables", "latex")
    rows = [line for line in text.splitlines() if "&" in line and not line.startswith("%")]
    assert any("a\\_b\\%0\\textbackslash" in line for line in rows)
    assert not any("\\input" in line for line in rows)


def test_a_calibration_has_its_parameters_in_a_table_and_no_policy(tmp_path: Path) -> None:
    folder = tmp_path / "calibrated"
    write_job(folder, model="w99", methods=ACROSS)
    about = json.loads((folder / "data.json").read_text(encoding="utf-8"))
    (folder / "data.json").write_text(
        json.dumps({**about, "purpose": "calibration"}), encoding="utf-8"
    )
    text = written(folder, "--tables", "latex")
    assert text.count("\\begin{table}") == 2
    first, _, second = text.partition("\\end{table}")
    assert "policy" not in first[first.index("\\begin") :]
    assert "gap, driver-specific [m]" in first
    assert "tab:cfx-parameters-w99" in second
    assert second.count("\n") > len(about["parameters"])
    assert text[text.index("\\begin") :].isascii(), "pdfLaTeX knows no other letters by itself"
    table = pd.read_csv(io.StringIO(written(folder, "--tables", "csv")))
    assert "rmse_speed_mps/policy" not in table
    assert "rmse_speed_mps/driver_specific" in table


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--group-by", "seed"], "--group-by seed goes with --tables latex or --tables csv"),
        (["--tables", "csv", "--group-by", "sed"], "--group-by sed: no job has this setting"),
    ],
)
def test_what_cannot_be_grouped_is_one_sentence(
    arguments: list[str], said: str, sweep: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(sweep), *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not list(sweep.glob("report.*"))


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("data.path=/home/ann/secret/pairs.parquet", "data.path=pairs.parquet"),
        ("[/home/ann/a.csv,/home/ann/b.csv]", "[a.csv,b.csv]"),
        ("data.path=recordings/pairs.parquet", "data.path=recordings/pairs.parquet"),
        ("data.path=../shared/data/pairs.parquet", "data.path=../shared/data/pairs.parquet"),
        ("sqlite:////home/ann/mlflow.db", "sqlite:///mlflow.db"),
        ("https://example.org/some/page", "https://example.org/some/page"),
        ("cfx://idm, m/s, 1/2", "cfx://idm, m/s, 1/2"),
    ],
)
def test_folders_of_absolute_paths_are_left_out(text: str, kept: str) -> None:
    assert without_folders(text) == kept


@pytest.mark.usefixtures("blank_figures")
def test_the_page_names_no_folder_of_this_machine(sweep: Path) -> None:
    path = sweep.parent / "page.html"
    jobs = [str(sweep / f"{model}-0") for model in ("krauss", "w99")]
    assert main(["report", *jobs, "--output", str(path)]) == 0
    text = path.read_text(encoding="utf-8")
    assert str(sweep.parent) not in text
    assert "/home/ann" not in text
