"""Data and caches behind URLs, against an S3 store on this machine."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cfx import registry, storage
from cfx.calibration.cache import Cache
from cfx.config import JobConfig
from cfx.datasets.tidy import TidyDataset, write_tidy
from cfx.errors import CfxError, DataError, OutputError
from cfx.extras import install_line
from cfx.storage import RemoteFolder, is_url, local_copies, state
from cfx.sweep.fingerprint import fingerprint
from tests.drives import straight_pairs

pytest.importorskip("moto", reason="moto stands in for S3")

KEY = "ab" * 32


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    made = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    made.start()
    host, port = made.get_host_and_port()
    yield f"http://{host}:{port}"
    made.stop()


@pytest.fixture
def bucket(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yields the URL of an empty bucket; the environment says where the store is."""
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("CFX_DATA_CACHE", str(tmp_path / "copies"))
    s3fs.S3FileSystem.clear_instance_cache()
    name = tmp_path.name.replace("_", "-").lower().strip("-")
    s3fs.S3FileSystem().mkdir(name)
    yield f"s3://{name}"
    s3fs.S3FileSystem.clear_instance_cache()


def put(url: str, path: Path) -> None:
    import s3fs

    s3fs.S3FileSystem().put_file(str(path), url)
    s3fs.S3FileSystem().invalidate_cache()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("s3://bucket/pairs.parquet", True),
        ("gs://bucket/a/*.parquet", True),
        ("data/pairs.parquet", False),
        ("C:/data/pairs.parquet", False),
        ("~/pairs.csv", False),
        (Path("pairs.csv"), False),
        (None, False),
    ],
)
def test_what_a_url_is(value: object, expected: bool) -> None:
    assert is_url(value) is expected


def test_a_recording_behind_a_url_is_read_and_copied_once(bucket: str, tmp_path: Path) -> None:
    pairs = straight_pairs([80, 90])
    write_tidy(pairs, tmp_path / "pairs.parquet")
    put(f"{bucket}/pairs.parquet", tmp_path / "pairs.parquet")
    dataset = TidyDataset(path=f"{bucket}/pairs.parquet")
    assert (
        dataset.read().fingerprint
        == TidyDataset(path=tmp_path / "pairs.parquet").read().fingerprint
    )
    (copy,) = local_copies(f"{bucket}/pairs.parquet")
    before = copy.stat().st_mtime_ns
    assert local_copies(f"{bucket}/pairs.parquet")[0].stat().st_mtime_ns == before
    assert local_copies(f"{bucket}/*.parquet") == [copy]


def test_a_changed_recording_is_another_one(bucket: str, tmp_path: Path) -> None:
    url = f"{bucket}/pairs.parquet"
    values = {"data": {"name": "tidy", "path": url}, "model": {"name": "krauss"}}
    found = []
    for frames in (80, 90):
        write_tidy(straight_pairs([frames]), tmp_path / "pairs.parquet")
        put(url, tmp_path / "pairs.parquet")
        found.append((state(url), local_copies(url), fingerprint(values)))
    assert all(one != other for one, other in zip(*found, strict=True))


def test_what_is_not_there_is_said_in_a_sentence(bucket: str) -> None:
    with pytest.raises(DataError, match=r"nothing\.parquet: no such file"):
        TidyDataset(path=f"{bucket}/nothing.parquet").load()
    with pytest.raises(DataError, match="no file matches"):
        TidyDataset(path=f"{bucket}/*.csv").load()


def test_a_package_that_is_missing_is_said_with_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(CfxError) as caught:
        local_copies("gs://bucket/pairs.parquet")
    assert install_line("gcsfs") in str(caught.value)
    with pytest.raises(CfxError, match="moon"):
        local_copies("moon://bucket/pairs.parquet")


def test_a_cache_behind_a_url_keeps_entries_whole(bucket: str) -> None:
    cache = Cache(f"{bucket}/cache")
    assert cache.get(KEY) is None
    arrays = {"parameters": np.arange(6.0).reshape(2, 3), "loss": np.array([0.5, 0.25])}
    cache.put(KEY, arrays)
    found = Cache(f"{bucket}/cache").get(KEY)
    assert found is not None
    for name, values in arrays.items():
        assert np.array_equal(found[name], values)
    shares = cache.shares([KEY, "cd" * 32], "labels")
    with cache.claim(dict.fromkeys(shares, 2), 10) as claimed:
        assert claimed == list(shares)


def test_a_damaged_entry_behind_a_url_is_computed_again(bucket: str) -> None:
    cache = Cache(f"{bucket}/cache")
    RemoteFolder(f"{bucket}/cache").write(f"{KEY[:2]}/{KEY}.entry", b"cfx calibration 1 nonsense")
    assert cache.get(KEY) is None


def test_a_bucket_that_is_not_there_is_said_in_a_sentence(bucket: str) -> None:
    cache = Cache(f"{bucket}-elsewhere/cache")
    with pytest.raises(
        OutputError, match=r"cannot write the calibration cache s3://.*cache\.folder"
    ):
        cache.put(KEY, {"loss": np.zeros(1)})


def test_a_job_takes_urls_for_its_data_and_its_cache() -> None:
    groups = ("model", "policy", "optimizer", "learner", "protocol")
    nodes = {group: {"name": "x"} for group in groups}
    data = {"name": "tidy", "path": "s3://bucket/pairs.parquet"}
    config = JobConfig(data=data, cache={"folder": "s3://bucket/cache"}, **nodes)
    assert config.cache.folder == "s3://bucket/cache"
    assert config.model_dump(mode="json")["cache"]["folder"] == "s3://bucket/cache"
    made = registry.create("dataset", config.data)
    assert made.settings.path == "s3://bucket/pairs.parquet"
