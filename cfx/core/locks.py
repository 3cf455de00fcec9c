"""Locks between processes, on this machine's disks and on shared ones.

The operating system frees a lock when its process ends, however it ends; on a network file system
it may free it too early, too late or never. There a lock is a lease: a file that is created
exclusively and renewed by its holder. Two holders at once do no harm: cache entries have the same
content from any process, files are written atomically, and a job's marker is written last.
"""

from __future__ import annotations

import os
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLease

LEASE_S = 60.0
"""Seconds after which a lease that is not renewed is free."""

_SHARED = ("nfs", "cifs", "smb", "lustre", "gpfs", "beegfs", "ceph", "afs", "9p", "panfs", "wekafs")
"""Prefixes of the types of network file systems."""

_SHARED_IN_USER_SPACE = ("sshfs", "gluster", "s3fs", "gcsfuse", "cvmfs", "juicefs")
"""Parts of the type of network file systems in user space, after `fuse.`."""


def lock_for(path: Path, *, timeout: float = -1) -> BaseFileLock:
    """Returns the lock whose file is `path`, not yet held.

    Args:
        path: beside what it guards.
        timeout: how long `acquire` waits, s; -1: for ever.
    """
    if is_shared(path.parent):
        lease = path.with_name(f"{path.name}.lease")
        return SoftFileLease(lease, lease_duration=LEASE_S, timeout=timeout)
    return FileLock(path, timeout=timeout)


def is_shared(folder: Path) -> bool:
    """Says whether a folder lies on a network file system.

    `CFX_SHARED_STORAGE=1` makes it true of every folder: for file systems not recognised by name.
    """
    if os.environ.get("CFX_SHARED_STORAGE", "") not in {"", "0"}:
        return True
    kind = _file_system(folder)
    if kind.startswith("fuse."):
        return any(name in kind for name in _SHARED_IN_USER_SPACE)
    return kind.startswith(_SHARED)


def _file_system(folder: Path) -> str:
    """Returns the type of the file system on which a folder lies, "" where it is unknown."""
    try:
        mounts = Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    whole = str(folder.absolute())
    best, kind = "", ""
    for line in mounts:
        _, place, found, *_ = line.split()
        place = place.replace("\\040", " ")
        inside = whole == place or whole.startswith(place.rstrip("/") + "/")
        if inside and len(place) >= len(best):
            best, kind = place, found
    return kind
