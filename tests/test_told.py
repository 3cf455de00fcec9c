"""Small things that a user is told."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import pandas as pd
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser

import cfx
from cfx.app import cli
from cfx.data.describe import describe
from cfx.data.table import FileColumn, Layout, read_table
from cfx.data.tidy import frame_of, read_tidy
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from tests.drives import wavy_pairs
from tests.scripts import ENVIRONMENT, command_of

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.4]], dtype=torch.float64)


def test_the_version_is_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"cfx {cfx.__version__}\n"


def test_a_setting_that_another_option_has_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["data.path=pairs.csv"]) == 2
    said = capsys.readouterr().err
    assert "data=synthetic has none; choose " in said
    assert "data=pair_csv" in said
    assert cli.main(["model.variant=vissim"]) == 2
    assert "model=idm has none; choose model=krauss, model=w99 too" in capsys.readouterr().err


def test_the_advice_to_use_a_file_can_be_pasted(tmp_path: Path) -> None:
    path = tmp_path / "it's 2 [pairs]=new.csv"
    pairs = wavy_pairs(Krauss(), TRUE, frames=60)
    frame_of(pairs).to_csv(path, index=False)
    (line,) = (one for one in describe(path).text.splitlines() if one.startswith("Use it: "))
    words = shlex.split(line.removeprefix("Use it: "))
    override = OverridesParser.create().parse_override(words[1])
    assert override.key_or_group == "data.path"
    assert override.value() == str(path)


def test_missing_columns_say_what_gap_m_spares(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    pairs = wavy_pairs(Krauss(), TRUE, frames=60)
    kept = frame_of(pairs).drop(columns=["time_s", "leader_position_m", "leader_length_m"])
    kept.to_csv(path, index=False)
    with pytest.raises(DataError) as error:
        read_tidy(path)
    said = str(error.value)
    assert "column time_s is missing" in said
    assert "leader_position_m, leader_length_m" in said
    assert "not needed beside a column gap_m" in said


@pytest.mark.parametrize("rows", ["1,2,\n3,4,\n", "1,2\n3,4\n"])
def test_rows_may_end_in_a_comma(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,b\n" + rows)
    table = read_table(path, Layout(name="two", columns=(FileColumn("a"), FileColumn("b"))))
    assert pd.DataFrame(table.numbers)[["a", "b"]].to_numpy().tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("1,2\n3,4,5\n", "row 3: 3 columns instead of 2"),
        ("1,2,\n3,4\n", "row 3: 2 columns instead of 3"),
        ("1,2,\n3,4,5\n", "row 3: '5' stands behind the last of 2 columns"),
    ],
)
def test_more_than_a_comma_is_still_refused(tmp_path: Path, rows: str, says: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,b\n" + rows)
    with pytest.raises(DataError, match=says):
        read_table(path, Layout(name="two", columns=(FileColumn("a"), FileColumn("b"))))


@pytest.mark.slow
def test_a_program_that_was_told_of_a_bad_row_ends(tmp_path: Path) -> None:
    """One in eight did not while pyarrow read in the background."""
    (tmp_path / "table.csv").write_text("a,b\n" + 1000 * "1,2\n" + "3,4,5\n")
    text = f"""
from pathlib import Path
from cfx.errors import DataError
from cfx.data.table import Column, Layout, read_table
try:
    read_table(Path({str(tmp_path / "table.csv")!r}), Layout(name="two", columns=(Column("a"),)))
except DataError:
    print("refused")
"""
    command = command_of(text, tmp_path)
    for _ in range(30):
        done = subprocess.run(
            command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=60
        )
        assert (done.returncode, done.stdout) == (0, "refused\n")
