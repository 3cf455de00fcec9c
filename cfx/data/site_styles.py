"""Driving styles of sites: how the drivers of roads and areas differ, and in what.

Shapes: m drivers, n = 6 indicators.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.data.style import BETWEEN, INDICATORS, StyleResult, normalise

ALL = "all"
"""The drivers of a site whatever drives."""

NOT_KNOWN = "not known"
"""What stands for a type of driver that the recording does not tell."""

_FEWEST = 2
"""Drivers of a group that distances are computed for."""

_PERMUTATIONS = 999

Floats = NDArray[np.float64]


class Group(NamedTuple):
    """Drivers of a site, or those of one type there.

    Attributes:
        site: its name.
        driver_type: what drives; `all` for the whole site.
        chosen: `(m,)`, which drivers of the style table they are.
    """

    site: str
    driver_type: str
    chosen: NDArray[np.bool_]


def groups(drivers: pd.DataFrame) -> list[Group]:
    """Returns the drivers of each site, and of each type at sites that have several.

    A driver of several sites belongs to each.

    Args:
        drivers: a row per driver, with `site` and `driver_type`, as `StyleResult.table`.

    Returns:
        None where there is one site alone, or where sites are not known.
    """
    if "site" not in drivers:
        return []
    at = [str(names).split(BETWEEN) for names in drivers["site"].fillna("")]
    sites = dict.fromkeys(name for names in at for name in names if name)
    kinds = drivers["driver_type"].fillna("").replace("", NOT_KNOWN)
    found = []
    for site in sites:
        here = np.array([site in names for names in at])
        found.append(Group(site, ALL, here))
        there = dict.fromkeys(kinds[here])
        if len(there) > 1:
            found += [Group(site, str(kind), here & (kinds == kind).to_numpy()) for kind in there]
    return found if len(sites) > 1 else []


def styles_by_site(style: StyleResult) -> pd.DataFrame | None:
    """Summarises the scores and indicators of each group of drivers.

    Returns:
        A row per group: site, driver_type, drivers, `score_median` with its 95 % interval
        `score_low` and `score_high` (bootstrap over drivers, NaN for a single one), `score_q25`,
        `score_q75`, and the median of each indicator under its name (SI units). None where there
        is one site alone.
    """
    found = groups(style.table)
    if not found:
        return None
    from scipy import stats  # slow to import: only where there is something to summarise

    rows: list[dict[str, object]] = []
    for group in found:
        table = style.table[group.chosen]
        score = table["score"].to_numpy(dtype=np.float64)
        low = high = float("nan")
        if len(score) > 1:
            low, high = stats.bootstrap(
                (score,), np.median, method="percentile", rng=np.random.default_rng(0)
            ).confidence_interval
        q25, middle, q75 = np.quantile(score, [0.25, 0.5, 0.75])
        row: dict[str, object] = {
            "site": group.site,
            "driver_type": group.driver_type,
            "drivers": len(score),
            "score_median": float(middle),
            "score_low": float(low),
            "score_high": float(high),
            "score_q25": float(q25),
            "score_q75": float(q75),
        }
        for indicator in INDICATORS:
            row[indicator.name] = float(table[indicator.name].median())
        rows.append(row)
    return pd.DataFrame(rows)


def style_distances(style: StyleResult) -> pd.DataFrame | None:
    """Measures how far apart sites are, and types of drivers within a site.

    The distance is the energy distance between the distributions of the drivers' scores (G. J.
    Székely, M. L. Rizzo: Energy statistics, 2013), here in one dimension; its p-value is that of a
    permutation of the drivers, corrected for the number of comparisons (Benjamini, Hochberg). The
    distance of an indicator is that of its normalised values times its weight, so that those of all
    six compare; `most` names the largest.

    Returns:
        A row per two groups: site, driver_type, other_site, other_driver_type, distance, p_value,
        most, and `distance_INDICATOR`. Groups of fewer than two drivers are left out. None where
        there is nothing to compare.
    """
    compared = list(_compared(style.table))
    if not compared:
        return None
    from scipy import stats  # slow to import: only where there is something to compare

    scaled = normalise(style.table[[one.name for one in INDICATORS]].to_numpy(dtype=np.float64))
    weighted = scaled * np.array([style.weights[one.name] for one in INDICATORS])
    score = style.table["score"].to_numpy(dtype=np.float64)
    rows: list[dict[str, object]] = []
    for one, other in compared:
        first, second = one.chosen & ~other.chosen, other.chosen & ~one.chosen
        if min(first.sum(), second.sum()) < _FEWEST:
            continue
        tested = stats.permutation_test(
            (score[first], score[second]),
            stats.energy_distance,
            n_resamples=_PERMUTATIONS,
            alternative="greater",
            rng=np.random.default_rng(0),
        )
        of_each = {}
        for indicator, values in zip(INDICATORS, weighted.T, strict=True):
            distance = stats.energy_distance(values[first], values[second])
            of_each[f"distance_{indicator.name}"] = float(distance)
        most = max(of_each, key=of_each.__getitem__).removeprefix("distance_")
        row: dict[str, object] = {"site": one.site, "driver_type": one.driver_type}
        row |= {"other_site": other.site, "other_driver_type": other.driver_type}
        row |= {"distance": float(tested.statistic), "p_value": float(tested.pvalue), "most": most}
        rows.append(row | of_each)
    if not rows:
        return None
    table = pd.DataFrame(rows)
    table["p_value"] = stats.false_discovery_control(table["p_value"].to_numpy())
    return table


def _compared(drivers: pd.DataFrame) -> Iterator[tuple[Group, Group]]:
    """Yields each two sites, then each two types of drivers of a site."""
    every = groups(drivers)
    yield from combinations([group for group in every if group.driver_type == ALL], 2)
    for one, other in combinations([group for group in every if group.driver_type != ALL], 2):
        if one.site == other.site:
            yield one, other
