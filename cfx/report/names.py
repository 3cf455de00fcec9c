"""What tells the jobs of one report apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cfx.report.job import Job
from cfx.tracking.provenance import flatten

GROUPS = ("model", "policy", "learner", "protocol", "objective", "optimizer", "data")
_NO_DIFFERENCE = (
    "tracking.",
    "cache.",
    "figures.",
    "simulation.",
    "simulator.compile",
    "simulator.memory_mb",
    "threads",
    "device",
    "preset",
)
"""Settings that change where or how fast a job runs, not what comes out."""

_MOST = 4
"""Most parts of a name; more are replaced by a number."""

SEPARATOR = " · "


def named(jobs: Sequence[Job]) -> tuple[Job, ...]:
    """Gives every job a short name: its driving model, and what else differs between the jobs."""
    names = []
    for parts in differences(jobs):
        shown = parts if len(parts) <= _MOST else [*parts[: _MOST - 1], "…"]
        names.append(SEPARATOR.join(shown))
    renamed = []
    for k, job in enumerate(jobs):
        name = names[k]
        if names.count(name) > 1:
            name += f" ({names[: k + 1].count(name)})"
        renamed.append(replace(job, name=name))
    return tuple(renamed)


def differences(jobs: Sequence[Job], ignored: Sequence[str] = ()) -> list[list[str]]:
    """Returns for every job its driving model and every other component and setting that differs.

    A setting of a component counts only between jobs that share the component: that of another one
    is another setting.

    Args:
        jobs: that are compared.
        ignored: full names of settings that do not count.
    """
    parts = [[job.component("model") or "model"] for job in jobs]
    for group in GROUPS[1:]:
        _add(parts, [job.component(group) for job in jobs])
    flat = [flatten(dict(job.config)) for job in jobs]
    keys: dict[str, None] = {}
    for values in flat:
        keys |= dict.fromkeys(values)
    for key in keys:
        counts = key not in ignored and not key.startswith(_NO_DIFFERENCE)
        if counts and not key.endswith(".name") and _differs(key, jobs, flat):
            _add(parts, [_said(key, values) for values in flat])
    return parts


def _differs(key: str, jobs: Sequence[Job], flat: Sequence[Mapping[str, Any]]) -> bool:
    """Says whether a setting differs between jobs that share the component it belongs to."""
    group = key.partition(".")[0]
    found: dict[str, set[Any]] = {}
    for job, values in zip(jobs, flat, strict=True):
        peer = job.component(group) if group in GROUPS else ""
        found.setdefault(peer, set()).add(values.get(key, ""))
    return any(len(values) > 1 for values in found.values())


def _said(key: str, values: Mapping[str, Any]) -> str:
    if key not in values:
        return ""
    if key == "style.cluster":
        return str(values[key])
    if key == "seed":
        return f"seed {values[key]}"
    return f"{key.partition('.')[2] or key}={values[key]}"


def _add(parts: list[list[str]], values: Sequence[str]) -> None:
    if len(set(values)) > 1:
        for part, value in zip(parts, values, strict=True):
            if value:
                part.append(value)
