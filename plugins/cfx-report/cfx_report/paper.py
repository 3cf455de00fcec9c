"""The table of a report for a paper, as LaTeX or CSV: a row for each job, or for jobs alike."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cfx.plugin import Purpose, Result, files, identifiability, job_folder, wording
from cfx_report.jobs import Runs
from cfx_report.names import Row, any_adapts, baselines_of, methods_of, rows_of
from cfx_report.sections.calibration import sheet, slices_of, spreads_of

FORMS = {"latex": ".tex", "csv": ".csv"}
"""What a table can be written as, and how its file ends."""

_ESCAPED = re.compile(r"[&%$#_{}]")
"""Characters of a name that LaTeX takes for commands in a caption."""

_LETTERS = {
    "\N{EN DASH}": "--",
    "\N{MINUS SIGN}": "$-$",
    "\N{SUPERSCRIPT TWO}": "$^2$",
    "\N{SUPERSCRIPT THREE}": "$^3$",
    "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT FOUR}": "$^{-4}$",
    "\N{PLUS-MINUS SIGN}": "$\\pm$",
    "\N{MIDDLE DOT}": "$\\cdot$",
    "\N{HORIZONTAL ELLIPSIS}": "\\ldots",
}
"""Letters that pdfLaTeX does not know by itself, or only with packages."""


def write_table(runs: Runs, output: Path, form: str, group_by: str | None = None) -> Path:
    """Writes the table; returns its path.

    Args:
        runs: at least one finished job.
        output: the file; what was there is replaced once the new one is complete.
        form: `latex` or `csv`.
        group_by: a setting such as `seed`: jobs that differ in nothing else share a row, with mean
            and standard deviation. None: a row for each job, with its interval over drivers.

    Raises:
        ConfigError: no job has such a setting.
        OutputError: the file cannot be written.
    """
    rows = rows_of(runs.jobs, group_by)
    text = latex(rows) if form == "latex" else frame(rows).to_csv(index=False)
    files.write_output(output, text, "the table")
    return output


def frame(rows: Sequence[Row]) -> pd.DataFrame:
    """Returns a table of numbers in SI units, improvements as fractions.

    Columns: `row`, `jobs`, `pairs`, `drivers`; `rmse_speed_mps/METHOD`, `rmse_gap_m/METHOD`,
    `collisions/METHOD` and `improvement/BASELINE`, each a mean over the row's jobs, with its
    standard deviation (`.../sd`) where there are several; `improvement/BASELINE/ci95_low` and
    `ci95_high`, over drivers, where there is one; `version` and `command`.
    """
    table = []
    for row in rows:
        values: dict[str, object] = {"row": row.name, "jobs": len(row.jobs), **_amounts(row)}
        for method in methods_of(rows):
            for metric, unit in (("rmse_speed", "_mps"), ("rmse_gap", "_m"), ("collisions", "")):
                values |= _spread(f"{metric}{unit}/{method}", row.values(metric, method))
        for baseline in baselines_of(rows):
            name = f"improvement/{baseline}"
            values |= _spread(name, row.improvements("geometric", baseline))
            if len(row.jobs) == 1:
                for end in ("ci95_low", "ci95_high"):
                    values[f"{name}/{end}"] = row.improvements(end, baseline)[0]
        versions = {job.version for job in row.jobs}
        versions.discard("")
        values["version"] = ", ".join(sorted(versions))
        values["command"] = "; ".join(_command(job) for job in row.jobs)
        table.append(values)
    return pd.DataFrame(table)


def latex(rows: Sequence[Row]) -> str:
    r"""Returns a `table` with rules of `booktabs`, and how it came about in comments."""
    cells = []
    several = max(len(row.jobs) for row in rows) > 1
    for row in rows:
        line = {"": row.name}
        if several:
            line["jobs"] = str(len(row.jobs))
        line["drivers"] = str(_amounts(row)["drivers"])
        for method in methods_of(rows):
            line[wording.short_label(method)] = _text(row.values("rmse_speed", method))
        last = methods_of(rows)[-1]
        line[f"gap, {wording.short_label(last)} [m]"] = _text(row.values("rmse_gap", last), 2)
        for baseline in baselines_of(rows):
            line[f"over {wording.short_label(baseline)}"] = _improvement(row, baseline)
        cells.append(line)
    caption = "RMSE of speed [m/s] by method, in closed loop on the test part of each trajectory"
    if any_adapts(rows):
        caption += "; improvement of the policy"
    if several:
        caption += "; mean and standard deviation over the jobs of a row"
    elif any_adapts(rows):
        caption += "; improvements with their 95 \\% interval over drivers"
    body = _latex_table(pd.DataFrame(cells).fillna("--"), f"{caption}.", "tab:cfx")
    comments = ["% Needs \\usepackage{booktabs}."]
    for row in rows:
        for job in row.jobs:
            origin = f"cfx {job.version}: {_command(job)}".replace("\n", " ")
            comments.append(f"% {row.name}: {origin}")
    return "\n".join([*comments, body, *_parameter_tables(rows)])


def _latex_table(table: pd.DataFrame, caption: str, label: str) -> str:
    """Returns a table of text: the first column to the left, the others to the right."""
    styled = table.style.hide(axis="index").format(escape="latex")
    styled = styled.format_index(escape="latex", axis=1)
    body: str = styled.to_latex(
        hrules=True,
        column_format="l" + "r" * (table.shape[1] - 1),
        position_float="centering",
        caption=caption,
        label=label,
    )
    for letter, command in _LETTERS.items():
        body = body.replace(letter, command)
    return body


def _parameter_tables(rows: Sequence[Row]) -> Iterator[str]:
    """Yields a table of the calibrated parameters of each calibration."""
    for row in rows:
        job = row.jobs[0]
        spreads = spreads_of(job) if job.purpose is Purpose.CALIBRATION else ()
        if not spreads:
            continue
        parameters = sheet(spreads, slices_of(job))
        lines = []
        for line in parameters.rows:
            lines.append([cell.text for cell in line])
        table = pd.DataFrame(lines, columns=[column.heading for column in parameters.columns])
        name = _ESCAPED.sub(r"\\\g<0>", row.name)
        caption = (
            f"Calibrated parameters, {name}: the model's default, the mean of the folds' pooled"
            " parameters, and median and quantiles of the driver-specific ones. Flat: the loss is"
            f" within {100 * identifiability.NEARLY_BEST:.0f} \\% of a driver's best, on so much of"
            " the range (median over pairs), and for so many pairs on all of it."
        )
        label = re.sub(r"\W+", "-", row.name).strip("-")
        yield _latex_table(table, caption, f"tab:cfx-parameters-{label}")


def _amounts(row: Row) -> dict[str, int]:
    pairs: set[str] = set()
    drivers: set[str] = set()
    for job in row.jobs:
        pairs |= set(job.pairs["pair_id"].astype(str))
        drivers |= set(job.pairs["driver"].astype(str))
    return {"pairs": len(pairs), "drivers": len(drivers)}


def _spread(name: str, values: np.ndarray) -> dict[str, float]:
    measured = values[np.isfinite(values)]
    if not len(measured):
        return {name: math.nan}
    spread = {name: float(measured.mean())}
    if len(values) > 1:
        spread[f"{name}/sd"] = float(measured.std(ddof=1)) if len(measured) > 1 else math.nan
    return spread


def _text(values: np.ndarray, digits: int = 3) -> str:
    measured = values[np.isfinite(values)]
    if not len(measured):
        return "--"
    if len(measured) == 1:
        return f"{measured[0]:.{digits}f}"
    return f"{measured.mean():.{digits}f} ± {measured.std(ddof=1):.{digits}f}"


def _improvement(row: Row, baseline: str) -> str:
    values = row.improvements("geometric", baseline)
    percentages = 100 * values[np.isfinite(values)]
    if not len(percentages):
        return "--"
    if len(percentages) > 1:
        return f"{percentages.mean():+.1f} ± {percentages.std(ddof=1):.1f} %"
    low, high = (100 * row.improvements(end, baseline)[0] for end in ("ci95_low", "ci95_high"))
    if not math.isfinite(low):
        return f"{percentages[0]:+.1f} %"
    return f"{percentages[0]:+.1f} % ({low:+.1f} to {high:+.1f})"


def _command(job: Result) -> str:
    """Returns what was typed, without the folders of absolute paths."""
    if job.overrides is None:
        return "not known"
    typed = " ".join(("python -m cfx", *job.overrides))
    return job_folder.without_folders(typed)
