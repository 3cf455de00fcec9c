"""Rows of a suite beside one another: scores in which each site counts once, and who is ahead."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from cfx.errors import DataError
from cfx.plugin import files, statistics
from cfx_report.benchmark.compare import read_errors
from cfx_report.benchmark.entries import folder_of, without_seed
from cfx_report.benchmark.i80 import I80
from cfx_report.benchmark.roads import QUICK, ROADS
from cfx_report.benchmark.row import PAIRS, ROW, Row
from cfx_report.benchmark.row import markdown as markdown_of_rows
from cfx_report.benchmark.score import horizon_task
from cfx_report.benchmark.suite import Suite, Task

SUITES = (I80, ROADS, QUICK)

SAVED = ".parquet"
"""How the name of a file of many rows ends."""

_LEAST_MPS = 0.001
"""m/s: smaller errors count as this large: of drivers who stand all methods forecast that they
stand, and a ratio of two zeros says nothing."""


@dataclass(frozen=True)
class Entered:
    """A row with its errors.

    Attributes:
        row: what it says of itself.
        errors: of each task and pair.
        folder: that holds them, or the file of many rows that they were read from.
    """

    row: Row
    errors: pd.DataFrame
    folder: Path

    @classmethod
    def read(cls, place: Path) -> Entered:
        """Reads a row's folder, or the file of its row.

        Raises:
            DataError: there is none.
        """
        path = place / ROW if place.is_dir() else place
        return cls(Row.read(path), read_errors(path.with_name(PAIRS)), path.parent)

    @classmethod
    def read_several(cls, places: Sequence[Path]) -> list[Entered]:
        """Reads rows' folders, and files of many rows, which `save_rows` wrote.

        Raises:
            DataError: one is neither.
        """
        rows = []
        for place in places:
            if place.suffix == SAVED:
                rows += _saved_rows(place)
            else:
                rows.append(cls.read(place))
        return rows


@dataclass(frozen=True)
class Standing:
    """The rows in one task.

    Attributes:
        task: which.
        table: a row each, the best score first: `score` (by which share errors are smaller than the
            baseline's, geometric, each site counts once), `low`, `high`, and means over sites.
        sites: mean error of each row at each site.
        verdict: who is closest to the drivers, and whether it is chance; a method with rows of
            several seeds counts once, with the mean of each pair's errors.
        unit: of the error.
    """

    task: Task
    table: pd.DataFrame
    sites: pd.DataFrame
    verdict: str
    unit: str = "m/s"


def lines_of_row(entered: Entered) -> list[str]:
    """Returns one row as Markdown, beside the baseline where that lies beside it."""
    suite = suite_of([entered])
    if suite.name == "i80":
        return markdown_of_rows([entered.row])
    place = folder_of(suite, suite.baseline, entered.folder.parent)
    rows = [entered]
    if entered.row.name != suite.baseline and (place / ROW).is_file():
        rows.append(Entered.read(place))
    if len(rows) == 1 and entered.row.name != suite.baseline:
        return [f"There is no row '{suite.baseline}' beside it to compare with."]
    return lines_of_rows(rows)


def lines_of_rows(rows: Sequence[Entered]) -> list[str]:
    """Returns rows of one suite as Markdown."""
    if suite_of(rows).name == "i80":
        return markdown_of_rows([entered.row for entered in rows])
    lines: list[str] = []
    for standing in standings(rows):
        lines += ["", *markdown(standing)]
    return lines[1:]


def suite_of(rows: Sequence[Entered]) -> Suite:
    """Returns the suite that all rows are of.

    Raises:
        DataError: they are of different protocols, or of none that this version knows.
    """
    protocols = sorted({entered.row.protocol for entered in rows})
    versions = {protocol.partition("/")[0] for protocol in protocols}
    if len(protocols) > 1 and versions != {I80.version}:  # which marks rows of other pairs
        raise DataError(
            f"the rows are of {', '.join(protocols)}; errors of different protocols or pairs do not"
            " compare"
        )
    version = protocols[0].partition("/")[0]
    for suite in SUITES:
        if suite.version == version:
            return suite
    raise DataError(f"{protocols[0]}: this version of cfx knows no such protocol")


def standings(rows: Sequence[Entered]) -> list[Standing]:
    """Returns how rows stand in each task that all of a suite are asked.

    Raises:
        DataError: they do not compare, or none is the baseline.
    """
    suite = suite_of(rows)
    by_name = {}
    for entered in rows:
        if entered.row.name in by_name:
            raise DataError(f"two rows are called '{entered.row.name}'; give one --name")
        by_name[entered.row.name] = entered
    if suite.baseline not in by_name:
        raise DataError(
            f"scores are relative to the row '{suite.baseline}'; give its folder too (cfx benchmark"
            f" --suite {suite.name} model=idm makes it)"
        )
    ranked = []
    for task in suite.tasks:
        errors = {}
        for name, entered in by_name.items():
            judged = judged_errors(suite, task, entered.errors)
            if len(judged):
                errors[name] = judged
        if suite.baseline in errors:
            ranked.append(_standing(suite, task, errors, by_name))
    return ranked


def judged_errors(suite: Suite, task: Task, errors: pd.DataFrame) -> pd.DataFrame:
    """Returns the error by which a task is judged: pair_id, driver, site, frames, error.

    It is the RMSE of speed; of forecasts the CRPS of speed, in the geometric mean over horizons.
    """
    if task.kind != "forecast":
        judged = errors[errors["task"] == task.name].copy()
        judged["error"] = judged["rmse_speed"].clip(lower=_LEAST_MPS)
    else:
        horizons = [horizon_task(horizon) for horizon in suite.horizons]
        forecasts = errors[errors["task"].isin(horizons)].copy()
        forecasts["error"] = _logarithm(forecasts["crps_speed"].clip(lower=_LEAST_MPS))
        labels = ["pair_id", "driver", "site", "frames"]
        judged = forecasts.groupby(labels, sort=False)["error"].mean().map(math.exp).reset_index()
    return judged[["pair_id", "driver", "site", "frames", "error"]]


def _logarithm(values: pd.Series) -> pd.Series:
    return values.map(math.log)


def _standing(
    suite: Suite,
    task: Task,
    errors: Mapping[str, pd.DataFrame],
    rows: Mapping[str, Entered],
) -> Standing:
    baseline = errors[suite.baseline].set_index("pair_id")
    lines, sites = [], {}
    for name, judged in errors.items():
        both = judged.set_index("pair_id").reindex(baseline.index)
        score = statistics.geometric_over_sites(
            baseline["error"].to_numpy(float),
            both["error"].to_numpy(float),
            baseline["driver"].astype(str).tolist(),
            baseline["site"].tolist(),
        )
        row = rows[name].row
        line: dict[str, object] = {
            "row": name,
            "score": score.geometric,
            "low": score.ci95_low,
            "high": score.ci95_high,
        }
        lines.append(line | _values(suite, task, rows[name].errors) | _costs(row))
        sites[name] = judged.groupby("site", sort=False)["error"].mean()
    table = pd.DataFrame(lines).sort_values("score", ascending=False, ignore_index=True)
    site_of = dict(zip(baseline.index, baseline["site"], strict=True))
    of_seeds: dict[str, list[pd.DataFrame]] = {}
    for name, judged in errors.items():
        of_seeds.setdefault(without_seed(name), []).append(judged)
    verdict = statistics.verdict(statistics.ranking_of(of_seeds, site_of))
    if verdict and len(of_seeds) < len(errors):
        verdict += " Of rows with several seeds it takes the mean of each pair's errors."
    by_site = pd.DataFrame(sites).T.reindex(table["row"])
    return Standing(task, table, by_site, verdict)


def _values(suite: Suite, task: Task, errors: pd.DataFrame) -> dict[str, object]:
    """Returns means over sites, and sums, of what a task measures."""
    values: dict[str, object] = {}
    if task.kind == "forecast":
        for horizon in suite.horizons:
            here = errors[errors["task"] == horizon_task(horizon)]
            means = here.groupby("site")[["rmse_speed", "crps_speed", "coverage"]].mean().mean()
            for metric, value in means.items():
                values[f"{metric} {horizon:g} s"] = float(value)
        return values
    here = errors[errors["task"] == task.name]
    for metric in ("rmse_speed", "rmse_gap"):
        values[metric] = float(here.groupby("site")[metric].mean().mean())
    for metric in ("collisions", "hard_braking"):
        values[metric] = float(here[metric].sum())
    return values


def _costs(row: Row) -> dict[str, object]:
    """Returns what a row took, and its flows."""
    return {
        "flow_error": row.flows.get("flow_error", math.nan),
        "train_s": row.parts.get("train", math.nan),
        "drive_s": row.parts.get("drive", math.nan),
    }


def write_standings(rows: Sequence[Entered], path: Path) -> None:
    """Writes how rows stand in each task as JSON, also what the printed tables leave out.

    Raises:
        DataError: the suite has no tasks to stand in: its rows are `benchmark_pairs.csv` already.
        OutputError: the file cannot be written.
    """
    suite = suite_of(rows)
    if suite.name == "i80":
        raise DataError(f"--json writes the tasks of a suite; {suite.name} has one table alone")
    tasks = {}
    for standing in standings(rows):
        # pandas writes NaN, which JSON has not, as null.
        tasks[standing.task.name] = {
            "rows": json.loads(standing.table.to_json(orient="records", double_precision=6)),
            "sites": json.loads(standing.sites.to_json(orient="index", double_precision=6)),
            "verdict": standing.verdict,
        }
    commands = {entered.row.name: entered.row.command for entered in rows}
    files.write_json(path, {"protocol": suite.protocol, "commands": commands, "tasks": tasks})


def save_rows(rows: Sequence[Entered], path: Path) -> None:
    """Writes rows with the errors of each pair as one file, to be compared with elsewhere.

    Errors are kept to seven digits (float32); pictures of drives are left out.

    Raises:
        DataError: the rows are of different protocols.
        OutputError: the file cannot be written.
    """
    suite_of(rows)
    errors = pd.concat([entered.errors for entered in rows], ignore_index=True)
    numbers = errors.select_dtypes("float").columns
    errors = errors.astype(dict.fromkeys(numbers, "float32"))
    # pandas keeps these beside the columns.
    errors.attrs["rows"] = [asdict(entered.row) for entered in rows]
    with files.atomic_write(path) as temporary:
        errors.to_parquet(temporary, index=False, compression="zstd")


def _saved_rows(path: Path) -> list[Entered]:
    """Reads a file that `save_rows` wrote.

    Raises:
        DataError: it is none.
    """
    try:
        errors = pd.read_parquet(path)
        rows = [Row.of(fields) for fields in errors.attrs["rows"]]
        of_row = dict(list(errors.groupby("row", sort=False)))
        entered = []
        for row in rows:
            entered.append(Entered(row, of_row[row.name].reset_index(drop=True), path))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path}: is no file of rows, as cfx benchmark table --save writes it ({error})"
        ) from None
    return entered


def markdown(standing: Standing) -> list[str]:
    """Returns a task's table as Markdown, and its verdict."""
    return [
        f"### {standing.task.title[0].upper()}{standing.task.title[1:]}",
        "",
        *_table(standing),
        "",
        standing.verdict,
        "",
        "By site:",
        "",
        *_site_table(standing),
    ]


def _table(standing: Standing) -> list[str]:
    columns = [name for name in standing.table.columns if name not in {"row", "low", "high"}]
    shown = [name for name in columns if name == "score" or is_shown(standing, name)]
    lines = [
        f"| row | {' | '.join(HEADINGS.get(name, name) for name in shown)} |",
        "|" + " --- |" * (len(shown) + 1),
    ]
    for line in standing.table.to_dict("records"):
        cells = [str(line["row"])]
        for name in shown:
            cells.append(cell(line, name))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


HEADINGS = {
    "score": "better than the baseline by (95 %)",
    "rmse_speed": "RMSE of speed [m/s]",
    "rmse_gap": "RMSE of gap [m]",
    "collisions": "pairs with a collision",
    "hard_braking": "braking frames",
    "flow_error": "flow wrong by",
    "train_s": "learning [CPU s]",
    "drive_s": "driving [CPU s]",
}


def is_shown(standing: Standing, column: str) -> bool:
    """Says whether a column has a place: RMSE and coverage of forecasts are in the data alone."""
    if column.startswith(("coverage", "rmse_speed ")):
        return False
    return bool(standing.table[column].notna().any())


def cell(line: Mapping[Any, Any], name: str) -> str:
    """Returns a cell of a task's table as text."""
    value = float(line[name])
    if math.isnan(value):
        return ""
    if name == "score":
        low, high = float(line["low"]), float(line["high"])
        # Without 0.0 the baseline would stand there with -0.0 %.
        return f"{100 * value + 0.0:+.1f} % ({100 * low + 0.0:+.1f} to {100 * high + 0.0:+.1f})"
    if name == "flow_error":
        return f"{100 * value:.0f} %"
    if name in {"collisions", "hard_braking", "train_s", "drive_s"}:
        return f"{value:.0f}"
    return f"{value:.2f}" if name == "rmse_gap" else f"{value:.3f}"


def _site_table(standing: Standing) -> list[str]:
    sites = list(standing.sites.columns)
    lines = [f"| row | {' | '.join(sites)} |", "|" + " --- |" * (len(sites) + 1)]
    for name, errors in standing.sites.iterrows():
        cells = [f"{errors[site]:.3f}" for site in sites]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines
