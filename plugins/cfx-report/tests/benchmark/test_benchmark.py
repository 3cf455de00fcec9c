"""`cfx benchmark`: what is frozen, what a row holds, and comparisons pair by pair."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import cfx
from cfx.app.cli import main
from cfx.data.tidy import write_tidy
from cfx.errors import DataError, Terminated
from cfx_report.benchmark.compare import compared, lines_of, read_errors
from cfx_report.benchmark.frozen import DATA, METHODS, TESTED, protocol_hash
from cfx_report.benchmark.jobs import overrides_of, row_name, run_job
from cfx_report.benchmark.row import Row, Value, markdown, values_of


def dataset(name: str, **settings: object) -> cfx.plugin.PairSet:
    """Returns the pairs of one of cfx's datasets."""
    made = cfx.get("dataset", name)(**settings)
    assert isinstance(made, cfx.plugin.Dataset)
    return made.load()


def test_the_protocol_is_the_published_one() -> None:
    assert protocol_hash() == "8528a0184ce5", (
        "rows of docs/benchmark.md are of this protocol: another one needs another VERSION, and"
        " every row measured anew"
    )


def test_the_frozen_pairs_are_those_of_the_recordings(shared_data: Path) -> None:
    path = shared_data / "i80_reconstructed_pairs.parquet"
    pairs = dataset("tidy", path=path, min_duration=30)
    assert pairs.fingerprint == DATA
    assert sum(len(pair) >= 700 for pair in pairs) == TESTED


@pytest.mark.parametrize(
    "override", ["seed=1", "protocol.folds=3", "+data.max_pairs=9", "split=.5"]
)
def test_what_is_frozen_cannot_be_overridden(
    capsys: pytest.CaptureFixture[str], override: str
) -> None:
    code = main(["benchmark", "model=idm", override, "--data", "x.parquet"])
    assert code == 2
    assert "are the benchmark's" in capsys.readouterr().err


def test_other_pairs_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "p.parquet"
    write_tidy(dataset("synthetic", pairs=2, frames=320, min_duration=0), path)
    assert main(["benchmark", "model=idm", "--data", str(path)]) == 2
    error = capsys.readouterr().err
    assert "holds other pairs than i80-1's" in error
    assert "--other-data" in error


def test_data_are_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["benchmark", "model=idm"])
    assert ended.value.code == 2
    assert "--data PATH is needed" in capsys.readouterr().err


def test_a_model_alone_is_used_with_constant_parameters() -> None:
    assert overrides_of(None, ["model=mine"]) == ["policy=fixed", "model=mine"]
    assert overrides_of(None, ["model=mine", "policy=gru"]) == ["model=mine", "policy=gru"]
    assert overrides_of("closed_loop", ["model=mine"]) == [*METHODS["closed_loop"], "model=mine"]
    assert row_name(None, ["model=mine"]) == "mine, constant"
    assert row_name("closed_loop", ["model=mine", "objective=mixed"]) == (
        "mine, objective=mixed, closed loop"
    )
    assert row_name(None, ["model=mine", "tracking.enabled=false"]) == "mine, constant"


SPEED = [0.5, 0.6, 0.7, 0.9]


def protocol_name(data: str = DATA) -> str:
    return f"i80-1/{protocol_hash(data)}"


def errors(speed: list[float], name: str = "mine", data: str = DATA) -> pd.DataFrame:
    """Errors of four pairs of two drivers."""
    rows = []
    for number, value in enumerate(speed):
        row: dict[str, object] = {"protocol": protocol_name(data), "row": name, "task": "unseen"}
        row |= {"site": "I-80", "pair_id": f"p{number}", "driver": f"d{number // 2}", "frames": 9}
        row |= {"rmse_speed": value, "rmse_gap": 4 * value, "collisions": number}
        rows.append(row | {"hard_braking": 0, "crps_speed": np.nan, "coverage": np.nan})
    return pd.DataFrame(rows)


def test_a_row_has_means_with_intervals_over_drivers_and_sums_of_counts(tmp_path: Path) -> None:
    values = values_of(errors(SPEED))
    mean, low, high = values["rmse_speed"]
    assert mean == pytest.approx(np.mean(SPEED))
    assert low is not None
    assert high is not None
    # Two drivers with two pairs each, 0.55 and 0.8 m/s: Student's t with one degree of freedom.
    margin = stats.t.ppf(0.975, 1) * 0.125
    assert (low, high) == pytest.approx((mean - margin, mean + margin))
    assert values["collisions"] == (6.0, None, None)


def row(name: str, values: dict[str, Value], data: str = DATA) -> Row:
    return Row(name, protocol_name(data), "some pairs", "cfx benchmark", "0.1", 1.0, 4, 2, values)


def test_rows_are_sorted_and_those_of_other_pairs_are_marked(tmp_path: Path) -> None:
    worse = row("a", values_of(errors([1.0] * 4)))
    better = row("b", values_of(errors(SPEED)), data="others")
    lines = markdown([worse, better])
    assert lines[2].startswith("| b (other pairs: some pairs) | 0.675 (")
    assert lines[3].startswith("| a | 1.000 (1.000 to 1.000) | 4.00 (4.00 to 4.00) | 6 | 0 |")


def test_a_row_reads_back(tmp_path: Path) -> None:
    one = row("a", values_of(errors(SPEED)))
    one.write(tmp_path / "row.json")
    assert json.loads(json.dumps(Row.read(tmp_path / "row.json").__dict__)) == json.loads(
        json.dumps(one.__dict__)
    )
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(DataError, match="is no row of the benchmark"):
        Row.read(tmp_path / "broken.json")
    with pytest.raises(DataError, match="there is no such file; give a row's folder"):
        Row.read(tmp_path / "nowhere.json")


def test_a_comparison_is_pair_by_pair(tmp_path: Path) -> None:
    mine = errors(SPEED)
    theirs = errors([2 * value for value in SPEED], "other")
    found = compared(mine, theirs.sample(frac=1.0, random_state=1), "other.csv")
    assert set(found) == {("other", "rmse_speed"), ("other", "rmse_gap")}
    one = found["other", "rmse_speed"]
    assert one.geometric == pytest.approx(0.5)
    assert one.ci95_low == pytest.approx(0.5)
    assert one.win_rate == 1.0
    assert "| other | rmse_speed | +50.0% |" in "\n".join(lines_of(found))
    same = compared(mine, mine, "me")["mine", "rmse_gap"]
    assert (same.geometric, same.p_value) == (0.0, 1.0)


def test_what_does_not_compare_is_refused(tmp_path: Path) -> None:
    mine = errors(SPEED)
    other_data = errors(SPEED, data="other pairs")
    with pytest.raises(DataError, match="errors of different protocols or pairs do not compare"):
        compared(mine, other_data, "b.csv")
    with pytest.raises(DataError, match="has 3 pairs, of which 3 are among my 4"):
        compared(mine, mine.iloc[:3], "c.csv")
    with pytest.raises(DataError, match="stands in it twice"):
        compared(mine, pd.concat([mine, mine]), "d.csv")
    (tmp_path / "e.csv").write_text("row,pair_id\n1,2\n")
    with pytest.raises(DataError, match="column driver is missing"):
        read_errors(tmp_path / "e.csv")


@pytest.mark.slow
def test_a_row_of_other_pairs_is_made_and_marked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "p.parquet"
    write_tidy(dataset("synthetic", pairs=6, frames=720, min_duration=0), path)
    command = ["benchmark", "model=krauss", "tracking.enabled=false", "figures=none"]
    command += ["--data", str(path), "--other-data", "--name", "krauss"]
    assert main(command) == 0
    folder = tmp_path / "outputs/benchmark/krauss"
    first = read_errors(folder / "benchmark_pairs.csv")
    assert len(first) == 6
    assert Row.read(folder / "benchmark.json").command == (
        "cfx benchmark policy=fixed model=krauss"
    )
    capsys.readouterr()
    # Once more: the finished job is not run again, and compares with itself.
    assert main([*command, "--against", str(folder / "benchmark_pairs.csv")]) == 0
    said = capsys.readouterr().out
    assert "was finished before" in said
    assert "krauss (other pairs: p.parquet" in said
    assert "| krauss | rmse_speed | +0.0% |" in said


@pytest.mark.parametrize(("code", "error"), [(130, KeyboardInterrupt), (143, Terminated)])
def test_a_job_that_was_broken_off_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, error: type[BaseException]
) -> None:
    """The exit code is that of the signal, and the same command goes on."""
    monkeypatch.setattr("cfx.app.cli.main", lambda _: code)
    with pytest.raises(error):
        run_job(["model=idm"], tmp_path / "job")
