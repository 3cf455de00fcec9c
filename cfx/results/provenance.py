"""Where a result comes from: versions, commit, machine, process."""

from __future__ import annotations

import getpass
import importlib.metadata
import os
import socket
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]  # it ships no types

_GIT_SECONDS = 10.0


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
    dirty = "unknown"
    if changed is not None:
        dirty = str(bool(changed)).lower()
    return {"cfx.git_commit": commit, "cfx.git_dirty": dirty, "mlflow.source.git.commit": commit}


def commit(folder: Path) -> str:
    """Returns the commit of the git checkout around `folder`, `+` behind it if files have changed.

    It is "" where there is no checkout.
    """
    state = git_state(folder)
    changed = ""
    if state.get("cfx.git_dirty") == "true":
        changed = "+"
    return state.get("cfx.git_commit", "")[:12] + changed


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(folder), *arguments]
    try:
        # `git` is the user's own, found on their PATH; no shell sees the arguments.
        done = subprocess.run(  # noqa: S603 - git, found on the user's own PATH; no shell
            command, capture_output=True, text=True, timeout=_GIT_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode != 0:
        return None
    return done.stdout.strip()


def plugin_tags(distributions: Mapping[str, str]) -> dict[str, str]:
    """Returns a tag per plugin distribution, and one of them all, by which runs can be grouped."""
    tags = {}
    listed = []
    for name, found in sorted(distributions.items()):
        tags[f"cfx.plugin.{name}"] = found
        listed.append(f"{name} {found}")
    return {"cfx.plugins": ", ".join(listed) or "none", **tags}


def distributions(values: Mapping[str, Any]) -> dict[str, str]:
    """Returns the plugin distributions of the chosen components, and their versions.

    cfx's own distribution is no plugin.

    Args:
        values: a job's configuration.

    Raises:
        PluginError: there is no component of that name.
    """
    from cfx.core import registry

    found = {}
    for kind in registry.KINDS.values():
        node = values.get(kind.group)
        if isinstance(node, Mapping) and "name" in node:
            entry = registry.entry(kind.name, str(node["name"]))
            if entry.distribution != registry.OWN:
                found[entry.distribution] = entry.version
    return found


def metric_distributions(values: Mapping[str, Any]) -> dict[str, str]:
    """Returns the plugin distributions of the metrics that a job measures, and their versions.

    Args:
        values: a job's configuration.

    Raises:
        PluginError: there is no metric of that name.
    """
    from cfx.core import registry
    from cfx.evaluation.metrics.base import entries_of

    found = {}
    for entry in entries_of(values.get("metrics", "all")):
        if entry.distribution != registry.OWN:
            found[entry.distribution] = entry.version
    return found


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
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return os.environ.get("USER", "")


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
    items: Iterable[tuple[Any, Any]]
    if isinstance(value, Mapping) and value:
        items = value.items()
    elif isinstance(value, list | tuple) and _has_nested(value):
        items = enumerate(value)
    else:
        yield path, value
        return
    for key, part in items:
        below = str(key)
        if path:
            below = f"{path}.{key}"
        yield from _leaves(part, below)


def _has_nested(values: Iterable[Any]) -> bool:
    return any(isinstance(value, Mapping | list | tuple) for value in values)
