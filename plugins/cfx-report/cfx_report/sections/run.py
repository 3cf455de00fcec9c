"""What was run: data, components and settings of each job, and its whole configuration."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Any

import pandas as pd
import yaml

from cfx.plugin import Purpose, Result, job_folder, wording
from cfx_report.jobs import Runs, are_calibrations
from cfx_report.section import Column, Section, Sheet

_TOGETHER = {"platoon": " of whole platoons", "recording": " of whole recordings"}


class RunSection(Section):
    """What was run: data, components and settings of each job."""

    title = "What was run"
    entry = "What was run"
    order = 300
    template = """
{% if unfinished %}
<p class="lacking">Not in this page, because they have not finished:</p>
<ul>{% for place, reason in unfinished %}<li>{{ place }}: {{ reason }}</li>{% endfor %}</ul>
{% endif %}
<dl class="facts">
{% for name, value in common %}
  <div><dt>{{ name }}</dt><dd>{{ value }}</dd></div>
{% endfor %}
</dl>
{% if differing %}
<h3>What differs between the jobs</h3>
{{ table(differing) }}
{% endif %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return what all jobs share, and a table of what they do not."""
        unfinished = []
        for job in runs.unfinished:
            unfinished.append((job_folder.without_folders(job.place), job.reason))
        common, differing = facts(runs.jobs)
        return {"unfinished": unfinished, "common": common, "differing": differing}


class ConfigurationsSection(Section):
    """The whole configuration of each job."""

    title = "Configurations"
    entry = "Configurations"
    order = 2000
    template = """
<p>The whole configuration of each job, as it ran.</p>
{% for name, place, configuration in configurations %}
{% call fold(name) %}
<p class="fine">{{ place }}</p>
<pre>{{ configuration }}</pre>
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the place and the configuration of each job."""
        configurations = []
        for job in runs.jobs:
            configurations.append(
                (job.name, job_folder.without_folders(job.place), _configuration(job))
            )
        return {"configurations": configurations}


def _configuration(job: Result) -> str:
    """Returns the configuration as YAML, after what the protocol noted of its design."""
    design = ""
    notes = job.data.get("protocol")
    if isinstance(notes, Mapping):
        for name, value in notes.items():
            design += f"# {str(name).replace('_', ' ')}: {value}\n"
    text = yaml.safe_dump(dict(job.config), sort_keys=False, allow_unicode=True)
    return design + job_folder.without_folders(str(text))


def facts(jobs: Sequence[Result]) -> tuple[list[tuple[str, str]], Sheet | None]:
    """Returns what all jobs share, and a table of what they do not (None if they share all)."""
    rows = []
    names: dict[str, None] = {}
    for job in jobs:
        of_job = _facts(job, jobs)
        rows.append({"Job": job.name, **of_job})
        names |= dict.fromkeys(of_job)
    common = []
    columns = [Column[Mapping[str, str]]("Job", itemgetter("Job"))]
    for name in names:
        for row in rows:
            row.setdefault(name, wording.NOTHING)
        values = {row[name] for row in rows}
        if len(values) == 1:
            common.append((name, values.pop()))
        else:
            columns.append(Column(name, itemgetter(name)))
    return common, Sheet.of(columns, rows) if len(columns) > 1 else None


def duration(seconds: float | None) -> str:
    """Returns a duration as one says it: "42 s", "3 min 5 s", "2 h 10 min"."""
    if seconds is None:
        return "not recorded"
    minutes, whole_seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    if minutes:
        return f"{minutes} min {whole_seconds} s"
    return f"{whole_seconds} s"


def _facts(job: Result, jobs: Sequence[Result]) -> dict[str, str]:
    table = job.pairs.drop_duplicates("pair_id")
    facts = {
        "Started": f"{job.started:%Y-%m-%d %H:%M}" if job.started else "not recorded",
        "Took": duration(job.seconds),
        **_typed(job, jobs),
    }
    if job.setting("preset"):
        facts["Preset"] = job.setting("preset")
    return facts | {
        "Data": job_folder.without_folders(
            str(job.data.get("source") or job.component("data") or wording.NOTHING)
        ),
        "Pairs": f"{len(table)} pairs of {table['driver'].nunique()} drivers",
        "Left out": _left_out(job),
        "Test frames of a pair": _range(table["frames"]),
        "Drivers by style": str(job.setting("style.cluster") or wording.NOTHING),
        "Protocol": _protocol(job),
        "Driving model": job.component("model") or wording.NOTHING,
        **_policy(job, jobs),
        "Calibrated by": _calibration(job),
        "Seed": str(job.config.get("seed", wording.NOTHING)),
        "cfx": job.version or "version not recorded",
        "Read from": job_folder.without_folders(job.place),
    }


def _calibration(job: Result) -> str:
    """Says which optimizer calibrated, and what it minimised."""
    words = job.component("optimizer") or wording.NOTHING
    objective = job.data.get("objective")
    if isinstance(objective, Mapping):
        words += f", which minimises {objective.get('name')} ({objective.get('unit')})"
    return words


def _left_out(job: Result) -> str:
    parts = []
    for dropped in job.data.get("dropped") or ():
        if isinstance(dropped, Mapping):
            parts.append(f"{dropped.get('count')} {dropped.get('unit')} ({dropped.get('reason')})")
    return "; ".join(parts) or "nothing"


def _typed(job: Result, jobs: Sequence[Result]) -> dict[str, str]:
    """Returns what was typed: of several jobs, what they share and what each has of its own."""
    if job.overrides is None:
        return {"Command": "not recorded"}
    if len(jobs) == 1:
        return {"Command": _command(job.overrides)}
    shared = _shared_overrides(jobs)
    of_job = [override for override in job.overrides if override not in shared]
    return {
        "Command": f"{_command(shared)} …",
        "Overrides of its own": job_folder.without_folders(shlex.join(of_job)) or "none",
    }


def _command(overrides: Sequence[str]) -> str:
    """Returns what was typed, without the folders of absolute paths."""
    return job_folder.without_folders(shlex.join(["python", "-m", "cfx", *overrides]))


def _shared_overrides(jobs: Sequence[Result]) -> list[str]:
    """Returns the overrides that all jobs with known overrides have, in order."""
    typed = [job.overrides for job in jobs if job.overrides is not None]
    shared = []
    for override in typed[0]:
        if all(override in other for other in typed):
            shared.append(override)
    return shared


def _range(values: pd.Series[Any]) -> str:
    low, high = int(values.min()), int(values.max())
    return str(low) if low == high else f"{low} to {high}"


def _policy(job: Result, jobs: Sequence[Result]) -> dict[str, str]:
    """Returns which policy a job has; nothing where all jobs are calibrations."""
    if are_calibrations(jobs):
        return {}
    return {"Policy": f"{job.component('policy')}, {_learned(job)}"}


def _learned(job: Result) -> str:
    """Says how the policy was learned."""
    learner = job.component("learner")
    if job.purpose is Purpose.CALIBRATION:
        return "constant parameters, nothing is learned"
    if learner:
        return f"learned by {learner}"
    return f"as it was learned in {job.setting('protocol.run')}"


def _protocol(job: Result) -> str:
    """Says who was calibrated, learned from and tested, on which part of trajectories."""
    name = job.component("protocol")
    train, test = f"{100 * job.split:.3g} %", f"{100 * (1 - job.split):.3g} %"
    parts = (
        f"driver-specific calibration uses the first {train} of a driver's own trajectory, the test"
        f" part is the last {test}"
    )
    if name == "within_driver" and job.split == 1:
        return f"{name}: calibrated on whole trajectories, of which the errors are"
    if name == "within_driver":
        used = "calibrated" if job.purpose is Purpose.CALIBRATION else "calibrated and learned"
        return f"{name}: {used} on the first {train} of each pair, tested on the last {test}"
    if job.setting("protocol.run"):
        return (
            f"{name}: nothing is trained: another job's policy is tested, and pooled calibration is"
            f" that of the drivers it learned from; {parts}"
        )
    if job.setting("protocol.folds"):
        folds = f"{job.setting('protocol.folds')} folds"
        together = _TOGETHER.get(str(job.setting("protocol.together")), "")
        return (
            f"{name}: trained on some drivers and tested on unseen drivers: nobody is, as follower,"
            f" in both; {folds}{together}; {parts}"
        )
    return name
