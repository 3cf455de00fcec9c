"""Results by site: a row for each road or area, and one in which each site counts once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.data.pairs import PairSet
from cfx.evaluation.result import METHODS, Evaluation
from cfx.evaluation.statistics import geometric_over_sites, improvement_statistics
from cfx.evaluation.tables import values_of

ALL_SITES = "all"
"""What the row is called in which each site counts once, and a row of all types of drivers."""

BASELINES = ("driver_specific", "pooled")
"""What the policy is compared with in each row."""

Floats = NDArray[np.float64]


def site_table(pairs: PairSet, evaluation: Evaluation) -> pd.DataFrame | None:
    """Summarises an evaluation by site; None if the tested pairs were recorded at one site alone.

    Args:
        pairs: of the job; those that were not tested do not count.
        evaluation: of the tested ones.

    Returns:
        A row per scope (`test`, `full_trajectory`), site and driver type (`all`, and each type
        where a site has several): scope, site, driver_type, pairs, drivers, for each method
        `rmse_speed_METHOD` (m/s) and `rmse_gap_METHOD` (m), means over pairs, and the error by
        which the job is judged where it is another; and for each baseline the policy's geometric
        improvement of that error `over_BASELINE`, its median over drivers
        `over_BASELINE_median`, and its 95 % interval over drivers, `over_BASELINE_low` and
        `over_BASELINE_high`. The site `all` is the mean over sites: see `geometric_over_sites`.
    """
    labels = _labels(pairs, evaluation)
    if labels["site"].nunique() < 2:
        return None
    rows = []
    for scope in ("test", "full_trajectory"):
        errors = {}
        for metric in dict.fromkeys((evaluation.judge, "rmse_speed", "rmse_gap")):
            errors[metric] = values_of(evaluation.values, metric, scope)
        judged = errors[evaluation.judge]
        if "policy" not in judged and scope != "test":
            continue
        about = labels.loc[judged.index]
        rows_of_sites = []
        for site, of_site in about.groupby("site", sort=False):
            row = _row(scope, str(site), ALL_SITES, of_site, errors)
            rows_of_sites.append(row)
            rows.append(row)
            if len(set(of_site["driver_type"])) > 1:
                for kind, of_kind in of_site.groupby("driver_type", sort=False):
                    name = str(kind) or "not known"
                    rows.append(_row(scope, str(site), name, of_kind, errors))
        rows.append(_mean_of_sites(scope, rows_of_sites, about, judged))
    return pd.DataFrame(rows)


def _labels(pairs: PairSet, evaluation: Evaluation) -> pd.DataFrame:
    """Returns site, driver and driver type of the tested pairs, by pair id."""
    tested = set(evaluation.about["pair_id"])
    labels = []
    for pair in pairs:
        if pair.pair_id in tested:
            labels.append((pair.pair_id, pair.site, pair.driver, pair.driver_type))
    columns = ["pair_id", "site", "driver", "driver_type"]
    return pd.DataFrame(labels, columns=columns).set_index("pair_id")


def _row(
    scope: str,
    site: str,
    kind: str,
    about: pd.DataFrame,
    errors: Mapping[str, pd.DataFrame],
) -> dict[str, object]:
    """Returns the row of some pairs of a site; `about` has their sites, drivers and types.

    The first of `errors` is the one by which the job is judged.
    """
    row: dict[str, object] = {
        "scope": scope,
        "site": site,
        "driver_type": kind,
        "pairs": len(about),
        "drivers": about["driver"].nunique(),
    }
    of_site = {metric: table.loc[about.index] for metric, table in errors.items()}
    judged = next(iter(of_site.values()))
    for method in METHODS:
        if method in judged:
            for metric, table in of_site.items():
                row[f"{metric}_{method}"] = float(table[method].mean())
    for baseline in BASELINES:
        if baseline in judged and "policy" in judged:
            improvement = improvement_statistics(
                judged[baseline].to_numpy(),
                judged["policy"].to_numpy(),
                about["driver"].tolist(),
            )
            low, high = improvement.ci95_low, improvement.ci95_high
            row |= _columns_of(baseline, improvement.geometric, improvement.median, low, high)
    return row


def _columns_of(
    baseline: str, geometric: float, median: float, low: float, high: float
) -> dict[str, float]:
    """Returns the columns of an improvement over a baseline."""
    name = f"over_{baseline}"
    return {name: geometric, f"{name}_median": median, f"{name}_low": low, f"{name}_high": high}


def _mean_of_sites(
    scope: str,
    rows: Sequence[Mapping[str, object]],
    about: pd.DataFrame,
    judged: pd.DataFrame,
) -> dict[str, object]:
    """Returns the row in which each site counts once; `rows` are theirs."""
    table = pd.DataFrame(rows)
    row: dict[str, object] = {
        "scope": scope,
        "site": ALL_SITES,
        "driver_type": ALL_SITES,
        "pairs": int(table["pairs"].sum()),
        "drivers": int(table["drivers"].sum()),
    }
    for name in table.columns:
        if name.endswith(tuple(f"_{method}" for method in METHODS)) and name[:5] != "over_":
            row[name] = float(table[name].mean())
    for baseline in BASELINES:
        if f"over_{baseline}" in table:
            geometric, low, high, _ = geometric_over_sites(
                judged[baseline].to_numpy(),
                judged["policy"].to_numpy(),
                about["driver"].tolist(),
                about["site"].tolist(),
            )
            median = float(table[f"over_{baseline}_median"].mean())
            row |= _columns_of(baseline, geometric, median, low, high)
    return row
