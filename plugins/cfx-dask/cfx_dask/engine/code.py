"""Which code a process runs: a worker computes what the job would only if theirs is the same."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path

from cfx.plugin import distributions, registry


@functools.cache
def installed_code() -> Mapping[str, str]:
    """Returns the SHA-256 of the Python files of cfx and of each plugin, by their distributions.

    Nothing is imported.
    """
    packages: dict[str, set[str]] = {distributions.OWN: {"cfx"}}
    for kind in registry.KINDS:
        for entry in registry.entries(kind):
            packages.setdefault(entry.distribution, set()).add(entry.package)
    return {name: _hash(package) for name, package in packages.items()}


def differing(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """Returns the distributions that two processes have with different code.

    One that only one of them has does not count: whether it is needed shows when it is imported.
    """
    return sorted(name for name in here if there.get(name, here[name]) != here[name])


def _hash(packages: Iterable[str]) -> str:
    digest = hashlib.sha256()
    for package in sorted(packages):
        for folder in _folders(package):
            for path in sorted(folder.rglob("*.py")):
                digest.update(path.relative_to(folder).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _folders(package: str) -> list[Path]:
    """Returns the folders of a package; none where it is not there, or no package."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return []
    if spec is None:
        return []
    return [Path(folder) for folder in spec.submodule_search_locations or ()]
