"""Locks on this machine's disks, and leases on shared ones."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock, SoftFileLease, Timeout

from cfx.app.sweep.folder import only_one
from cfx.calibration.cache import Cache
from cfx.core import files
from cfx.core.files import is_shared, lock_for

MOUNTS = {
    "/": "ext4",
    "/home": "nfs4",
    "/home/local": "ext4",
    "/scratch disk": "lustre",
    "/mnt/bucket": "fuse.s3fs",
    "/mnt/private": "fuse.encfs",
}


@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("/var/jobs", False),
        ("/home/me/outputs", True),
        ("/home/local/outputs", False),
        ("/homework", False),
        ("/scratch disk/x", True),
        ("/mnt/bucket/cache", True),
        ("/mnt/private", False),
    ],
)
def test_network_file_systems_are_known_by_their_type(
    folder: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    mounts = [SimpleNamespace(mountpoint=place, fstype=kind) for place, kind in MOUNTS.items()]
    monkeypatch.setattr(files.psutil, "disk_partitions", lambda **_: mounts)
    assert is_shared(Path(folder)) is expected


def test_there_a_lock_is_a_lease_and_elsewhere_the_systems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert isinstance(lock_for(tmp_path / "a"), FileLock)
    monkeypatch.setenv("CFX_SHARED_STORAGE", "1")
    assert isinstance(lock_for(tmp_path / "a"), SoftFileLease)


HOLD = """
import sys, time
from pathlib import Path
from cfx.core import files
files.LEASE_S = 2.0
lock = files.lock_for(Path(sys.argv[1]))
lock.acquire()
print("held", flush=True)
time.sleep(60)
"""


def test_a_lease_is_held_while_it_is_renewed_and_free_after_its_process_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CFX_SHARED_STORAGE", "1")
    monkeypatch.setattr(files, "LEASE_S", 2.0)
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "lock")],
        stdout=subprocess.PIPE,
        env={**os.environ, "CFX_SHARED_STORAGE": "1"},
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(Timeout):
            lock_for(tmp_path / "lock").acquire(timeout=3)
        holder.kill()
    lock = lock_for(tmp_path / "lock")
    lock.acquire(timeout=10)
    lock.release()


def test_claims_and_jobs_work_with_leases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CFX_SHARED_STORAGE", "1")
    mine, theirs = Cache(tmp_path), Cache(tmp_path)
    with mine.claim({"a": 1, "b": 1}, 1) as claimed:
        assert claimed == ["a"]
        with theirs.claim({"a": 1, "b": 1}, 10) as rest:
            assert rest == ["b"]
    with only_one(tmp_path):
        assert list(tmp_path.glob("*.lease")) or list(tmp_path.glob(".*.lease"))
