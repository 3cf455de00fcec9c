"""Writes numbers into documents: those of `results.json`, and of ready-made policies' cards.

    python docs/tables.py

In a document a number stands between two comments that a reader does not see. The first says what
it is: `<!--=unseen-idm:rmse_speed/policy-->0.583 m/s<!--/-->` of a job of `results.json`, or
`<!--=cfx://idm:...-->` of a ready-made policy, a metric of `metrics.json`; or a function of
`TABLES` and its arguments, `<!--=last_part unseen-idm unseen-krauss-->`, between empty lines.
`make tables` runs this, and a test compares.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from cfx.plugin import READY_FOLDER, headline, statistics

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results.json"

MARKED = re.compile(r"<!--=([^>]*?)-->(.*?)<!--/-->", flags=re.DOTALL)
"""A number or a table: what it is, and what stands there."""

MINUS = "\N{MINUS SIGN}"

FIGURE = re.compile(
    rf"[-+{MINUS}]\d+\.\d"  # an improvement: +12.3
    r"|\b\d+(?:\.\d+)? %\s\(\D?\d"  # a percentage with its interval
    r"|\b\d+\.\d{3}\b"  # an error: 0.583
    r"|\b\d+\.\d+\s(?:%|m/s(?!²)|m(?![/\w])|points)"
)
"""What looks measured. It has to come from a file, or the page is in `MEASURED_OTHERWISE`."""

MEASURED_OTHERWISE = {
    "docs/benchmark.md": "`cfx benchmark`, as its tables say",
    "docs/decisions/": "records of their time",
    "docs/hostile_files.md": "`make hostile`",
    "docs/how-to/calibrate.md": "commands beside its tables",
    "docs/how-to/uncertainty.md": "benchmarks of plugins/cfx-posteriors, named on the page",
    "docs/method.md": "tests/evaluation/test_level.py",
    "docs/readers.md": "tests/benchmarks, named on the page",
    "docs/roads.md": "cards of ready-made policies",
    "docs/speed.md": "tests/benchmarks, named on the page",
    "docs/sumo.md": "benchmarks of plugins/cfx-sumo, named on the page",
    "docs/traffic.md": "`cfx drive stress`, `experiment=traffic`",
    "docs/tried.md": "trainings with the settings beside its tables",
}
"""Documents, or folders of them, whose other figures have another source, and which."""

Numbers = Mapping[str, float]


class Format(NamedTuple):
    """How a metric is written."""

    digits: int
    unit: str


FORMATS = {
    "rmse_speed": Format(3, " m/s"),
    "rmse_gap": Format(2, " m"),
    "jerk": Format(2, " m/s³"),
    "collisions": Format(0, ""),
    "hard_braking": Format(0, ""),
}

UNKNOWN = "\N{EN DASH}"
"""In a table, where a job has no such number."""


def results() -> dict[str, Any]:
    """Returns what was measured, by job."""
    found: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return found


def job_of(key: str) -> dict[str, Any]:
    """Returns what was measured of a job.

    Raises:
        KeyError: there is no such job.
    """
    found = results()
    if key not in found:
        raise KeyError(f"docs/results.json has no job '{key}'; make results KEYS={key}")
    job: dict[str, Any] = found[key]
    return job


def numbers_of(source: str) -> Numbers:
    """Returns the metrics of a job of `results.json`, or of a ready-made policy `cfx://NAME`.

    Raises:
        KeyError: there is no such job.
        OSError: there is no such policy.
    """
    if source.startswith("cfx://"):
        folder = READY_FOLDER / source.removeprefix("cfx://")
        metrics: Numbers = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        return metrics
    numbers: Numbers = job_of(source)["numbers"]
    return numbers


def number(value: float, metric: str, *, unit: bool = False) -> str:
    """Returns a metric as it is written, with its unit if that is asked."""
    form = FORMATS[metric]
    return f"{value:.{form.digits}f}{form.unit if unit else ''}"


def percent(share: float) -> str:
    """Returns a share in percent with its sign."""
    return f"{100 * share:+.1f}".replace("-", MINUS)


def improvement(numbers: Numbers, name: str, *, unit: bool = False) -> str:
    """Returns an improvement and its interval, and what the mean errors say if they disagree.

    Args:
        numbers: the job's.
        name: of the improvement, without the statistic.
        unit: whether a percent sign is written.
    """
    geometric = numbers.get(f"{name}/geometric")
    if geometric is None:
        return UNKNOWN
    sign = " %" if unit else ""
    text = f"{percent(geometric)}{sign}"
    low, high = numbers.get(f"{name}/ci95_low"), numbers.get(f"{name}/ci95_high")
    if low is not None and high is not None:
        text += f" ({percent(low)} to {percent(high)})"
    ratio = numbers.get(f"{name}/ratio_of_means")
    if ratio is not None and headline.summaries_disagree(geometric, ratio):
        text += f", of the mean errors {percent(ratio)}{sign}"
    return text


def said(source: str, name: str) -> str:
    """Returns a number as prose states it.

    Args:
        source: a job or a ready-made policy.
        name: a metric, or an improvement without its statistic.

    Raises:
        KeyError: there is no such job or number.
    """
    numbers = numbers_of(source)
    if f"{name}/geometric" in numbers:
        return improvement(numbers, name, unit=True)
    value = numbers[name]
    if "improvement/" in name:
        return f"{percent(value)} %"
    metric = name.split("/")[-2]
    return number(value, metric, unit=True)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns the lines of a table."""
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for row in rows:
        lines.append(f"| {' | '.join(row)} |")
    return lines


def errors(numbers: Numbers, metric: str, methods: Sequence[str], scope: str = "") -> str:
    """Returns the errors of some methods beside one another, the policy's bold."""
    parts = []
    for method in methods:
        value = numbers.get(f"{scope}{metric}/{method}")
        text = UNKNOWN if value is None else number(value, metric)
        parts.append(f"**{text}**" if method == "policy" else text)
    return " / ".join(parts)


def counts(numbers: Numbers, scope: str = "") -> str:
    """Returns collisions of the policy, and frames in which it brakes harder than 8 m/s²."""
    return errors(numbers, "collisions", ["policy"], scope).strip("*") + (
        f", {errors(numbers, 'hard_braking', ['policy'], scope).strip('*')}"
    )


def last_part(*keys: str) -> list[str]:
    """Returns a table of errors on the last part of each trajectory, a row for each job."""
    rows = []
    for key in keys:
        numbers = numbers_of(key)
        over = "improvement/rmse_speed/driver_specific"
        rows.append(
            [
                job_of(key)["what"],
                errors(numbers, "rmse_speed", ["pooled", "driver_specific", "policy"]),
                errors(numbers, "rmse_gap", ["driver_specific", "policy"]),
                improvement(numbers, over),
                improvement(numbers, f"steady/{over}"),
                counts(numbers),
                errors(numbers, "jerk", ["driver_specific", "policy"]),
            ]
        )
    head = (
        "last 20 %",
        "speed, m/s: pooled / driver-specific / policy",
        "gap, m: driver-specific / policy",
        "over driver-specific, %",
        "the same after 5 s",
        "collisions, hard braking",
        "jerk, m/s³: driver-specific / policy",
    )
    return table(head, rows)


def full_trajectories(*keys: str) -> list[str]:
    """Returns a table of errors on full trajectories, of drivers of whom nothing is known."""
    scope = "full_trajectory/"
    rows = []
    for key in keys:
        numbers = numbers_of(key)
        rows.append(
            [
                job_of(key)["what"],
                errors(numbers, "rmse_speed", ["default", "pooled", "policy"], scope),
                errors(numbers, "rmse_gap", ["default", "pooled", "policy"], scope),
                improvement(numbers, f"{scope}improvement/rmse_speed/pooled"),
                counts(numbers, scope),
            ]
        )
    head = (
        "full trajectories",
        "speed, m/s: default / pooled / policy",
        "gap, m: default / pooled / policy",
        "over pooled, %",
        "collisions, hard braking",
    )
    return table(head, rows)


def paper(*keys: str) -> list[str]:
    """Returns a table with the paper's estimator, the mean of ratios, beside the geometric one."""
    rows = []
    for key in keys:
        numbers = numbers_of(key)
        over = "improvement/rmse_speed/driver_specific"
        rows.append(
            [
                job_of(key)["what"],
                errors(numbers, "rmse_speed", ["default", "driver_specific", "policy"]),
                errors(numbers, "rmse_gap", ["default", "driver_specific", "policy"]),
                improvement(numbers, over),
                percent(numbers[f"{over}/mean_ratio"]),
            ]
        )
    head = (
        "last 20 %",
        "speed, m/s: default / driver-specific / policy",
        "gap, m",
        "over driver-specific, %",
        "the paper's mean of ratios, %",
    )
    return table(head, rows)


HORIZONS = ("0.5", "1", "2", "3", "5", "10")
"""s after the origin of a forecast, as metrics name them."""

FORECASTERS = {
    "constant_speed": "constant speed",
    "constant_acceleration": "constant acceleration",
    "default": "default",
    "pooled": "pooled",
    "driver_specific": "driver-specific",
    "pooled_residual": "pooled + residual",
    "driver_specific_residual": "driver-specific + residual",
    "pooled_ar": "pooled, AR(1) noise",
    "driver_specific_ar": "driver-specific, AR(1) noise",
    "policy": "policy",
}
"""Methods of a job of forecasts."""


FORECAST_ERRORS = {
    "rmse_speed": ("forecast", ".3f"),
    "rmse_position": ("forecast", ".2f"),
    "crps_speed": ("distribution", ".3f"),
    "coverage": ("distribution", ".0%"),
}
"""How the metrics of forecasts begin, and how they are written."""


def forecasts(metric: str, *keys: str) -> list[str]:
    """Returns a table of forecasts' errors by horizon, a row for each job.

    Args:
        metric: one of `FORECAST_ERRORS`.
        keys: jobs; `KEY/METHOD` is a method of a job, which stands with the job's name where that
            of another job does too.
    """
    group, form = FORECAST_ERRORS[metric]
    methods = [key.partition("/")[2] for key in keys]
    rows = []
    for key in keys:
        job, _, method = key.partition("/")
        label = job_of(job)["what"]
        if method:
            of_several = methods.count(method) > 1
            label = f"{label}: {FORECASTERS[method]}" if of_several else FORECASTERS[method]
        cells = []
        for horizon in HORIZONS:
            value = numbers_of(job)[f"{group}/{metric}_{horizon}s/{method or 'policy'}"]
            cells.append(format(value, form))
        rows.append([label, *cells])
    return table(("", *(f"{horizon} s" for horizon in HORIZONS)), rows)


def in_short(*keys: str) -> list[str]:
    """Returns a table of improvements alone: over driver-specific and over pooled parameters."""
    rows = []
    for key in keys:
        numbers = numbers_of(key)
        rows.append(
            [
                job_of(key)["what"],
                improvement(numbers, "improvement/rmse_speed/driver_specific"),
                improvement(numbers, "full_trajectory/improvement/rmse_speed/pooled"),
            ]
        )
    head = ("%", "last 20 %, over driver-specific", "full trajectories, over pooled")
    return table(head, rows)


def priors(*models: str) -> list[str]:
    """Returns a table of driver-specific parameters with a weak prior and with the chosen one.

    Args:
        models: names in the keys of jobs, `calibrate-MODEL-weak` and `calibrate-MODEL`.
    """
    rows = []
    for model in models:
        key = f"calibrate-{model}"
        cells = [job_of(key)["what"]]
        for job in (f"{key}-weak", key):
            numbers = numbers_of(job)
            fitted = numbers["calibration/speed_rmse/driver_specific"]
            cells.append(f"{fitted:.3f} / {numbers['rmse_speed/driver_specific']:.3f}")
        rows.append(cells)
    return table(("model", "weak", "chosen"), rows)


def jobs(*beginnings: str) -> list[str]:
    """Returns a table of the jobs whose keys begin so: command, duration, commit, date."""
    rows = []
    for key, job in results().items():
        if not key.startswith(beginnings):
            continue
        rows.append(
            [
                f"`{key}`",
                f"`{job['command'].removeprefix('python -m ')}`",
                f"{job['cpu_minutes']:.1f}",
                f"`{job['commit'][:8]}`",
                job["date"],
            ]
        )
    return table(("job", "command", "CPU minutes", "commit", "date"), rows)


def printed(key: str) -> list[str]:
    """Returns what a job prints of its results, as a block."""
    return ["```text", *job_of(key)["printed"], "```"]


def benchmark() -> list[str]:
    """Returns a table of the rows of `benchmark_pairs.csv`, the smallest error first."""
    pairs = pd.read_csv(ROOT / "docs" / "benchmark_pairs.csv")
    against = pairs[pairs["row"] == "idm, constant"].set_index("pair_id")["rmse_speed"]
    rows = []
    for name, own in pairs.groupby("row"):
        compared = statistics.improvement_statistics(
            against.loc[own["pair_id"]].to_numpy(),
            own["rmse_speed"].to_numpy(),
            own["driver"].tolist(),
        )
        is_rival = name == "idm, constant"
        values = {f"a/{key}": value for key, value in compared.metrics().items()}
        cells = [
            str(name),
            number(own["rmse_speed"].mean(), "rmse_speed"),
            number(own["rmse_gap"].mean(), "rmse_gap"),
            number(own["collisions"].sum(), "collisions"),
            number(own["hard_braking"].sum(), "hard_braking"),
            "" if is_rival else improvement(values, "a"),
        ]
        rows.append(cells)
    rows.sort(key=lambda cells: float(cells[1]))
    head = (
        "row",
        "RMSE of speed [m/s]",
        "RMSE of the gap [m]",
        "collisions",
        "braking frames",
        "speed better by (%)",
    )
    return table(head, rows)


def standing(task: str) -> dict[str, Any]:
    """Returns how the rows of the suite `roads` stand in a task."""
    path = ROOT / "docs" / "benchmark_roads.json"
    tasks: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["tasks"]
    return tasks[task]


DRIVEN = ("new_road", "same_road", "known")
"""Tasks of `roads` in which trajectories are driven."""


def lines_by_row(task: str) -> dict[str, dict[str, Any]]:
    """Returns what a task says of each row of `roads`, by the row's name, the best first."""
    return {line["row"]: line for line in standing(task)["rows"]}


def scores() -> list[str]:
    """Returns the scores of the rows of `roads` in each task, the best on new roads first."""
    tasks = (*DRIVEN, "forecast")
    by_task = {task: lines_by_row(task) for task in tasks}
    rows = []
    for name, line in by_task["new_road"].items():
        cells = [name]
        for task in tasks:
            of_task = by_task[task].get(name)
            if name == "idm, constant" or of_task is None:
                cells.append("")
                continue
            score, low, high = [100 * of_task[key] for key in ("score", "low", "high")]
            cells.append(f"{score:+.0f} % ({low:+.0f} to {high:+.0f})")
        cells.append(f"{100 * line['flow_error']:.0f} %")
        cells.append(f"{(line['train_s'] + line['drive_s']) / 60:.1f}")
        rows.append(cells)
    head = ("row", *[f"`{task}`" for task in tasks], "flow wrong by", "CPU minutes")
    return table(head, rows)


def driving() -> list[str]:
    """Returns errors, over sites, and collisions of the rows of `roads`."""
    head, by_task = ["row"], {}
    for task in DRIVEN:
        by_task[task] = lines_by_row(task)
        head += [f"`{task}`: speed", "gap", "collisions"]
    rows = []
    for name in by_task["new_road"]:
        cells = [name]
        for task in DRIVEN:
            line = by_task[task][name]
            cells.append(number(line["rmse_speed"], "rmse_speed"))
            cells.append(number(line["rmse_gap"], "rmse_gap"))
            cells.append(number(line["collisions"], "collisions"))
        rows.append(cells)
    return table(head, rows)


def horizons(metric: str) -> list[str]:
    """Returns a metric of forecasts of the rows of `roads` at each horizon."""
    seconds = ("0.5", "1", "2", "3", "5", "10")
    rows = []
    for line in standing("forecast")["rows"]:
        values = [line[f"{metric} {horizon} s"] for horizon in seconds]
        if metric == "coverage":
            if None not in values:
                rows.append([line["row"], *[f"{100 * value:.0f} %" for value in values]])
        else:
            rows.append([line["row"], *[f"{value:.3f}" for value in values]])
    return table(("row", *[f"{horizon} s" for horizon in seconds]), rows)


def by_site(task: str) -> list[str]:
    """Returns the error by which a task is judged at each site."""
    of_rows = standing(task)["sites"]
    rows = []
    for name, errors_of_row in of_rows.items():
        rows.append([name, *[f"{error:.3f}" for error in errors_of_row.values()]])
    return table(("row", *next(iter(of_rows.values()))), rows)


def verdicts() -> list[str]:
    """Returns the verdict of each task of `roads`."""
    lines = []
    for task in (*DRIVEN, "forecast"):
        verdict = standing(task)["verdict"]
        lines.append(f"- `{task}`: {verdict[0].lower()}{verdict[1:]}")
    return lines


def card(name: str) -> dict[str, Any]:
    """Returns the card of a ready-made policy."""
    found: dict[str, Any] = json.loads((READY_FOLDER / name / "card.json").read_text("utf-8"))
    return found


def policy_names() -> list[str]:
    """Returns the names of all ready-made policies."""
    return sorted(file.parent.name for file in READY_FOLDER.glob("*/card.json"))


def policies() -> list[str]:
    """Returns a table of all ready-made policies: errors of drivers whom they do not know."""
    rows = []
    for name in policy_names():
        numbers = numbers_of(f"cfx://{name}")
        scope = "full_trajectory/"
        rows.append(
            [
                f"`{name}`",
                errors(numbers, "rmse_speed", ["pooled", "policy"], scope),
                improvement(numbers, f"{scope}improvement/rmse_speed/pooled"),
                errors(numbers, "rmse_speed", ["driver_specific", "policy"]),
                improvement(numbers, "improvement/rmse_speed/driver_specific"),
                errors(numbers, "jerk", ["real", "policy"]),
            ]
        )
    head = (
        "policy",
        "full trajectories, m/s: pooled / policy",
        "over pooled, %",
        "last 20 %, m/s: driver-specific / policy",
        "over driver-specific, %",
        "jerk, m/s³: recorded / policy",
    )
    return table(head, rows)


def site_rows(name: str, scope: str) -> dict[str, Mapping[str, Any]]:
    """Returns what a card says of each site that was left out, of all its drivers, by its name."""
    rows = {}
    for row in card(name)["sites"]:
        if row["scope"] == scope and row["driver_type"] == "all":
            rows["mean over sites" if row["site"] == "all" else row["site"]] = row
    return rows


def gain(row: Mapping[str, Any], baseline: str) -> str:
    """Returns the improvement of a site and its interval."""
    over = f"over_{baseline}"
    text = percent(row[over])
    if f"{over}_low" in row:
        text += f" ({percent(row[f'{over}_low'])} to {percent(row[f'{over}_high'])})"
    return text


def sites(name: str, scope: str) -> list[str]:
    """Returns a table of the errors of a ready-made policy by site, each left out.

    Args:
        name: the policy's.
        scope: `test`, beside driver-specific parameters, or `full_trajectory`, beside pooled ones.
    """
    baseline = {"test": "driver_specific", "full_trajectory": "pooled"}[scope]
    rows = []
    for site, row in site_rows(name, scope).items():
        errors_there = [row[f"rmse_speed_{method}"] for method in (baseline, "policy")]
        rows.append(
            [
                site,
                f"{row['drivers']:.0f}",
                *(f"{error:.3f}" for error in errors_there),
                gain(row, baseline),
            ]
        )
    label = baseline.replace("_", "-")
    return table(("left out", "drivers", f"{label}, m/s", "policy, m/s", "improvement, %"), rows)


def roads(*names: str) -> list[str]:
    """Returns a table of the improvements of several ready-made policies by site."""
    head = ["left out"]
    cells: dict[str, list[str]] = {}
    for name in names:
        head += [
            f"`{name}`: last part, over driver-specific, %",
            "full trajectories, over pooled, %",
        ]
        for scope, baseline in (("test", "driver_specific"), ("full_trajectory", "pooled")):
            for site, row in site_rows(name, scope).items():
                cells.setdefault(site, []).append(gain(row, baseline))
    return table(head, [[site, *row] for site, row in cells.items()])


def traffic() -> list[str]:
    """Returns a table of the traffic that ready-made policies make; bold: outside the usual."""
    measured = {}
    for name in policy_names():
        file = READY_FOLDER / name / "traffic.json"
        if file.is_file():
            measured[name] = json.loads(file.read_text(encoding="utf-8"))["rows"]
    rows = []
    for first in next(iter(measured.values()), []):
        cells = []
        for found in measured.values():
            row = row_of(found, first)
            if row is None:
                cells.append(UNKNOWN)
            else:
                value = row["text"].partition(" vehicles")[0].replace("-", MINUS)
                if row["value"] is None:
                    value = "none"
                cells.append(f"**{value}**" if row["outside"] else value)
        rows.append([f"{first['meaning']}, at {first['step_s']:g} s", *cells, first["usual"]])
    return table(("", *(f"`{name}`" for name in measured), "usual"), rows)


def row_of(rows: Sequence[Mapping[str, Any]], like: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Returns the row of the same measure at the same step; None if there is none."""
    for row in rows:
        if (row["measure"], row["step_s"]) == (like["measure"], like["step_s"]):
            return row
    return None


def stress() -> list[str]:
    """Returns a table of single events in SUMO: collisions, hardest braking, smallest gap."""
    kinds: list[str] = []
    rows = []
    for name in policy_names():
        events = card(name)["stress"]["events"]
        kinds = [f"{event['kind']} ({event['number']})" for event in events]
        cells = []
        for event in events:
            braking, gap = event["hardest_braking"], event["smallest_gap"]
            cells.append(f"{event['collisions']}; {braking:.1f}, {gap:.1f}")
        rows.append([f"`{name}`", *cells])
    return table(("policy", *kinds), rows)


def lights() -> list[str]:
    """Returns a table of what ready-made policies do at lights and in town."""
    rows = []
    for name in policy_names():
        town = card(name)["stress"]["town"]
        rows.append(
            [
                f"`{name}`",
                f"{town['saturation_flow']:,.0f}",
                f"{town['lost_time']:.1f}".replace("-", MINUS),
                f"{town['standing_gap']:.1f}",
                f"{100 * town['outside']:.0f} %",
            ]
        )
    head = (
        "policy",
        "saturation flow (vehicles/h)",
        "start-up lost time (s)",
        "gap at standstill (m)",
        "town: outside the valid range",
    )
    return table(head, rows)


TABLES: dict[str, Callable[..., list[str]]] = {
    "forecasts": forecasts,
    "in_short": in_short,
    "last_part": last_part,
    "full_trajectories": full_trajectories,
    "paper": paper,
    "priors": priors,
    "jobs": jobs,
    "printed": printed,
    "benchmark": benchmark,
    "policies": policies,
    "sites": sites,
    "roads": roads,
    "traffic": traffic,
    "stress": stress,
    "lights": lights,
    "scores": scores,
    "driving": driving,
    "horizons": horizons,
    "by_site": by_site,
    "verdicts": verdicts,
}


def filled(match: re.Match[str]) -> str:
    """Returns a marked place with what has to stand there."""
    what = match[1]
    name, *arguments = what.split()
    if name in TABLES:
        body = "\n\n" + "\n".join(TABLES[name](*arguments)) + "\n\n"
    else:
        source, _, metric = what.rpartition(":")
        body = said(source, metric)
    return f"<!--={what}-->{body}<!--/-->"


def text(page: str) -> str:
    """Returns a document with its numbers filled in."""
    return MARKED.sub(filled, page)


def stray_figures(page: str) -> list[str]:
    """Returns what looks like a measured number and stands outside of marked places and code."""
    prose = MARKED.sub("", page)
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", prose, flags=re.DOTALL)
    return FIGURE.findall(prose)


def entry_of(page: str) -> str:
    """Returns the entry of `MEASURED_OTHERWISE` that a document belongs to, or "".

    Args:
        page: its path in the checkout.
    """
    for entry in MEASURED_OTHERWISE:
        if page == entry or (entry.endswith("/") and page.startswith(entry)):
            return entry
    return ""


def pages() -> Iterator[Path]:
    """Yields all documents that may have marked places."""
    yield ROOT / "README.md"
    yield from sorted((ROOT / "docs").rglob("*.md"))


def main() -> None:
    """Fills the numbers into all documents."""
    for path in pages():
        page = path.read_text(encoding="utf-8")
        new = text(page)
        if new != page:
            path.write_text(new, encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
