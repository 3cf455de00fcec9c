"""Tables of results: all say what they are, a job's are what they say, others' never harm it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from cfx.core import registry
from cfx.errors import DataError
from cfx.evaluation.result import Evaluation
from cfx.results.table import (
    Column,
    ResultTable,
    file_of,
    installed,
    parts_of,
    stored_tables,
)
from cfx.results.tables.history import History
from tests.checkout import ROOT
from tests.made_up import GAINS, make_history, make_results


class Census(ResultTable):
    """How many drivers there are."""

    meaning = "one row"
    columns = (Column("drivers", "1", "how many", "int"),)


CENSUS: registry.Installed[ResultTable] = registry.Installed(
    "table", "census", Census(), "cfx-census"
)


def measured(**tables: pd.DataFrame) -> Evaluation:
    evaluation = make_results(pairs=2, frames=5).evaluation
    return dataclasses.replace(evaluation, tables=tables)


def test_the_list_of_files_says_what_each_table_holds() -> None:
    text = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    for one in installed():
        if one.distribution == "cfx-driving":
            assert f"| `{file_of(one)}` | {one.component.meaning}" in text, one.name


def test_a_job_writes_own_tables_those_of_its_plugins_and_those_it_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tables = registry.chosen("table", "own", ())
    own = [one.name for one in tables]
    assert "pairs" in own
    monkeypatch.setattr("cfx.core.registry.installed", lambda kind: (*tables, CENSUS))
    monkeypatch.setattr(registry, "get", lambda kind, name: Census)
    for chosen, plugins, has_census in (
        ("own", (), False),
        ("own", ("cfx-census",), True),
        (("own", "census"), (), True),
        ("all", (), True),
    ):
        names = [one.name for one in registry.chosen("table", chosen, plugins)]
        assert names == [*own, *(["census"] if has_census else [])]
    assert [one.name for one in registry.chosen("table", ("census",), ())] == ["census"]


def test_a_table_that_a_protocol_delivers_is_written_and_read_back(tmp_path: Path) -> None:
    assert parts_of(CENSUS, measured()) is None
    parts = parts_of(CENSUS, measured(census=pd.DataFrame({"drivers": [3]})))
    assert parts is not None
    assert file_of(CENSUS) == "census.parquet"
    CENSUS.component.write(tmp_path / "census.parquet", parts)
    assert CENSUS.component.read(tmp_path / "census.parquet").to_dict("list") == {"drivers": [3.0]}


def test_the_gain_from_history_has_metrics_under_names_without_spaces() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    history = make_history(evaluation.trajectories, GAINS)
    assert History().metrics(measured(history=history)) == {
        "history/driver_specific/0s/improvement": pytest.approx(-0.1, abs=1e-3),
        "history/driver_specific/10s/improvement": pytest.approx(0.1, abs=1e-3),
        "history/driver_specific/80pct/improvement": pytest.approx(0.2, abs=1e-3),
        "history/pooled/80pct/improvement": pytest.approx(0.05, abs=1e-3),
    }


def test_a_table_of_others_that_fails_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    assert parts_of(CENSUS, measured(census=pd.DataFrame({"heads": [3]}))) is None
    assert "table census of the distribution cfx-census is left out" in caplog.text
    assert "declares the column 'drivers'" in caplog.text


def test_an_own_table_that_fails_ends_the_job() -> None:
    own = dataclasses.replace(CENSUS, distribution="cfx-driving")
    with pytest.raises(Exception, match="declares the column 'drivers'"):
        parts_of(own, measured(census=pd.DataFrame({"heads": [3]})))


def test_a_damaged_table_is_one_sentence(tmp_path: Path) -> None:
    pd.DataFrame({"driver": ["a"], "score": ["high"], "cluster": [0]}).to_csv(
        tmp_path / "style.csv", index=False
    )
    with pytest.raises(DataError, match=r"style\.csv is damaged: column 'score' holds something"):
        _ = stored_tables(tmp_path)["style"]
