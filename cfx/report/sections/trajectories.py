"""Speed, gap and parameters of the best, the median and the worst pair over time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cfx.evaluation.result import Purpose
from cfx.report.figures.text import percent, short_label
from cfx.report.figures.trajectories import draw_pair
from cfx.report.figures.values import RankedPair, rank_pairs
from cfx.report.job import Job, Runs, of_purpose
from cfx.report.section import Section, View


class TrajectoriesSection(Section):
    """Speed, gap and parameters of the best, the median and the worst pair over time."""

    title = "Trajectories"
    entry = "Trajectories"
    order = 1600
    template = """
<p>
{% if adapting %}
The pair that improves most over driver-specific calibration, the one in the middle and the one that
improves least, on the test part.
{% endif %}
{% if constant %}
Of a calibration: the pairs with the least, the median and the largest RMSE of speed.
{% endif %}
What lies outside a parameter's bounds is shaded.
</p>
{% for job in jobs %}
{% call fold(job.name, loop.first, "job") %}
{% for pair in chosen(job) %}
<div class="pair">
<h3>{{ title(job, pair) }} <span class="fine">{{ errors(job, pair) }}</span></h3>
{{ figure(view(job, pair.pair_id), "Speed, gap and parameters of pair " ~ pair.pair_id) }}
</div>
{% endfor %}
{% endcall %}
{% endfor %}
{{ missing("trajectories.parquet", "speed, gap and parameters over time") }}
"""

    def context(self, runs: Runs) -> Mapping[str, Any]:
        """Return the jobs that kept their trajectories, and what is shown of their pairs."""
        jobs = [job for job in runs.jobs if "trajectories" in job.tables]
        constant = of_purpose(jobs, Purpose.CALIBRATION)
        shown = {"chosen": chosen_pairs, "title": _title, "errors": _errors, "view": pair_of}
        adapting = len(constant) < len(jobs)
        return {"jobs": jobs, "adapting": adapting, "constant": bool(constant), **shown}


def chosen_pairs(job: Job) -> tuple[RankedPair, ...]:
    """Returns the best, the median and the worst pair; fewer if there are fewer."""
    present = [trajectory.pair_id for trajectory in job.pair_trajectories]
    table = job.by_pair[job.by_pair["pair_id"].isin(present)]
    if job.purpose is Purpose.CALIBRATION:
        gains = -table[f"rmse_speed/{job.judged}"].to_numpy(dtype=float)
    else:
        gains = table["improvement/fixed"].to_numpy(dtype=float)
    return rank_pairs(table["pair_id"].astype(str).tolist(), gains)


def pair_of(job: Job, pair_id: str) -> dict[str, View]:
    """Speed, gap and each tuned parameter of one pair of a job."""
    return {"": View(draw_pair(job.results, pair_id))}


def _title(job: Job, pair: RankedPair) -> str:
    title = pair.title[:1].upper() + pair.title[1:]
    if job.purpose is Purpose.ADAPTATION and math.isfinite(pair.improvement):
        title += f": {percent(pair.improvement, 1)} over {short_label('fixed')} calibration"
    return title


def _errors(job: Job, pair: RankedPair) -> str:
    row = job.by_pair.set_index("pair_id").loc[pair.pair_id]
    errors = []
    for method in job.meaningful_methods:
        errors.append(f"{short_label(method)} {row[f'rmse_speed/{method}']:.3f}")
    return f"RMSE of speed (m/s): {', '.join(errors)}"
