"""The page: one HTML file with its plots, tables, scripts and styles in it."""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from cfx.errors import OutputError
from cfx.figures.look import CLUSTER_COLOURS, COLOURS, LABELS, percent
from cfx.files import atomic_write
from cfx.report import comparison, paper, tables
from cfx.report.drive_plots import chosen_trajectories, drive
from cfx.report.figure import Plot
from cfx.report.history_plot import histories, history
from cfx.report.improvement_plots import overview, per_cluster, per_driver
from cfx.report.learning_plot import learning
from cfx.report.names import SEPARATOR, differences
from cfx.report.platoon_plot import platoon
from cfx.report.read import Job, Runs, improvement_of
from cfx.report.style_plot import style
from cfx.report.tables import BASELINES, NOTHING
from cfx.style.result import CLUSTERS

_ASSETS = resources.files("cfx.report") / "assets"
_SCRIPTS = ("sortable/sortable.min.js", "sortable/sortable.a11y.min.js", "page.js")


@dataclass(frozen=True)
class Drives:
    """The drives of one job that are shown.

    Attributes:
        job: the job's name.
        drives: heading and plot of each.
    """

    job: str
    drives: tuple[tuple[str, Plot], ...]


def write_report(runs: Runs, output: Path, title: str | None = None) -> Path:
    """Writes the page about some jobs; returns its path.

    Args:
        runs: at least one finished job.
        output: the file; what was there is replaced once the new page is complete.
        title: of the page; None for one that names the driving models.

    Raises:
        OutputError: the page cannot be written.
    """
    page = render(runs, title)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        if output.is_dir():
            raise IsADirectoryError(None, "it is a folder", str(output))
        with atomic_write(output) as partial:
            partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{output}: the report cannot be written ({error.strerror or error}); name another --output"
        ) from error
    return output


def render(runs: Runs, title: str | None = None) -> str:
    """Returns the page about some jobs as HTML."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(_asset),
    )
    environment.filters["embedded"] = _embedded
    return environment.get_template("page.html.j2").render(_content(runs, title))


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _embedded(plot: Plot) -> Any:
    """Returns a plot as JSON that can stand inside a script element, whatever names it holds."""
    from markupsafe import Markup
    from plotly.utils import PlotlyJSONEncoder

    content = {"views": plot.views, "orders": plot.orders, "height": plot.height}
    text = json.dumps(content, cls=PlotlyJSONEncoder, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)  # noqa: S704 - JSON without any sign that HTML knows


def _scripts() -> list[Any]:
    """Returns the page's scripts: Plotly, the sorter, the page's own."""
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    sources = [get_plotlyjs(), *(_asset(name) for name in _SCRIPTS)]
    # Nothing of cfx's own data is in them; an end tag inside a string would end the element.
    return [Markup(source.replace("</script", "<\\/script")) for source in sources]  # noqa: S704


def _policy(scripts: Sequence[str]) -> str:
    """Returns the Content-Security-Policy: only these very scripts run, and nothing is ever asked from a network."""
    allowed = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'"
        for one in scripts
    )
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none';"
        " form-action 'none'"
    )


def _content(runs: Runs, title: str | None) -> dict[str, Any]:
    jobs = runs.jobs
    scripts = _scripts()
    models = " and ".join(dict.fromkeys(job.component("model") for job in jobs))
    compared = [job for job in jobs if job.has_constant_baseline]
    common, own = facts(jobs)
    return {
        "title": title or f"Parameters that adapt: {models}",
        "written": f"{datetime.now():%d %B %Y}".lstrip("0"),
        "scripts": scripts,
        "security": _policy(scripts),
        "style": _asset("page.css") + _method_colours(),
        "summary": summary(jobs),
        "jobs": jobs,
        "common": common,
        "own": own,
        "configs": [(job.name, job.place, _configuration(job)) for job in jobs],
        "unfinished": runs.unfinished,
        "closeness": comparison.closeness(jobs),
        "safety": comparison.safety(jobs),
        "absolute": comparison.absolute(jobs),
        "safety_of_methods": comparison.safety_of_methods(jobs),
        "platoons": [(job.name, platoon(job)) for job in jobs if job.platoon is not None],
        "histories": [(job.name, history(job)) for job in jobs if job.history is not None],
        "history_sheet": histories(jobs),
        "not_following": [job.name for job in jobs if not job.has_constant_baseline],
        "errors": tables.errors(jobs),
        "compared": _compared(compared) if compared else None,
        "styles": _styles(jobs),
        "drives": [_drives(job) for job in jobs if job.drives is not None],
        "curves": [
            (job.name, curves["network"].nunique(), learning(curves))
            for job, curves in _training_result(jobs)
        ],
        "nothing_learned": [
            job.name for job in jobs if job.curves is not None and not len(job.curves)
        ],
        "without": {
            file: [job.name for job in jobs if file in job.missing]
            for file in ("style.csv", "trajectories.parquet", "curves.parquet")
        },
        "paper": paper.comparisons(jobs),
    }


def _compared(jobs: Sequence[Job]) -> dict[str, Any]:
    """Returns what compares the policy with constant parameters."""
    baselines = list(dict.fromkeys(baseline for job in jobs for baseline in job.baselines()))
    series = cluster_series(jobs)
    return {
        "overview": overview(jobs),
        "improvements": tables.improvements(jobs),
        "per_driver": per_driver(jobs),
        "per_cluster": per_cluster(series, baselines),
        "cluster_sheets": [
            (LABELS.get(one, one), tables.clusters(series, one)) for one in baselines
        ],
    }


def _method_colours() -> str:
    return "".join(
        f'\n[data-colour="{method}"]::before {{ background: {colour}; }}'
        for method, colour in COLOURS.items()
    ) + "".join(
        f'\n[data-colour="{cluster}"]::before {{ background: {colour}; }}'
        for cluster, colour in zip(CLUSTERS, CLUSTER_COLOURS, strict=True)
    )


def _training_result(jobs: Sequence[Job]) -> list[tuple[Job, pd.DataFrame]]:
    return [(job, job.curves) for job in jobs if job.curves is not None and len(job.curves)]


def summary(jobs: Sequence[Job]) -> list[str]:
    """Says in a few sentences what came out, against the driver's own fixed parameters and against the population's."""
    first = f"{_amount(jobs)}: does a policy that adapts the parameters drive closer to the real driver than {BASELINES['fixed']}?"
    following = [job for job in jobs if job.has_constant_baseline]
    marks = [_mark(job) for job in jobs if not job.has_constant_baseline]
    if len(following) <= 3:
        return [first, *(_verdict(job) for job in following), *marks]
    said = []
    for baseline, against in (
        ("fixed", ""),
        ("population", "; against the population's parameters"),
    ):
        sides = [_side(job, baseline) for job in following if baseline in job.baselines()]
        if sides:
            counts = f"yes in {sides.count('yes')}, no in {sides.count('no')}, undecided in {sides.count('undecided')}"
            said.append(f"{against or f'Of {len(following)} jobs'}: {counts}")
    best = max(
        following,
        key=lambda job: float(
            np.nan_to_num(job.metrics.get("rmse_improvement/mean", np.nan), nan=-np.inf)
        ),
    )
    counted = f"{''.join(said)} (by the 95 % interval of the mean improvement)."
    return [first, counted, f"The best mean: {_verdict(best)}", *marks]


def _mark(job: Job) -> str:
    """Says what a policy reaches that sets the acceleration itself."""
    speed, gap = (job.metrics.get(f"{name}/policy", np.nan) for name in ("rmse_speed", "rmse_gap"))
    return (
        f"{job.name}: the policy sets the acceleration itself. RMSE of speed {speed:.3f} m/s, of gap {gap:.2f} m, as a mark for"
        " the models that follow."
    )


def _amount(jobs: Sequence[Job]) -> str:
    pairs = {
        (str(job.data.get("source", "")), pair)
        for job in jobs
        for pair in job.pairs["pair_id"].unique()
    }
    sources = list(
        dict.fromkeys(str(job.data.get("source", "")) for job in jobs if job.data.get("source"))
    )
    where = f" from {Path(sources[0]).name}" if len(sources) == 1 else ""
    return f"{len(pairs)} pair{'' if len(pairs) == 1 else 's'} of leader and follower{where}"


def _statistic(job: Job, name: str, baseline: str = "fixed") -> float:
    return job.metrics.get(f"{improvement_of(baseline)}/{name}", np.nan)


def _side(job: Job, baseline: str = "fixed") -> str:
    if _statistic(job, "ci95_low", baseline) > 0:
        return "yes"
    return "no" if _statistic(job, "ci95_high", baseline) < 0 else "undecided"


def _verdict(job: Job) -> str:
    if not np.isfinite(_statistic(job, "mean")):
        return f"{job.name}: no pair has a defined improvement."
    population = (
        f"; against the population's parameters {_gain(job, 'population')}"
        if "population" in job.baselines()
        else ""
    )
    return f"{job.name}: {_side(job)}. Improvement of the RMSE of speed: {_gain(job, 'fixed')}{population}."


def _gain(job: Job, baseline: str) -> str:
    mean, low, high = (
        _statistic(job, name, baseline) for name in ("mean", "ci95_low", "ci95_high")
    )
    sure = (
        f"95 % interval {percent(low, 1)} to {percent(high, 1)}"
        if np.isfinite(low)
        else "no interval for a single driver"
    )
    return f"{percent(mean, 1)} on average ({sure})" if np.isfinite(mean) else "not defined"


def facts(jobs: Sequence[Job]) -> tuple[list[tuple[str, str]], tables.Sheet | None]:
    """Returns what was run: what all jobs share, and a table of what they do not (None if they share everything)."""
    every = [_facts(job, jobs) for job in jobs]
    names = list(dict.fromkeys(name for one in every for name in one))
    shared = [name for name in names if len({one.get(name, NOTHING) for one in every}) == 1]
    common = [(name, every[0].get(name, NOTHING)) for name in shared]
    differing = [name for name in names if name not in shared]
    if not differing:
        return common, None
    columns = tuple(tables.Column(name, "", number=False) for name in ("Job", *differing))
    rows = tuple(
        tuple(tables.text(value) for value in (job.name, *(one.get(n, NOTHING) for n in differing)))
        for job, one in zip(jobs, every, strict=True)
    )
    return common, tables.Sheet(columns, rows)


def _facts(job: Job, jobs: Sequence[Job]) -> dict[str, str]:
    table = job.pairs.drop_duplicates("pair_id")
    dropped = job.data.get("dropped") or []
    left_out = "; ".join(
        f"{one.get('count')} {one.get('unit')} ({one.get('reason')})"
        for one in dropped
        if isinstance(one, Mapping)
    )
    return {
        "Started": f"{job.started:%Y-%m-%d %H:%M}" if job.started else "not recorded",
        "Took": duration(job.seconds),
        **_typed(job, jobs),
        **({"Preset": job.experiment} if job.experiment else {}),
        "Data": str(job.data.get("source") or job.component("data") or NOTHING),
        "Pairs": f"{len(table)} pairs of {table['driver'].nunique()} drivers",
        "Left out": left_out or "nothing",
        "Test frames of a pair": _range(table["frames"]),
        "Drivers by style": str(job.setting("style.cluster") or NOTHING),
        "Protocol": _protocol(job),
        "Driving model": job.component("model") or NOTHING,
        "Policy": f"{job.component('policy')}, {_taught(job)}",
        "Calibrated by": job.component("optimizer") or NOTHING,
        "Seed": str(job.config.get("seed", NOTHING)),
        "cfx": job.version or "version not recorded",
        "Read from": job.place,
    }


def _typed(job: Job, jobs: Sequence[Job]) -> dict[str, str]:
    """Returns what was typed: of several jobs, what they share and what is each one's own."""
    if job.overrides is None:
        return {"Command": "not recorded"}
    if len(jobs) == 1:
        return {"Command": " ".join(["python -m cfx", *map(shlex.quote, job.overrides)])}
    shared = _shared_overrides(jobs)
    mine = [one for one in job.overrides if one not in shared]
    return {
        "Command": " ".join(["python -m cfx", *map(shlex.quote, shared), "…"]),
        "Overrides of its own": " ".join(map(shlex.quote, mine)) or "none",
    }


def _shared_overrides(jobs: Sequence[Job]) -> list[str]:
    """Returns the overrides that all jobs with known overrides have, in order."""
    known = [job.overrides for job in jobs if job.overrides is not None]
    return [one for one in known[0] if all(one in other for other in known)]


def _range(values: pd.Series[Any]) -> str:
    low, high = int(values.min()), int(values.max())
    return str(low) if low == high else f"{low} to {high}"


def _taught(job: Job) -> str:
    """Says how the policy was learned."""
    learner = job.component("learner")
    return (
        f"learned by {learner}"
        if learner
        else f"as it was learned in {job.setting('protocol.run')}"
    )


def _protocol(job: Job) -> str:
    name = job.component("protocol")
    train, test = (f"{100 * share:.3g} %" for share in (job.split, 1 - job.split))
    apart = {"platoon": " of whole platoons", "recording": " of whole recordings"}.get(
        str(job.setting("protocol.together")), ""
    )
    parts = f"the driver's own fixed parameters come from the first {train} of his drive, the test part is the last {test}"
    said = {
        "within_driver": f"calibrated and learned on the first {train} of each pair, tested on the last {test}",
        "across_drivers": "trained on some drivers and tested on others, none of whom is, as follower, in both;"
        f" {job.setting('protocol.folds')} folds{apart}; {parts}",
        "transfer": "nothing is trained: another job's policy drives, and the population's parameters are those of the drivers it"
        f" learned from; {parts}",
    }
    return f"{name}: {said[name]}" if name in said else name


def _configuration(job: Job) -> str:
    """Returns the configuration as YAML, after what the protocol noted of its design."""
    notes = job.data.get("protocol")
    noted = notes if isinstance(notes, Mapping) else {}
    design = "".join(f"# {str(name).replace('_', ' ')}: {value}\n" for name, value in noted.items())
    return design + str(yaml.safe_dump(dict(job.config), sort_keys=False, allow_unicode=True))


def duration(seconds: float | None) -> str:
    """Returns a duration as one says it: "42 s", "3 min 5 s", "2 h 10 min"."""
    if seconds is None:
        return "not recorded"
    whole_seconds = round(seconds)
    minutes, rest = divmod(whole_seconds, 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left} min"
    return f"{minutes} min {rest} s" if minutes else f"{whole_seconds} s"


def cluster_series(jobs: Sequence[Job]) -> dict[str, dict[str, pd.DataFrame]]:
    """Returns the pairs by series of jobs and cluster.

    A job that uses every driver is a series; jobs that differ in `style.cluster` alone are one together.
    """
    families = [SEPARATOR.join(parts) for parts in differences(jobs, ignored=("style.cluster",))]
    series: dict[str, dict[str, pd.DataFrame]] = {}
    for job, family in zip(jobs, families, strict=True):
        table = job.by_pair
        found = {
            cluster: table[table["cluster"] == cluster]
            for cluster in CLUSTERS
            if cluster in set(table["cluster"])
        }
        alone = job.setting("style.cluster") in {None, "all"}
        name = job.name if alone else f"{family}, a job for each cluster"
        if not alone and set(found) & set(series.get(name, {})):
            name = job.name  # the same cluster twice: the jobs differ in nothing that has a name
        series.setdefault(name, {}).update(found)
    return {name: {c: found[c] for c in CLUSTERS if c in found} for name, found in series.items()}


def _styles(jobs: Sequence[Job]) -> list[tuple[str, Plot]]:
    """Returns a plot for each different scoring of the drivers, with the jobs that it holds for."""
    found: dict[str, tuple[list[str], Plot]] = {}
    for job in jobs:
        if job.style is None or not len(job.style):
            continue
        given = job.setting("style.percentiles")
        percentiles = given if isinstance(given, list) else (25.0, 75.0)
        key = hashlib.sha256(
            job.style[["driver", "score", "cluster"]].to_csv().encode()
        ).hexdigest()
        found.setdefault(key, ([], style(job.style, percentiles)))[0].append(job.name)
    return [
        ("all jobs" if len(names) == len(jobs) else ", ".join(names), plot)
        for names, plot in found.values()
    ]


def _drives(job: Job) -> Drives:
    shown = []
    for chosen in chosen_trajectories(job):
        row = job.by_pair.set_index("pair_id").loc[chosen.pair_id]
        errors = ", ".join(f"{method} {row[f'rmse_speed/{method}']:.3f}" for method in job.methods)
        over = f", {percent(chosen.improvement, 1)} over fixed" if job.has_constant_baseline else ""
        heading = f"{chosen.rank}: pair {chosen.pair_id}{over}; RMSE of speed (m/s): {errors}"
        shown.append((heading[:1].upper() + heading[1:], drive(job, chosen.pair_id)))
    return Drives(job.name, tuple(shown))
