"""What a job says and writes about results that only some jobs have."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any, cast

import pandas as pd
import pytest
from rich.console import Console

from cfx.app.job.console import report, report_places
from cfx.evaluation.result import Evaluation, Purpose
from cfx.evaluation.statistics import Improvement
from cfx.results.result import Result
from cfx.results.table import file_of, installed, tables_of
from tests.made_up import GAINS, make_history, make_platoon, make_results, with_metric


class Untracked:
    def how_to_open(self) -> tuple[str, ...]:
        return ()


def said(
    evaluation: Evaluation, *, width: int = 200, folder: str = "folder", verbose: bool = True
) -> str:
    """Returns what a job prints."""
    out = io.StringIO()
    console = Console(file=out, width=width)
    report(Result.of(evaluation), console, verbose=verbose)
    report_places(Path(folder), console, cast(Any, Untracked()))
    return out.getvalue()


def measured(hard_braking: dict[str, int], at_bounds: dict[str, float]) -> Evaluation:
    evaluation = make_results(pairs=4, frames=20).evaluation
    evaluation = with_metric(evaluation, "hard_braking", hard_braking, summary="sum")
    return with_metric(evaluation, "at_bounds", at_bounds)


def test_an_odd_folder_is_printed_as_it_is() -> None:
    nothing = measured({}, {})
    assert said(nothing, folder="a job [z] \u00e4").endswith("Results: a job [z] \u00e4\n")


def test_a_safe_drive_is_not_talked_about() -> None:
    nothing = dict.fromkeys(("default", "driver_specific", "policy"), 0)
    text = said(measured(nothing, {"default": 0.0, "driver_specific": 0.3, "policy": 0.004}))
    assert "-8 m/s2" not in text
    assert "bounds" not in text


def test_hard_braking_and_parameters_at_bounds_are_told() -> None:
    text = said(
        measured(
            {"default": 0, "driver_specific": 1, "policy": 2},
            {"default": 0.0, "driver_specific": 0.25, "policy": 0.5},
        )
    )
    assert "Frames with an acceleration below -8 m/s2: driver-specific 4, policy 8." in text
    assert "Parameters at their bounds: driver-specific 25%, policy 50%." in text


def test_parameters_that_recordings_do_not_determine_are_told() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    about, name = evaluation.about, evaluation.names[0]
    fixed = about["method"] == "driver_specific"
    shares = pd.Series([1.0, 1.0, 0.95, 1.0], index=about.index[fixed])
    flat = dataclasses.replace(evaluation, about=about.assign(**{f"flat_{name}": shares}))
    assert f"Not determined: {name} for 3 of 4 pairs" in said(flat)
    assert "Not determined" not in said(evaluation)


def test_a_model_that_follows_nobody_is_not_compared_with_its_fixed_parameters() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    assert "Improvement of the policy over other methods" in said(evaluation)
    text = said(dataclasses.replace(evaluation, purpose=Purpose.POLICY))
    assert "Improvement" not in text
    assert "compare the policy's RMSE with other jobs'" in text


def test_constant_parameters_are_a_calibration_and_not_compared_with_themselves() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    text = said(dataclasses.replace(evaluation, purpose=Purpose.CALIBRATION))
    assert "Improvement" not in text


def improvement(**changes: Any) -> Improvement:
    known = Improvement(
        geometric=0.325,
        ci95_low=0.211,
        ci95_high=0.433,
        ratio_of_means=0.421,
        median=0.421,
        win_rate=0.85,
        p_value=3.8e-6,
        mean_ratio=0.3,
        trimmed_mean_ratio=0.31,
        pairs=40,
        undefined=0,
        drivers=40,
    )
    return dataclasses.replace(known, **changes)


def compared(**improvements: Improvement) -> str:
    """Returns what is said of improvements over baselines."""
    evaluation = make_results(pairs=4, frames=20).evaluation
    return said(dataclasses.replace(evaluation, improvements={"test": improvements}))


def row(text: str, over: str) -> list[str]:
    """Returns the cells of the row of a baseline in the table of improvements."""
    table = text.partition("Improvement of the policy")[2]
    line = next(line for line in table.splitlines() if line.startswith(f"│ {over} "))
    return [cell.strip() for cell in line.strip("│").split("│")]


def test_improvements_are_a_table_in_percent_that_fits_80_columns() -> None:
    gains = {
        "driver_specific": improvement(),
        "pooled": improvement(geometric=-0.05, win_rate=0.25),
    }
    evaluation = make_results(pairs=4, frames=20).evaluation
    evaluation = dataclasses.replace(
        evaluation,
        improvements={
            "test": gains,
            "steady": {"driver_specific": improvement()},
            "full_trajectory": {"pooled": improvement()},
        },
    )
    text = said(evaluation, width=80)
    cells = ["+32.5", "+21.1 to +43.3", "+42.1", "34 of 40", "3.8e-06"]
    assert row(text, "driver-specific") == ["driver-specific", *cells]
    assert row(text, "driver-specific,") == ["driver-specific,", *cells]
    assert row(text, "pooled, full") == ["pooled, full", *cells]
    assert row(text, "pooled")[1:] == ["-5.0", cells[1], cells[2], "10 of 40", cells[4]]
    short = said(evaluation, width=80, verbose=False)
    assert "+32.5 (+21.1 to +43.3)" in short
    assert short.count("┏") == 1, "one table"
    assert "Improvement of the policy over other methods" not in short


def test_few_drivers_and_undefined_improvements_are_said() -> None:
    nan = float("nan")
    text = compared(
        driver_specific=improvement(pairs=1, drivers=1, ci95_low=nan, ci95_high=nan, p_value=nan),
        pooled=improvement(pairs=0, drivers=0, undefined=4),
    )
    assert row(text, "driver-specific")[2:] == ["one driver", "+42.1", "1 of 1", ""]
    assert row(text, "pooled")[1] == "not defined"
    assert "Over pooled: 4 of 4 pairs have no improvement" in text
    assert "nan" not in text


@pytest.mark.parametrize("present", [True, False])
def test_platoon_and_history_are_written_and_old_ones_go(tmp_path: Path, present: bool) -> None:
    evaluation = make_results(pairs=3, frames=20).evaluation
    names = ["platoon.parquet", "history.parquet"]
    for name in names:
        (tmp_path / name).write_bytes(b"of an earlier job")
    if present:
        history = make_history(evaluation.trajectories, GAINS)
        evaluation = dataclasses.replace(
            evaluation, platoon=make_platoon({"policy": 1}), tables={"history": history}
        )
    tables, _ = tables_of(evaluation, installed(), tmp_path)
    written = {file_of(table): table.component for table in installed() if table.name in tables}
    further = {file for file, table in written.items() if not table.always}
    assert further == {"pair_metrics.parquet", *(names if present else ())}
    assert {path.name for path in tmp_path.iterdir()} == set(written)
    if present:
        assert set(pd.read_parquet(tmp_path / "platoon.parquet")) == {
            "method",
            "network",
            "vehicle",
            "time_s",
            "speed",
            "gap",
        }
