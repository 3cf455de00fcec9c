"""Tables that hold what no recording can hold: one sentence, exit code 2, no traceback."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cfx.app import cli
from cfx.data.tidy import TidyDataset, write_tidy
from cfx.errors import ConfigError, DataError
from tests.drives import straight_pairs

ROWS = 60


def table(tmp_path: Path, column: str, values: pa.Array) -> Path:
    path = tmp_path / "pairs.parquet"
    write_tidy(straight_pairs([ROWS]), path)
    read = pq.read_table(path)
    if column in read.schema.names:
        read = read.set_column(read.schema.get_field_index(column), column, values)
    else:
        read = read.append_column(column, values)
    pq.write_table(read, path)
    return path


def not_utf8() -> pa.Array:
    binary = pa.array([b"good", *[b"\xff\xfe"] * (ROWS - 1)], pa.binary())
    return pa.Array.from_buffers(pa.string(), ROWS, binary.buffers())


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("pair_id", not_utf8(), "row 2, column pair_id: is no text in UTF-8"),
        ("pair_id", pa.array([{"a": 1}] * ROWS), "column pair_id: holds struct<a: int64>, not"),
        ("leader_id", pa.array([[1, 2]] * ROWS), "column leader_id: holds list<"),
        ("lane", pa.array([float("inf")] * ROWS), "column lane .* the cell is infinite"),
    ],
)
def test_what_is_no_name_and_no_lane_is_refused(
    tmp_path: Path,
    column: str,
    values: pa.Array,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = table(tmp_path, column, values)
    with pytest.raises(DataError, match=message):
        TidyDataset(path=path, min_duration=0).load()
    assert cli.main(["data", "describe", str(path)]) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("step", [1e-9, 1e9, 0, -0.1])
def test_time_steps_that_ask_for_unbounded_memory_are_refused(tmp_path: Path, step: float) -> None:
    path = tmp_path / "pairs.parquet"
    write_tidy(straight_pairs([ROWS]), path)
    with pytest.raises(ConfigError, match="time_step"):
        TidyDataset(path=path, time_step=step)


def test_a_step_longer_than_every_pair_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "pairs.parquet"
    write_tidy(straight_pairs([ROWS]), path)
    with pytest.raises(DataError, match=r"data\.time_step=10: no pair in .* lasts two such steps"):
        TidyDataset(path=path, min_duration=0, time_step=10.0).load()


def test_a_terminal_of_few_letters_prints_every_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = table(tmp_path, "recording", pa.array(["Zürich ✓"] * ROWS))
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "ascii", write_through=True))
    assert cli.main(["data", "describe", str(path)]) == 0
    assert rb"Z\xfcrich" in written.getvalue()
