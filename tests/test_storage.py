"""Data, caches and jobs' folders behind URLs, against an S3 store on this machine."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import cfx
from cfx.app import cli
from cfx.app.commands.calibrate import overrides_of
from cfx.app.sweep.folder import fingerprint
from cfx.calibration.cache import Cache
from cfx.core import registry, storage
from cfx.core.distributions import install_line
from cfx.core.storage import RemoteFolder, is_url, local_copies, state
from cfx.data.tidy import TidyDataset, frame_of, write_tidy
from cfx.errors import CfxError, DataError, OutputError
from cfx.results.config import JobConfig
from cfx.results.folder import Upload, place_of
from tests.broken_plugins import QUICK
from tests.drives import straight_pairs

pytest.importorskip("moto", reason="moto stands in for S3")

KEY = "ab" * 32
JOB = (*QUICK, "data.pairs=3")


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


def test_the_layout_of_a_recording_behind_a_url_is_found_from_the_file(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By each of the three ways to name a file without its layout."""
    url = f"{bucket}/pairs.csv"
    frame_of(straight_pairs([400, 410])).to_csv(tmp_path / "pairs.csv", index=False)
    put(url, tmp_path / "pairs.csv")
    assert cfx.read(url).selected.ids == cfx.read(tmp_path / "pairs.csv").selected.ids
    assert cli.main(["data", "describe", url]) == 0
    assert f"Use it: data=tidy data.path={url}" in capsys.readouterr().out
    assert {"data=tidy", f"data.path={url}"} <= set(overrides_of([url]))


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
    shares = cache.shards([KEY, "cd" * 32], "labels")
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


def job(folder: Path, url: str, *overrides: str) -> int:
    return cli.main([*JOB, f"hydra.run.dir={folder}", f"output.url={url}/jobs", *overrides])


def copy_of_a_job(folder: Path, url: str, metrics: str) -> None:
    """Copies a folder that holds what tells a job's."""
    folder.mkdir(exist_ok=True)
    for name, text in {"config.yaml": "{}", "metrics.json": metrics, ".lock": ""}.items():
        (folder / name).write_text(text, encoding="utf-8")
    Upload(f"{url}/jobs", folder).finish()


def test_a_job_whose_folder_was_copied_is_read_from_its_url(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "outputs" / "today" / "mine"
    url = f"{bucket}/jobs/today/mine"
    assert job(folder, bucket) == 0
    assert f"Copied to: {url}\n" in capsys.readouterr().out
    written = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert set(RemoteFolder(url).names()) == written
    assert {"metrics.json", "policy/policy.json", ".hydra/overrides.yaml"} <= written
    # A neighbour whose name begins alike is another folder.
    RemoteFolder(f"{bucket}/jobs/today/mine-2").write("metrics.json", b"{}")

    found, here = cfx.load(url), cfx.load(folder)
    assert found.metrics == here.metrics
    assert found.pairs.equals(here.pairs)
    assert found.folder != folder
    assert cfx.load(f"{url}/").folder == found.folder, "nothing is copied twice"


def test_what_an_earlier_job_left_at_a_url_goes_and_nothing_else(
    bucket: str, tmp_path: Path
) -> None:
    foreign, mine = RemoteFolder(f"{bucket}/jobs/data"), RemoteFolder(f"{bucket}/jobs/mine")
    foreign.write("pairs.parquet", b"recorded")
    copy_of_a_job(tmp_path / "data", bucket, "{}")
    assert foreign.read("pairs.parquet") == b"recorded"
    copy_of_a_job(tmp_path / "mine", bucket, "{}")
    mine.write("platoon.parquet", b"of an earlier job")
    copy_of_a_job(tmp_path / "mine", bucket, '{"rmse_speed/policy": 1.0}')
    assert mine.read("platoon.parquet") is None
    assert mine.read("metrics.json") == (tmp_path / "mine" / "metrics.json").read_bytes()
    assert mine.read(".lock") is None


def test_a_url_that_cannot_be_written_is_said_before_any_work(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert job(tmp_path / "job", f"{bucket}-nobody-made") == 2
    said = capsys.readouterr().err
    assert re.match(r"cannot write to s3://.*/jobs/job \(.*\); set output\.url to a place", said)
    assert not (tmp_path / "job" / "metrics.json").exists()
    assert job(tmp_path / "job", "here") == 2
    assert "output.url='here/jobs': write a URL such as" in capsys.readouterr().err
    assert cli.main([*JOB, f"hydra.run.dir={bucket}/job"]) == 2
    assert f"output.url={bucket}/job copies jobs there" in capsys.readouterr().err
    with pytest.raises(DataError, match="there is no such folder"):
        cfx.load(f"{bucket}/jobs/nothing")


def test_a_name_that_leads_out_of_its_folder_is_not_copied(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    name = bucket.removeprefix("s3://")
    about = {f"{name}/job/../../x": {"size": 1, "ETag": "1"}}
    monkeypatch.setattr(s3fs.S3FileSystem, "find", lambda *_args, **_options: about)
    with pytest.raises(DataError, match="leads out of its folder"):
        storage.local_folder(f"{bucket}/job")


@pytest.mark.parametrize(
    ("folder", "place"),
    [
        ("/home/me/outputs/2026-11-24/10-00-idm-gru", "2026-11-24/10-00-idm-gru"),
        ("/outputs/me/outputs/one", "one"),
        ("/data/one", "one"),
        ("/data/outputs", "outputs"),
    ],
)
def test_a_copy_has_the_jobs_own_name(folder: str, place: str) -> None:
    assert place_of(Path(folder)) == place
