"""What tells the jobs of one report apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cfx.report.read import Job
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
    parts = differences(jobs)
    names = [
        SEPARATOR.join(part if len(part) <= _MOST else [*part[: _MOST - 1], "…"]) for part in parts
    ]
    unique = []
    for k, name in enumerate(names):
        same = [i for i, other in enumerate(names) if other == name]
        unique.append(name if len(same) == 1 else f"{name} ({same.index(k) + 1})")
    return tuple(replace(job, name=name) for job, name in zip(jobs, unique, strict=True))


def differences(jobs: Sequence[Job], ignored: Sequence[str] = ()) -> list[list[str]]:
    """Returns for every job its driving model and every other component and setting in which the jobs differ.

    A setting of a component counts only between jobs that share the component: that of another one is another setting.

    Args:
        ignored: full names of settings that do not count.
    """
    parts = [[job.component("model") or "model"] for job in jobs]
    for group in GROUPS[1:]:
        _add(parts, [job.component(group) for job in jobs])
    flat = [flatten(dict(job.config)) for job in jobs]
    for key in dict.fromkeys(key for values in flat for key in values):
        if key in ignored or key.startswith(_NO_DIFFERENCE) or key.endswith(".name"):
            continue
        group = key.partition(".")[0]
        peers = [job.component(group) if group in GROUPS else "" for job in jobs]
        if any(
            len({v.get(key, "") for v, p in zip(flat, peers, strict=True) if p == peer}) > 1
            for peer in set(peers)
        ):
            _add(parts, [_said(key, values) for values in flat])
    return parts


def _said(key: str, values: Mapping[str, Any]) -> str:
    setting = (key.partition(".")[2] or key).replace("{", "").replace("}", "")
    short = {"style.cluster": "{}", "seed": "seed {}"}.get(key, setting + "={}")
    return short.format(values[key]) if key in values else ""


def _add(parts: list[list[str]], values: Sequence[str]) -> None:
    if len(set(values)) > 1:
        for part, value in zip(parts, values, strict=True):
            if value:
                part.append(value)
