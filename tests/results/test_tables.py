"""Tables of results: all say what they are, a job's are what they say, others' never harm it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from cfx.contracts import TableContract
from cfx.core.errors import DataError
from cfx.results.table import Column, Findings, InstalledTable, ResultTable, installed, read_tables
from cfx.results.tables import History
from tests.conftest import ROOT
from tests.made_up import GAINS, make_history, make_results
from tests.test_job_results import findings as found


class TestInstalled(TableContract):
    @pytest.fixture(params=[one.table for one in installed()], ids=lambda one: type(one).__name__)
    def table(self, request: pytest.FixtureRequest) -> ResultTable:
        return request.param


class Census(ResultTable):
    """How many drivers there are."""

    meaning = "one row"
    columns = (Column("drivers", "1", "how many", "int"),)


def census(table: ResultTable | None = None) -> InstalledTable:
    return InstalledTable("census", table or Census(), "cfx-census")


def findings(**tables: pd.DataFrame) -> Findings:
    evaluation = make_results(pairs=2, frames=5).evaluation
    return found(dataclasses.replace(evaluation, tables=tables))


def test_the_list_of_files_says_what_each_table_holds() -> None:
    text = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    for one in installed():
        if one.distribution == "cfx-driving":
            assert f"| `{one.file}` | {one.table.meaning}" in text, one.name


def test_a_table_that_a_protocol_delivers_is_written_and_read_back(tmp_path: Path) -> None:
    about = census()
    assert about.parts(findings()) is None
    parts = about.parts(findings(census=pd.DataFrame({"drivers": [3]})))
    assert parts is not None
    about.write(tmp_path / about.file, parts)
    assert about.read(tmp_path / "census.parquet").to_dict("list") == {"drivers": [3.0]}


def test_the_gain_from_history_has_metrics_under_names_without_spaces() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    history = make_history(evaluation.trajectories, GAINS)
    assert History().metrics(findings(history=history)) == {
        "history/own/0s/rmse_improvement": pytest.approx(-0.1),
        "history/own/10s/rmse_improvement": pytest.approx(0.1),
        "history/own/80pct/rmse_improvement": pytest.approx(0.2),
        "history/population/80pct/rmse_improvement": pytest.approx(0.05),
    }


def test_a_table_of_others_that_fails_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    assert census().parts(findings(census=pd.DataFrame({"heads": [3]}))) is None
    assert "table census of the distribution cfx-census is left out" in caplog.text
    assert "declares the column 'drivers'" in caplog.text


def test_an_own_table_that_fails_ends_the_job() -> None:
    own = dataclasses.replace(census(), distribution="cfx-driving")
    with pytest.raises(Exception, match="declares the column 'drivers'"):
        own.parts(findings(census=pd.DataFrame({"heads": [3]})))


def test_a_damaged_table_is_one_sentence(tmp_path: Path) -> None:
    pd.DataFrame({"driver": ["a"], "score": ["high"], "cluster": [0]}).to_csv(
        tmp_path / "style.csv", index=False
    )
    with pytest.raises(DataError, match=r"style\.csv is damaged: column 'score' holds something"):
        read_tables(tmp_path)
