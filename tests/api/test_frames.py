"""Tables of other programs: one recording, whatever library and types hold it."""

from __future__ import annotations

import datetime
import decimal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset
import pytest

import cfx
from cfx.errors import CfxError

pl = pytest.importorskip("polars")
duckdb = pytest.importorskip("duckdb")
xr = pytest.importorskip("xarray")

SETTINGS: dict[str, Any] = {"min_duration": 0, "accelerations": "recorded"}
FRAME: pd.DataFrame = cfx.read(dataset="synthetic", pairs=2, frames=100).frame
ARROW = pa.Table.from_pandas(FRAME)
POLARS = pl.from_pandas(FRAME)
NUMBERS = [name for name in FRAME if FRAME[name].dtype.kind == "f"]
IDS = ["pair_id", "leader_id", "follower_id"]
SINCE = pd.to_timedelta((100 * FRAME["frame"]).astype("int64"), unit="ms")
PAIRS = [group for _, group in FRAME.groupby("pair_id", sort=False)]


def stored(name: str, change: Callable[[Any], Any]) -> Any:
    at = ARROW.schema.get_field_index(name)
    return ARROW.set_column(at, name, change(ARROW.column(name)))


def at_night() -> pd.DataFrame:
    """The night in which clocks go forward."""
    time = (pd.Timestamp("2026-03-29 00:59:58") + SINCE).dt.tz_localize("UTC")
    return FRAME.assign(time_s=time.dt.tz_convert("Europe/Berlin"))


def sql(query: str) -> Any:
    pairs = FRAME  # DuckDB finds it by its name
    assert len(pairs)
    return duckdb.sql(query)


START = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
READ: dict[str, Callable[[], Any]] = {
    "pandas, nullable": FRAME.convert_dtypes,
    "pandas, Arrow types": lambda: FRAME.convert_dtypes(dtype_backend="pyarrow"),
    "pandas, categories": lambda: FRAME.astype(dict.fromkeys([*IDS, "time_s"], "category")),
    "pandas, objects": lambda: FRAME.astype(object),
    "pandas, text": lambda: FRAME.astype(str),
    "pandas, decimals": lambda: FRAME.assign(
        time_s=[decimal.Decimal(frame) / 10 for frame in FRAME["frame"]]
    ),
    "pandas, sparse": lambda: FRAME.assign(
        leader_length_m=pd.arrays.SparseArray(FRAME["leader_length_m"])
    ),
    "pandas, an index": lambda: FRAME.set_index("pair_id"),
    "pandas, a MultiIndex": lambda: FRAME.set_index(["recording", "pair_id", "frame"]),
    "pandas, columns of two levels": lambda: FRAME.set_axis(
        pd.MultiIndex.from_tuples([tuple(name.split("_", 1)) for name in FRAME]), axis=1
    ),
    "pandas, dates": lambda: FRAME.assign(time_s=pd.Timestamp("2026-01-01") + SINCE),
    "pandas, a time zone": at_night,
    "pandas, durations": lambda: FRAME.assign(time_s=SINCE),
    "Python's dates": lambda: FRAME.assign(
        time_s=pd.Series([START + since for since in SINCE], dtype=object)
    ),
    "polars": lambda: POLARS,
    "polars, lazy": POLARS.lazy,
    "polars, categories": lambda: POLARS.with_columns(pl.col(IDS).cast(pl.Categorical)),
    "polars, decimals": lambda: POLARS.with_columns(pl.col("time_s").cast(pl.Decimal(12, 3))),
    "polars, durations": lambda: POLARS.with_columns(
        (100 * pl.col("frame")).cast(pl.Duration("ms")).alias("time_s")
    ),
    "polars, times": lambda: POLARS.with_columns(
        (100_000_000 * pl.col("frame")).cast(pl.Time).alias("time_s")
    ),
    "polars, nothing": lambda: POLARS.with_columns(pl.lit(None).alias("lane")),
    "pyarrow": lambda: ARROW,
    "pyarrow, a batch": lambda: ARROW.combine_chunks().to_batches()[0],
    "pyarrow, a reader": ARROW.to_reader,
    "pyarrow, a dataset": lambda: pyarrow.dataset.dataset(ARROW),
    "pyarrow, a scanner": lambda: pyarrow.dataset.dataset(ARROW).scanner(),
    "pyarrow, structs": ARROW.to_struct_array,
    "pyarrow, dictionary": lambda: stored("time_s", lambda cells: cells.dictionary_encode()),
    "pyarrow, views": lambda: stored("pair_id", lambda cells: cells.cast(pa.string_view())),
    "pyarrow, bytes": lambda: stored("pair_id", lambda cells: cells.cast(pa.binary())),
    "pyarrow, runs": lambda: stored(
        "leader_length_m", lambda cells: pc.run_end_encode(cells.combine_chunks())
    ),
    "pyarrow, long decimals": lambda: stored(
        "leader_length_m", lambda cells: cells.cast(pa.decimal256(50, 20))
    ),
    "DuckDB": lambda: sql("select * from pairs"),
    "DuckDB, a huge integer": lambda: sql("select * replace (frame::hugeint as frame) from pairs"),
    "DuckDB, intervals": lambda: sql(
        "select * replace (to_milliseconds(100 * frame) as time_s) from pairs"
    ),
    "DuckDB, a UUID": lambda: sql("select * replace (md5(pair_id)::uuid as pair_id) from pairs"),
    "xarray": lambda: xr.Dataset.from_dataframe(FRAME),
    "xarray, a grid": lambda: xr.Dataset.from_dataframe(FRAME.set_index(["pair_id", "frame"])),
    "a dict of lists": lambda: FRAME.to_dict("list"),
    "a dict of arrays": lambda: {name: FRAME[name].to_numpy() for name in FRAME},
    "rows": lambda: FRAME.to_dict("records"),
    "a structured array": lambda: FRAME.to_records(index=False),
    "a list of frames": lambda: PAIRS,
    "a generator of frames": lambda: (pair for pair in PAIRS),
    "a list of polars' frames": lambda: POLARS.partition_by("pair_id", maintain_order=True),
}


@pytest.fixture(scope="module")
def wanted() -> list[str]:
    """What is read of each pair of a data frame."""
    return [pair.content for pair in cfx.read(FRAME, **SETTINGS).selected]


@pytest.mark.parametrize("name", READ)
def test_every_table_is_the_same_recording(name: str, wanted: list[str]) -> None:
    read = cfx.read(READ[name](), **SETTINGS).selected
    assert [pair.content for pair in read] == wanted


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("kind", ["int64", "uint64", "Int64", "float64"])
def test_times_that_are_whole_numbers(
    unit: str, kind: str, tmp_path: Path, wanted: list[str]
) -> None:
    per_second = {"ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    count = 1_767_225_600 * per_second + FRAME["frame"] * (per_second // 10)
    frame = FRAME.assign(t=count.astype(kind)).drop(columns="time_s")
    frame.to_parquet(tmp_path / "t.parquet")
    frame.to_csv(tmp_path / "t.csv", index=False)
    for source in (frame, pl.from_pandas(frame), tmp_path / "t.parquet", tmp_path / "t.csv"):
        read = cfx.read(source, columns={"time": "t"}, units={"time": unit}, **SETTINGS).selected
        assert [pair.content for pair in read] == wanted
        assert read.dt == 0.1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (lambda: FRAME["time_s"], "a Series is one column; give a data frame"),
        (lambda: POLARS["time_s"], "a Series is one column"),
        (lambda: xr.DataArray(FRAME["time_s"]), "a DataArray is one column"),
        (lambda: pa.array([1.0]), "is one column"),
        (FRAME[NUMBERS].to_numpy, "an array has no names of columns"),
        (lambda: {"pair_id": [1, 2], "time_s": [1]}, "is no table"),
        (lambda: {"pair_id": 1}, "is no table"),
        (lambda: {"p": FRAME}, "'p' is a table; give several tables as a list"),
        (lambda: [FRAME, "pairs.csv"], "some of the list are tables, and one is a str"),
        (lambda: iter(()), "give a path"),
        (lambda: FRAME.groupby("pair_id"), "give a path"),
        (
            lambda: FRAME.set_index("pair_id").rename_axis(None),
            "pair_id is missing.*index has no name",
        ),
        (lambda: FRAME.assign(time_s=datetime.date(2026, 1, 1)), "time_s: holds dates without"),
        (
            lambda: FRAME.assign(time_s=pd.period_range("2026", periods=len(FRAME), freq="s")),
            "column time_s: holds pandas.period",
        ),
        (lambda: FRAME.assign(time_s=FRAME["time_s"] + 0j), "column time_s: holds complex128"),
        (lambda: FRAME.assign(leader_speed_mps=True), "holds true and false, not numbers"),
        (
            lambda: POLARS.with_columns(pl.Series("time_s", [[1.0]] * len(POLARS))),
            "column time_s: holds large_list",
        ),
        (
            lambda: FRAME.assign(leader_speed_mps=["x", *FRAME["leader_speed_mps"][1:]]),
            "row 1, column leader_speed_mps: 'x' is not a number",
        ),
        (
            lambda: FRAME.assign(leader_speed_mps=pd.Timestamp("2026-01-01")),
            "leader_speed_mps: holds timestamp",
        ),
        (lambda: [PAIRS[0], PAIRS[1].assign(lane=[[1]] * 100)], "lane"),
    ],
)
def test_what_is_no_recording_is_said_in_a_sentence(given: Callable[[], Any], said: str) -> None:
    with pytest.raises(CfxError, match=said) as error:
        cfx.read(given(), **SETTINGS)
    assert "\n" not in str(error.value)


def test_a_grid_has_no_rows_beyond_a_pairs_end() -> None:
    """What describes a pair as a whole is known there all the same."""
    short = FRAME[(FRAME["pair_id"] != FRAME["pair_id"].iloc[0]) | (FRAME["frame"] < 60)]
    over_time = short.set_index(["pair_id", "frame"])[[*NUMBERS]].drop(columns="leader_length_m")
    grid = xr.Dataset.from_dataframe(over_time)
    for name in ("leader_id", "follower_id", "recording", "leader_length_m"):
        grid[name] = ("pair_id", short.groupby("pair_id")[name].first().to_numpy())
    wanted = cfx.read(short, **SETTINGS).selected
    read = cfx.read(grid, **SETTINGS).selected
    assert sorted(pair.content for pair in read) == sorted(pair.content for pair in wanted)
    assert np.array_equal(sorted(read.ids), sorted(wanted.ids))
