"""Packed tables are read; what holds no table is named, whatever its name ends in."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import pickle
import sqlite3
import tarfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import cfx
from cfx.app import cli
from cfx.data.tidy import frame_of
from cfx.errors import DataError
from tests.checkout import needs
from tests.data.layouts import made_pairs

PAIRS = made_pairs(2, 100)
FRAME = frame_of(PAIRS)
CSV = FRAME.to_csv(index=False).encode()


def parquet() -> bytes:
    file = io.BytesIO()
    FRAME.to_parquet(file)
    return file.getvalue()


def zipped(files: Mapping[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return file.getvalue()


def tarred(content: bytes) -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        about = tarfile.TarInfo("pairs.csv")
        about.size = len(content)
        archive.addfile(about, io.BytesIO(content))
    return file.getvalue()


def zstd(content: bytes) -> bytes:
    return bytes(pa.Codec("zstd").compress(content, asbytes=True))


OF_SYSTEMS = {"__MACOSX/._pairs.csv": b"x", ".DS_Store": b"x", "data/": b""}

PACKED: dict[str, Callable[[bytes], bytes]] = {
    "pairs.csv.zip": lambda content: zipped({"data/pairs.csv": content, **OF_SYSTEMS}),
    "pairs.gz": gzip.compress,
    "pairs.csv.zst": zstd,
    "pairs.csv.xz": lzma.compress,
    "pairs.csv.bz2": bz2.compress,
}


@pytest.mark.parametrize("name", PACKED)
@pytest.mark.parametrize("content", [CSV, parquet()], ids=["text", "parquet"])
def test_a_packed_table_is_read(name: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(PACKED[name](content))
    read = cfx.read(path, min_duration=0, accelerations="recorded").selected
    assert [pair.content for pair in read] == [pair.content for pair in PAIRS]


@pytest.mark.parametrize("name", PACKED)
def test_a_packed_table_that_is_cut_off_is_said(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    packed = PACKED[name](CSV)
    path.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(DataError, match="cut off"):
        cfx.read(path, min_duration=0)


def database(tmp_path: Path) -> bytes:
    with sqlite3.connect(tmp_path / "made.db") as connection:
        FRAME.to_sql("pairs", connection)
    return (tmp_path / "made.db").read_bytes()


def feather() -> bytes:
    sink = io.BytesIO()
    table = pa.Table.from_pandas(FRAME)
    with pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


XLSX = zipped({"[Content_Types].xml": b"<x/>", "xl/workbook.xml": b"<x/>"})
ODS = zipped({"mimetype": b"application/vnd.oasis", "content.xml": b"<x/>"})


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("pairs.xlsx", XLSX, "is a workbook; save the sheet as CSV"),
        ("pairs.csv", XLSX, "is a workbook; save the sheet as CSV"),
        ("pairs.ods", ODS, "is a workbook; save the sheet as CSV"),
        ("pairs.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" * 99, "Excel workbook; save the sheet"),
        ("pairs.7z", b"7z\xbc\xaf\x27\x1c" * 99, "is a 7z archive; unpack it"),
        ("pairs.rar", b"Rar!\x1a\x07" * 99, "is a rar archive; unpack it"),
        ("pairs.tar", tarred(CSV), "is a tar archive; unpack it"),
        ("pairs.tar.gz", gzip.compress(tarred(CSV)), "is a tar archive; unpack it"),
        ("pairs.zip", zipped({"a.csv": CSV, "b.csv": CSV}), r"holds 2 files \(a.csv, b.csv\)"),
        ("pairs.zip", zipped({}), "is an empty zip archive"),
        ("pairs.zip", zipped({"a.csv.gz": gzip.compress(CSV)}), "packed more than once"),
        ("pairs.feather", feather(), "is an Arrow or Feather file"),
        ("pairs.pkl", pickle.dumps(FRAME), "is a pickle, which runs whatever code"),
        ("pairs.h5", b"\x89HDF\r\n\x1a\n" * 99, "is an HDF5 file"),
        ("pairs.json", FRAME.to_json().encode(), "is JSON"),
        ("pairs.json", FRAME.to_json(orient="records").encode(), "is JSON"),
        ("pairs.csv", b"<!DOCTYPE html><html>" * 99, "is a web page"),
        ("pairs.csv", b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS"),
        ("pairs.xml", b"<?xml version='1.0'?><gpx></gpx>", "is XML"),
    ],
)
def test_what_holds_no_table_is_named(
    name: str, content: bytes, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        cfx.read(path, min_duration=0)
    assert cli.main(["data", "describe", str(path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    path.write_bytes(database(tmp_path))
    with pytest.raises(DataError, match="is an SQLite database"):
        cfx.read(path, min_duration=0)


@needs("cfx-recordings")
def test_arrays_that_are_no_events_are_nobodys(tmp_path: Path) -> None:
    from scipy.io import savemat

    np.save(tmp_path / "a.npy", np.zeros((10, 3)))
    np.savez(tmp_path / "a.npz", x=np.zeros(10), y=np.zeros((3, 5)))
    savemat(tmp_path / "a.mat", {"x": np.zeros((10, 3))})
    for name in ("a.npy", "a.npz", "a.mat"):
        with pytest.raises(DataError, match="binary file that no dataset knows"):
            cfx.read(tmp_path / name, min_duration=0)
