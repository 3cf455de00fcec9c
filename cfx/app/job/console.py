"""What a job prints when it has measured, and the lines that MLflow shows as its description."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from rich.console import Console, RenderableType
from rich.markup import escape
from rich.table import Table

from cfx.calibration.identifiability import NEARLY_BEST, flat_for
from cfx.core.registry import Installed
from cfx.errors import without_passwords
from cfx.evaluation.demo import DEMO_PAGE
from cfx.evaluation.headline import headline, interval_in_words
from cfx.evaluation.metrics.base import MetricInfo, key_of
from cfx.evaluation.result import Evaluation, Purpose
from cfx.evaluation.statistics import Improvement
from cfx.evaluation.tables import scope_label
from cfx.figures.wording import plural, short_label
from cfx.results.result import Result
from cfx.results.table import ResultTable, installed
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from cfx.results.tracker import Tracker


def report(result: Result, console: Console, *, verbose: bool = False) -> None:
    """Prints what was measured: one table and one sentence; if `verbose`, all that is known."""
    evaluation, metrics = result.evaluation, result.metrics
    _print_methods(result, console, "test", with_improvement=True)
    if verbose and "full_trajectory" in evaluation.improvements:
        _print_methods(result, console, "full_trajectory")
    compared = _comparisons(evaluation)
    adapts = evaluation.purpose is Purpose.ADAPTATION and bool(compared)
    if verbose and adapts:
        console.print(_improvements_table(result.judge.heading, compared))
    sentences = [_in_short(result)]
    if adapts:
        sentences += _undefined(compared)
    _say(sentences, console)
    for table in installed():
        if table.name in result.tables and (verbose or table.component.always_printed):
            for printed in _printed(table, evaluation, metrics):
                console.print(printed)
    if verbose:
        _say(_remarks(result), console)


def _print_methods(
    result: Result, console: Console, scope: str, *, with_improvement: bool = False
) -> None:
    """Prints a table of methods under a title, which may be wider than the table."""
    _say([f"[italic]{_title(result.evaluation, scope)}"], console)
    console.print(methods_table(result, scope, with_improvement=with_improvement))


def _in_short(result: Result) -> str:
    """Returns the one sentence by which the job is known: in MLflow, a report and Python too."""
    if result.purpose is Purpose.POLICY:
        return (
            "With constant parameters the model follows no leader: compare the policy's RMSE with"
            " other jobs'."
        )
    _, words = headline(result.metrics, result.judge)
    return f"In short: {words}." if words else ""


def _remarks(result: Result) -> list[str]:
    """Returns what else is to be known: safety, parameters, where the policy was not at home."""
    evaluation = result.evaluation
    sentences = _safety(evaluation, result.metrics)
    for scope, words in evaluation.outside.items():
        sentences.append(
            f"Policy, {scope_label(scope)}: {words}; there it fades towards its base parameters."
        )
    for metric in evaluation.left_out:
        sentences.append(
            f"Not measured: {metric.name} of the distribution {metric.distribution}"
            f" ({metric.reason})."
        )
    return sentences


def _printed(
    table: Installed[ResultTable], evaluation: Evaluation, metrics: Mapping[str, float]
) -> tuple[RenderableType, ...]:
    """Returns what is printed about a table; nothing where a plugin's fails."""
    nothing: tuple[RenderableType, ...] = ()
    return table.attempt(lambda component: tuple(component.console(evaluation, metrics)), nothing)


def report_places(
    folder: Path, console: Console, tracker: Tracker, copied_to: str | None = None
) -> None:
    """Prints where the results are, and their copy (a URL), and how to open them."""
    lines = [f"Results: {folder}"]
    if copied_to is not None:
        lines.append(f"Copied to: {copied_to}")
    for page in sorted(folder.glob(f"*/{DEMO_PAGE}")):
        lines.append(f"Demonstration, for any browser: {page}")
    _say([*lines, *tracker.how_to_open()], console, markup=False)


def _say(sentences: Iterable[str], console: Console, *, markup: bool = True) -> None:
    for sentence in sentences:
        if sentence:
            console.print(sentence, soft_wrap=True, highlight=False, markup=markup)


def methods_table(result: Result, scope: str = "test", *, with_improvement: bool = False) -> Table:
    """Returns the metrics of one scope that are headlines: a row per method that has any.

    With `with_improvement` a column says by how much the policy is better than each other method.
    """
    evaluation, metrics = result.evaluation, result.metrics
    table = Table(collapse_padding=True)
    table.add_column("method", no_wrap=True)
    shown = []
    for metric in evaluation.measured:
        if metric.headline and scope in metric.scopes:
            shown.append(metric)
    fitted = _fitted(evaluation) if scope == "test" else pd.DataFrame()
    for metric in shown:
        unit = f"\n[{metric.unit}]" if metric.unit else ""
        # About a word a line: the table fits 80 columns, and no heading is cut.
        heading = re.sub(r"(?<!of) ", "\n", metric.heading)
        table.add_column(escape(f"{heading}{unit}"), justify="right")
        if metric.name in fitted:
            table.add_column("fitted\npart", justify="right")
    baselines = result.baselines(scope) if with_improvement else ()
    if baselines:
        table.add_column(
            "policy better by %,\nmean over drivers\n(95 % interval)", justify="right", no_wrap=True
        )
    for method in evaluation.methods:
        values = []
        for metric in shown:
            values.append(metrics.get(key_of(metric.name, method, scope)))
        if all(value is None for value in values):
            continue
        cells = []
        for metric, value in zip(shown, values, strict=True):
            cells.append(_cell(metric, value))
            if metric.name in fitted:
                cells.append(_cell(metric, fitted[metric.name].get(method)))
        if method in baselines:
            cells.append(_improvement_cell(evaluation.improvements[scope][method]))
        label = (
            result.method_label(method)
            .replace(" over ", "\nover ")
            .replace(" towards ", "\ntowards ")
        )
        table.add_row(label, *cells)
    return table


def _title(evaluation: Evaluation, scope: str) -> str:
    """Returns what a table of methods is of."""
    fits = evaluation.tables.get("fits")
    part = scope_label(scope)
    if scope == "test" and fits is not None and "test_rmse_speed" not in fits:
        part = "all of what was calibrated on"
    pairs = plural(len(evaluation.trajectories), "pair")
    drivers = plural(evaluation.about["driver"].nunique(), "driver")
    return f"{pairs} of {drivers}, {part}, in closed loop"


def _improvement_cell(improvement: Improvement) -> str:
    """Returns an improvement with its interval, in percent."""
    if not improvement.pairs:
        return "not defined"
    interval = interval_in_words(improvement.ci95_low, improvement.ci95_high)
    return f"{100 * improvement.geometric:+.1f} ({interval})"


def _fitted(evaluation: Evaluation) -> pd.DataFrame:
    """Returns a calibration's mean errors on the part that was calibrated on, methods by metrics.

    It is empty where they are not known, and of a job that adapts: its table compares methods.
    """
    fits = evaluation.tables.get("fits")
    if fits is None or evaluation.purpose is not Purpose.CALIBRATION:
        return pd.DataFrame()
    if "test_rmse_speed" not in fits:  # nothing was tested: both would be the same
        return pd.DataFrame()
    means = fits.groupby("method").mean(numeric_only=True).filter(regex="^train_")
    return means.rename(columns=lambda name: name.removeprefix("train_"))


def _cell(metric: MetricInfo, value: float | None) -> str:
    """Returns a number as the table shows it: sums of whole numbers without decimals."""
    if value is None:
        return ""
    if not math.isfinite(value):
        return "not defined"
    if metric.summary == "sum" and value == round(value):
        return f"{value:.0f}"
    return f"{value:.3f}"


def _undefined(compared: Mapping[str, Improvement]) -> list[str]:
    """Returns how many pairs have no improvement over each baseline, where there are such."""
    sentences = []
    for over, improvement in compared.items():
        if improvement.undefined:
            baseline = over.partition(",")[0]
            pairs = improvement.pairs + improvement.undefined
            sentences.append(
                f"Over {' '.join(over.split())}: {improvement.undefined} of {pairs} pairs have no"
                f" improvement: a simulation diverged, or {baseline} has no error at all."
            )
    return sentences


def _comparisons(evaluation: Evaluation) -> dict[str, Improvement]:
    """Returns what the table compares, by what it says in its first column."""
    candidates = [
        ("test", "driver_specific", ""),
        ("steady", "driver_specific", f",\nafter {TRANSIENT_S:g} s"),
        ("test", "shrunk", ""),
        ("test", "pooled", ""),
        ("full_trajectory", "pooled", ", full"),
    ]
    compared = {}
    for scope, baseline, part in candidates:
        improvements = evaluation.improvements.get(scope, {})
        if baseline in improvements:
            compared[f"{short_label(baseline)}{part}"] = improvements[baseline]
    return compared


def _improvements_table(error: str, compared: Mapping[str, Improvement]) -> Table:
    """Returns a row per baseline: improvement, interval, that of the means, and who is better off.

    It fits 80 columns. The other statistics are in `metrics.json` and in the report.
    """
    title = f"Improvement of the policy over other methods, {error}, %"
    table = Table(title=title, title_justify="left")
    table.add_column("over")
    for column in ("geo-\nmetric", "95 % interval", "mean\nerrors", "better for", "p"):
        table.add_column(column, justify="right")
    for over, improvement in compared.items():
        if improvement.pairs == 0:
            table.add_row(over, "not defined")
            continue
        p_value = f"{improvement.p_value:.2g}" if math.isfinite(improvement.p_value) else ""
        table.add_row(
            over,
            f"{100 * improvement.geometric:+.1f}",
            interval_in_words(improvement.ci95_low, improvement.ci95_high),
            f"{100 * improvement.ratio_of_means:+.1f}",
            f"{improvement.win_rate * improvement.pairs:.0f} of {improvement.pairs}",
            p_value,
        )
    return table


def _safety(evaluation: Evaluation, metrics: Mapping[str, float]) -> list[str]:
    """Returns what is to be said of hard braking, of bounds, and of undetermined parameters."""
    sentences = []
    braking = _methods_above(evaluation, metrics, "hard_braking", 1, ".0f")
    if braking:
        sentences.append(f"Frames with an acceleration below -8 m/s2: {braking}.")
    if metrics.get("at_bounds/policy", 0.0) >= 0.01:
        at_bounds = _methods_above(evaluation, metrics, "at_bounds", 0.01, ".0%")
        sentences.append(f"Parameters at their bounds: {at_bounds}.")
    lines = [" ".join(sentences)] if sentences else []
    shares = flat_for(evaluation.table, evaluation.names)
    pairs = int((evaluation.about["method"] == "driver_specific").sum())
    undetermined = []
    for name, share in shares.items():
        if share > 0:
            undetermined.append(f"{name} for {share * pairs:.0f}")
    if undetermined:
        lines.append(
            f"Not determined: {', '.join(undetermined)} of {pairs} pairs (within"
            f" {100 * NEARLY_BEST:.0f} % of the best loss from bound to bound;"
            " flat_NAME is 1 in pairs.csv)."
        )
    return lines


def _methods_above(
    evaluation: Evaluation, metrics: Mapping[str, float], name: str, least: float, form: str
) -> str:
    """Lists the methods whose metric is at least so much, with its value."""
    methods = []
    for method in evaluation.methods:
        value = metrics.get(key_of(name, method), 0.0)
        if value >= least:
            methods.append(f"{short_label(method)} {value:{form}}")
    return ", ".join(methods)


def described(result: Result) -> str:
    """Returns what the job is, its result, its recordings, and the command that was typed."""
    pairs = result.evaluation.recorded
    assert pairs is not None
    chosen = []
    for group in ("model", "policy", "learner", "optimizer", "objective", "protocol"):
        if group == "learner" and result.purpose is Purpose.CALIBRATION:
            continue
        chosen.append(f"{group} **{result.setting(f'{group}.name')}**")
    drivers = len(set(pairs.drivers))
    _, words = headline(result.metrics, result.judge)
    source = Path(pairs.source).name
    lines = [
        f"{words[:1].upper()}{words[1:]}.",
        "",
        ", ".join(chosen) + ".",
        "",
        f"{len(pairs)} pairs of {drivers} drivers from {source} (data"
        f" **{result.component('data')}**), in steps of {pairs.dt:g} s; seed {result.seed}.",
    ]
    typed = [without_passwords(argument) for argument in sys.argv[1:]]
    if typed and Path(sys.argv[0]).name in {"cfx", "__main__.py"}:
        lines += ["", "```", f"cfx {' '.join(typed)}", "```"]
    return "\n".join(lines)
