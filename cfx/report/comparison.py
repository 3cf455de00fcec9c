"""All jobs side by side: how close each drives in m/s and m, which compares across driving models, and how safely."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cfx.evaluation.result import METHODS
from cfx.figures.look import COLOURS, INK, LABELS, percent
from cfx.report.figure import Plot, Trace, axis, safe, view
from cfx.report.read import Job, finite, improvement_of
from cfx.report.tables import BASELINES, NOTHING, SHORT, Cell, Column, Sheet, number, tested, text

_WIDE = 1.6
"""An axis of errors reaches so many times as far as the largest error of the methods but `default`, which may lie far off."""


def closeness(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job: the errors of each method, and the policy's improvement. The numbers are those of `metrics.json`."""
    shown = {
        where: [m for m in METHODS if any(_known(job, f"{where}rmse_speed", m) for job in jobs)]
        for where in ("", "whole/")
    }
    gains = [
        (b, where)
        for b, where in (
            ("fixed", ""),
            ("shrunk", ""),
            ("population", ""),
            ("population", "whole/"),
        )
        if _compared(jobs, b, where)
    ]
    frames = {
        "": tested(jobs),
        "whole/": "the whole drive of drivers whom nothing was fitted to, from its first frame on",
    }
    columns = [Column("Job", "", number=False)]
    for where, methods in shown.items():
        columns += [Column(_name(m), f"{_said(m)}: RMSE over {frames[where]}.") for m in methods]
    columns += [
        Column(
            f"over {_name(b)}{', whole' if where else ''}",
            f"Mean improvement of the RMSE of speed over {BASELINES[b]}, on {frames[where]}; below it the 95 % interval.",
        )
        for b, where in gains
    ]
    rows = [
        (
            text(job.name),
            *(_error(job, where, method) for where, methods in shown.items() for method in methods),
            *(_gain(job, baseline, where) for baseline, where in gains),
        )
        for job in jobs
    ]
    groups = [("", 1), ("Test part: RMSE of speed in m/s, below it of gap in m", len(shown[""]))]
    groups += [("Whole drives: the same", len(shown["whole/"]))] if shown["whole/"] else []
    groups += [("Improvement of the policy", len(gains))] if gains else []
    return Sheet(tuple(columns), _with_best(rows, jobs, columns), tuple(groups))


def safety(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job: what the policy does that is not safe or not smooth, and below it what a baseline does."""
    kinds = [
        kind
        for kind in _SAFETY
        if any(_known(job, f"{kind[0]}{kind[1]}", "policy") for job in jobs)
    ]
    columns = [Column("Job", "", number=False)]
    columns += [
        Column(name, f"{meaning} Below it the same for {_said(base)}.")
        for _, _, base, name, meaning, _ in kinds
    ]
    rows = [
        (
            text(job.name),
            *(_pair(job, f"{where}{name}", base, form) for where, name, base, _, _, form in kinds),
        )
        for job in jobs
    ]
    platoon = sum(kind[0] == "platoon/" for kind in kinds)
    groups = (("", 1), (_RECORDED, len(kinds) - platoon), (_IN_PLATOON, platoon))
    return Sheet(tuple(columns), tuple(rows), tuple((name, span) for name, span in groups if span))


_RECORDED = "Behind recorded leaders; below it own fixed, on whole drives population"
_IN_PLATOON = "Platoon behind a braking leader; below it population"
_PLATOON = "Ten followers in a row, all driven by the policy, behind a leader that brakes from 15 to 7 m/s and recovers."
_AMPLIFICATION = "By how many times as much as the leader the last follower slows down, mean over the networks; above 1 the platoon amplifies."
_STABLE = "Share of the networks with a string stable platoon: nobody slows down more than the vehicle ahead (by over 0.1 m/s)."


_SAFETY = (
    (
        "",
        "collisions",
        "fixed",
        "Collisions",
        "Pairs in which the simulated gap becomes negative, on the test part.",
        ".0f",
    ),
    ("whole/", "collisions", "population", "whole drives", "The same over whole drives.", ".0f"),
    (
        "",
        "hard_braking",
        "fixed",
        "Hard braking",
        "Frames with an acceleration below \N{MINUS SIGN}8 m/s², test part.",
        ".0f",
    ),
    ("whole/", "hard_braking", "population", "whole drives", "The same over whole drives.", ".0f"),
    (
        "",
        "jerk",
        "fixed",
        "Jerk (m/s³)",
        "Root mean square jerk on the test part, mean over the pairs.",
        ".2f",
    ),
    (
        "",
        "at_bounds",
        "fixed",
        "At bounds",
        "Share of the tuned parameters' values within 1 % of a bound.",
        ".0%",
    ),
    (
        "platoon/",
        "head_to_tail",
        "population",
        "Amplification",
        f"{_PLATOON} {_AMPLIFICATION}",
        ".2f",
    ),
    ("platoon/", "string_stable", "population", "Stable", f"{_PLATOON} {_STABLE}", ".0%"),
    (
        "platoon/",
        "min_gap",
        "population",
        "Least gap (m)",
        f"{_PLATOON} The least gap of all.",
        ".1f",
    ),
    (
        "platoon/",
        "collisions",
        "population",
        "Collisions",
        f"{_PLATOON} Followers that collide, of all platoons.",
        ".0f",
    ),
)
"""Columns: where it was measured, the metric, the baseline below, the heading, what it means, how it is written."""


def safety_of_methods(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job and method, with the recorded drivers for comparison."""
    columns = [
        Column("Job", "", number=False),
        Column("Driven by", "The method; real: the recorded drivers.", number=False),
    ]
    columns += [Column(name, "") for name, _, _ in _OF_METHODS]
    platoon = sum(key.startswith("platoon/") for _, key, _ in _OF_METHODS)
    groups = (
        ("", 2),
        ("Behind recorded leaders, test part", len(_OF_METHODS) - platoon),
        ("Platoon", platoon),
    )
    rows = []
    for job in jobs:
        for method in ("real", *_methods(job)):
            cells = [_cell(job, f"{key}/{method}", form) for _, key, form in _OF_METHODS]
            if any(cell.sort for cell in cells):
                rows.append((text(job.name), Cell(_name(method), colour=method), *cells))
    return Sheet(tuple(columns), tuple(rows), groups)


_OF_METHODS = (
    ("Collisions", "collisions", ".0f"),
    ("Hard braking", "hard_braking", ".0f"),
    ("Jerk (m/s³)", "jerk", ".2f"),
    ("At bounds", "at_bounds", ".1%"),
    ("last / leader", "platoon/head_to_tail", ".2f"),
    ("last / first", "platoon/amplification", ".2f"),
    ("Stable", "platoon/string_stable", ".0%"),
    ("Settled", "platoon/settled", ".0%"),
    ("Least gap (m)", "platoon/min_gap", ".1f"),
    ("Collisions", "platoon/collisions", ".0f"),
    ("Hard braking", "platoon/hard_braking", ".0f"),
)


def absolute(jobs: Sequence[Job]) -> Plot:
    """Errors of each method in m/s and m: a line per job; a view for each kind of error and part of drives."""
    kinds = {
        "speed, test part": ("rmse_speed", "m/s"),
        "gap, test part": ("rmse_gap", "m"),
        "speed, test part beyond the first 5 s": ("steady/rmse_speed", "m/s"),
        "speed, whole drives": ("full_trajectory/rmse_speed", "m/s"),
        "gap, whole drives": ("full_trajectory/rmse_gap", "m"),
    }
    known = {
        name: kind
        for name, kind in kinds.items()
        if any(_known(job, kind[0], "policy") for job in jobs)
    }
    views = {name: _absolute_view(jobs, metric, unit) for name, (metric, unit) in known.items()}
    return Plot(views, 110 + 30 * len(jobs), "Errors of every job and method", chooser="RMSE of")


def _absolute_view(jobs: Sequence[Job], metric: str, unit: str) -> dict[str, Any]:
    places = np.arange(len(jobs))[::-1]
    data: list[Trace] = []
    values = {
        m: np.array(
            [_metric(job, f"{metric}/{m}") if m in _methods(job) else math.nan for job in jobs]
        )
        for m in METHODS
    }
    for method in (m for m in METHODS if np.isfinite(values[m]).any()):
        hover = [
            f"<b>{safe(job.name)}</b><br>{LABELS[method]}: {v:.3f} {unit}"
            for job, v in zip(jobs, values[method], strict=True)
        ]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": LABELS[method],
                "x": values[method],
                "y": places,
                "text": hover,
                "hovertemplate": "%{text}<extra></extra>",
                "marker": {
                    "size": 14 if method == "policy" else 11,
                    "color": COLOURS.get(method, INK),
                    "symbol": "diamond" if method == "policy" else "circle",
                },
            }
        )
    near = finite(np.concatenate([values[m] for m in METHODS if m != "default"]))
    end = _WIDE * float(near.max(initial=1e-9))
    off = finite(values["default"])
    off = off[off > end]
    right = (
        end
        if len(off)
        else 1.06 * float(max(near.max(initial=1e-9), finite(values["default"]).max(initial=0.0)))
    )
    beyond = (
        f" {len(off)} default parameters are further off, up to {off.max():.3g} {unit}."
        if len(off)
        else ""
    )
    layout = {
        "xaxis": axis(
            f"RMSE ({unit}), mean over pairs; further left is closer to the real driver",
            range=[0, right],
        ),
        "yaxis": axis(
            tickvals=places,
            ticktext=[safe(job.name) for job in jobs],
            range=[-0.6, len(jobs) - 0.4],
            showgrid=True,
            ticks="",
        ),
    }
    return view(data, layout, beyond.strip())


def _methods(job: Job) -> tuple[str, ...]:
    """Returns the methods of a job that mean something."""
    return job.methods if job.has_constant_baseline else ("policy",)


def _name(method: str) -> str:
    return SHORT.get(method, method)


def _said(method: str) -> str:
    return (BASELINES | {"policy": "parameters that the policy chooses anew as it drives"})[method]


def _metric(job: Job, name: str) -> float:
    return job.metrics.get(name, math.nan)


def _known(job: Job, metric: str, method: str) -> bool:
    return method in _methods(job) and f"{metric}/{method}" in job.metrics


def _compared(jobs: Iterable[Job], baseline: str, where: str) -> bool:
    return any(baseline in job.baselines(where) for job in jobs)


def _error(job: Job, where: str, method: str) -> Cell:
    if not _known(job, f"{where}rmse_speed", method):
        return number(math.nan, "")
    speed, gap = (_metric(job, f"{where}{name}/{method}") for name in ("rmse_speed", "rmse_gap"))
    return replace(number(speed, f"{speed:.3f}"), second=f"{gap:.2f}" if math.isfinite(gap) else "")


def _gain(job: Job, baseline: str, where: str) -> Cell:
    if baseline not in job.baselines(where):
        return number(math.nan, "")
    mean, low, high = (
        _metric(job, f"{improvement_of(baseline, where)}/{name}")
        for name in ("mean", "ci95_low", "ci95_high")
    )
    second = f"{_bare(low)} to {_bare(high)}" if math.isfinite(low) and math.isfinite(high) else ""
    return replace(number(mean, percent(mean, 1)), second=second)


def _bare(fraction: float) -> str:
    return percent(fraction, 1).removesuffix(" %")


def _cell(job: Job, metric: str, form: str) -> Cell:
    value = _metric(job, metric)
    return number(value, _formed(value, form))


def _formed(value: float, form: str) -> str:
    return (f"{value:{form}}".replace("%", " %") if math.isfinite(value) else NOTHING).replace(
        "-", "\N{MINUS SIGN}"
    )


def _pair(job: Job, metric: str, baseline: str, form: str) -> Cell:
    cell = _cell(job, f"{metric}/policy", form)
    if not _known(job, metric, baseline):
        return cell
    return replace(cell, second=_formed(_metric(job, f"{metric}/{baseline}"), form))


def _with_best(
    rows: Sequence[tuple[Cell, ...]], jobs: Sequence[Job], columns: Sequence[Column]
) -> tuple[tuple[Cell, ...], ...]:
    """Marks the policy's smallest error and largest improvement, where all jobs drove the same pairs."""
    same = (
        len(
            {
                (str(job.data.get("fingerprint")), frozenset(job.pairs["pair_id"]), job.split)
                for job in jobs
            }
        )
        == 1
    )
    if len(rows) < 2 or not same:
        return tuple(rows)
    marked = []
    for column, cells in zip(columns, zip(*rows, strict=True), strict=True):
        known = [float(cell.sort) for cell in cells if cell.number and cell.sort]
        choose = (
            {"p": min, "o": max}.get(column.heading[0])
            if column.heading.startswith(("policy", "over"))
            else None
        )
        best = repr(choose(known)) if choose is not None and known else None
        marked.append([replace(cell, best=cell.number and cell.sort == best) for cell in cells])
    return tuple(zip(*marked, strict=True))
