"""Where a result comes from: versions, commit, machine, process."""

from __future__ import annotations

import getpass
import importlib.metadata
import socket
import subprocess
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]  # it ships no types


def version() -> str:
    """Returns cfx's version."""
    return importlib.metadata.version("cfx-driving")


def git_state(folder: Path) -> dict[str, str]:
    """Returns commit and cleanliness of the git checkout around `folder`; empty if there is none.

    `cfx.git_dirty` counts changes of tracked files only: a new output folder does not make a commit
    dirty.
    """
    commit = _git(folder, "rev-parse", "HEAD")
    if not commit:
        return {}
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    dirty = "unknown" if changed is None else str(bool(changed)).lower()
    return {"cfx.git_commit": commit, "cfx.git_dirty": dirty, "mlflow.source.git.commit": commit}


def commit(folder: Path) -> str:
    """Returns the commit around `folder`, `+` behind it if files have changed; "" for none."""
    state = git_state(folder)
    changed = "+" if state.get("cfx.git_dirty") == "true" else ""
    return state.get("cfx.git_commit", "")[:12] + changed


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(  # noqa: S603 - git, found on the user's own PATH; no shell
            command, capture_output=True, text=True, timeout=10.0, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def plugin_tags(distributions: Mapping[str, str]) -> dict[str, str]:
    """Returns a tag per plugin distribution, and one of them all, by which runs can be grouped."""
    versions = dict(sorted(distributions.items()))
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    tags = {f"cfx.plugin.{name}": version for name, version in versions.items()}
    return {"cfx.plugins": listed or "none", **tags}


def distributions(values: Mapping[str, Any]) -> dict[str, str]:
    """Returns the plugin distributions of a configuration's components, and their versions.

    Raises:
        PluginError: there is no component of that name.
    """
    from cfx.core import registry
    from cfx.core.distributions import OWN

    versions = {}
    for kind in registry.KINDS.values():
        node = values.get(kind.group)
        if isinstance(node, Mapping) and "name" in node:
            entry = registry.entry(kind.name, str(node["name"]))
            if entry.distribution != OWN:
                versions[entry.distribution] = entry.version
    calibration = values.get("calibration")
    posterior = calibration.get("posterior") if isinstance(calibration, Mapping) else None
    if posterior not in {None, "none"}:
        entry = registry.entry("posterior", str(posterior))
        versions[entry.distribution] = entry.version
    return versions


def named_distributions(values: Mapping[str, Any]) -> dict[str, str]:
    """Returns the plugin distributions of a configuration's metrics, tables and figures.

    Raises:
        PluginError: there is no metric, table or figure of that name.
    """
    from cfx.core import registry
    from cfx.core.distributions import ALL_OWN, OWN
    from cfx.evaluation.metrics.base import entries_of

    entries = list(entries_of(values.get("metrics", ALL_OWN)))
    for kind in ("table", "figure"):
        named = values.get(f"{kind}s", ALL_OWN)
        if named == "all":
            entries += registry.entries(kind)
        elif not isinstance(named, str):
            for name in named:
                if name != ALL_OWN:
                    entries.append(registry.entry(kind, name))
    versions = {}
    for entry in entries:
        if entry.distribution != OWN:
            versions[entry.distribution] = entry.version
    return versions


def process_tags() -> dict[str, str]:
    """Returns tags that tell later whether the process that made a run is still there."""
    process = psutil.Process()
    return {
        "cfx.host": socket.gethostname(),
        "cfx.process": f"{process.pid}@{process.create_time():.0f}",
    }


def is_alive(tags: Mapping[str, str]) -> bool:
    """Says whether the process with these `process_tags` runs.

    One that is unknown or on another machine counts as running.
    """
    if tags.get("cfx.host") != socket.gethostname() or "@" not in tags.get("cfx.process", ""):
        return True
    pid, started = tags["cfx.process"].split("@")
    try:
        process = psutil.Process(int(pid))
        # A zombie was killed, and its parent has not asked how it ended.
        if process.status() == psutil.STATUS_ZOMBIE:
            return False
        return bool(abs(process.create_time() - float(started)) < 2.0)
    except psutil.NoSuchProcess:
        return False
    except (psutil.Error, ValueError):
        return True


def user() -> str:
    """Returns the user's name, "" where the system knows none."""
    with suppress(KeyError, OSError, ImportError):
        return getpass.getuser()
    return ""


def flatten(config: Mapping[str, Any]) -> dict[str, str]:
    """Flattens a nested configuration: `{"model": {"name": "w99"}}` -> `{"model.name": "w99"}`.

    Empty mappings and lists are kept.
    """
    flat: dict[str, str] = {}
    for path, value in _leaves(config, ""):
        if value is None:
            flat[path] = "null"
        elif isinstance(value, bool):
            flat[path] = str(value).lower()
        else:
            flat[path] = str(value)
    return flat


def _leaves(value: Any, path: str) -> Iterable[tuple[str, Any]]:
    """Yields path and value of all that is no mapping, nor a list that holds mappings or lists.

    Empty mappings are values, too.
    """
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Mapping):
        items = value.items()
    elif isinstance(value, list | tuple) and any(map(_is_nested, value)):
        items = enumerate(value)
    if not items:
        yield path, value
    for key, item in items:
        yield from _leaves(item, f"{path}.{key}" if path else str(key))


def _is_nested(value: Any) -> bool:
    return isinstance(value, Mapping | list | tuple)
