"""What was run: data, components and settings of each job."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from cfx.evaluation.result import Purpose
from cfx.report.blocks import Block, Facts, Heading, Items, Table, Text
from cfx.report.figures.words import NOTHING
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Column, Sheet, text

_TOGETHER = {"platoon": " of whole platoons", "recording": " of whole recordings"}


class RunSection(Section):
    """What was run: data, components and settings of each job."""

    title = "What was run"
    entry = "What was run"
    order = 300

    def blocks(self, runs: Runs) -> list[Block]:
        """Return what all jobs share, and a table of what they do not."""
        found: list[Block] = []
        if runs.unfinished:
            found.append(Text("Not in this page, because they have not finished:", "lacking"))
            found.append(
                Items(
                    tuple(f"{without_folders(one.place)}: {one.reason}" for one in runs.unfinished)
                )
            )
        common, own = facts(runs.jobs)
        found.append(Facts(tuple(common)))
        if own is not None:
            found += [Heading("What differs between the jobs"), Table(own)]
        return found


def facts(jobs: Sequence[Job]) -> tuple[list[tuple[str, str]], Sheet | None]:
    """Returns what all jobs share, and a table of what they do not (None if they share all)."""
    every = [_facts(job, jobs) for job in jobs]
    names: dict[str, None] = {}
    for one in every:
        names |= dict.fromkeys(one)
    common, differing = [], []
    for name in names:
        values = {one.get(name, NOTHING) for one in every}
        if len(values) == 1:
            common.append((name, values.pop()))
        else:
            differing.append(name)
    if not differing:
        return common, None
    columns = [Column("Job", number=False)]
    for name in differing:
        columns.append(Column(name, number=False))
    rows = []
    for job, one in zip(jobs, every, strict=True):
        cells = [text(job.name)]
        for name in differing:
            cells.append(text(one.get(name, NOTHING)))
        rows.append(tuple(cells))
    return common, Sheet(tuple(columns), tuple(rows))


def duration(seconds: float | None) -> str:
    """Returns a duration as one says it: "42 s", "3 min 5 s", "2 h 10 min"."""
    if seconds is None:
        return "not recorded"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left} min"
    if minutes:
        return f"{minutes} min {rest} s"
    return f"{rest} s"


def _facts(job: Job, jobs: Sequence[Job]) -> dict[str, str]:
    table = job.pairs.drop_duplicates("pair_id")
    found = {
        "Started": f"{job.started:%Y-%m-%d %H:%M}" if job.started else "not recorded",
        "Took": duration(job.seconds),
        **_typed(job, jobs),
    }
    if job.experiment:
        found["Preset"] = job.experiment
    return found | {
        "Data": without_folders(str(job.data.get("source") or job.component("data") or NOTHING)),
        "Pairs": f"{len(table)} pairs of {table['driver'].nunique()} drivers",
        "Left out": _left_out(job),
        "Test frames of a pair": _range(table["frames"]),
        "Drivers by style": str(job.setting("style.cluster") or NOTHING),
        "Protocol": _protocol(job),
        "Driving model": job.component("model") or NOTHING,
        "Policy": f"{job.component('policy')}, {_learned(job)}",
        "Calibrated by": _calibration(job),
        "Seed": str(job.config.get("seed", NOTHING)),
        "cfx": job.version or "version not recorded",
        "Read from": without_folders(job.place),
    }


def _calibration(job: Job) -> str:
    said = job.component("optimizer") or NOTHING
    objective = job.data.get("objective")
    if isinstance(objective, Mapping):
        said += f", which minimises {objective.get('name')} ({objective.get('unit')})"
    return said


def _left_out(job: Job) -> str:
    parts = []
    for one in job.data.get("dropped") or ():
        if isinstance(one, Mapping):
            parts.append(f"{one.get('count')} {one.get('unit')} ({one.get('reason')})")
    return "; ".join(parts) or "nothing"


def _typed(job: Job, jobs: Sequence[Job]) -> dict[str, str]:
    """Returns what was typed: of several jobs, what they share and what each has of its own."""
    if job.overrides is None:
        return {"Command": "not recorded"}
    if len(jobs) == 1:
        return {"Command": _command(job.overrides)}
    shared = _shared_overrides(jobs)
    own = []
    for override in job.overrides:
        if override not in shared:
            own.append(override)
    return {
        "Command": f"{_command(shared)} …",
        "Overrides of its own": without_folders(shlex.join(own)) or "none",
    }


def _command(overrides: Sequence[str]) -> str:
    """Returns what was typed, without the folders of absolute paths."""
    return without_folders(shlex.join(["python", "-m", "cfx", *overrides]))


def _shared_overrides(jobs: Sequence[Job]) -> list[str]:
    """Returns the overrides that all jobs with known overrides have, in order."""
    known = [job.overrides for job in jobs if job.overrides is not None]
    shared = []
    for override in known[0]:
        if all(override in other for other in known):
            shared.append(override)
    return shared


def _range(values: pd.Series[Any]) -> str:
    low, high = int(values.min()), int(values.max())
    return str(low) if low == high else f"{low} to {high}"


def _learned(job: Job) -> str:
    """Says how the policy was learned."""
    learner = job.component("learner")
    if job.purpose is Purpose.CALIBRATION:
        return "constant parameters, nothing is learned"
    if learner:
        return f"learned by {learner}"
    return f"as it was learned in {job.setting('protocol.run')}"


def _protocol(job: Job) -> str:
    name = job.component("protocol")
    train, test = f"{100 * job.split:.3g} %", f"{100 * (1 - job.split):.3g} %"
    parts = (
        f"driver-specific calibration uses the first {train} of a driver's own trajectory, the test"
        f" part is the last {test}"
    )
    if name == "within_driver":
        said = (
            f"calibrated and learned on the first {train} of each pair, tested on the last {test}"
        )
    elif job.setting("protocol.folds") and not job.setting("protocol.run"):
        folds = f"{job.setting('protocol.folds')} folds"
        apart = _TOGETHER.get(str(job.setting("protocol.together")), "")
        said = (
            "trained on some drivers and tested on unseen drivers: nobody is, as follower, in both;"
            f" {folds}{apart}; {parts}"
        )
    elif job.setting("protocol.run"):
        said = (
            "nothing is trained: another job's policy is tested, and pooled calibration is that of"
            f" the drivers it learned from; {parts}"
        )
    else:
        return name
    return f"{name}: {said}"
