"""Driving style by the objective entropy weight method.

The more unevenly an indicator is distributed over the drivers, the more it weighs: its weight comes
from the Shannon entropy of its normalised column (C. E. Shannon, 1948; as used for driving style by
the paper's reference on entropy weights).

Shapes: m drivers, n = 6 indicators.

Differences from the paper: the normalisation prints `Min = max(...)` and chooses its case by the
sign of the value; here Min is the minimum, and the case follows from the indicator
(`direction=signed`) or, as printed, from the value's sign (`direction=printed`). The weights'
leading minus sign, with which they would all be negative, is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from cfx.core import memory
from cfx.core.component import Settings
from cfx.data.pairs import Pair, PairSet, frames_of_each, of_each, over_frames
from cfx.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "ALL_TYPES",
    "CLUSTERS",
    "INDICATORS",
    "Group",
    "groups",
    "name_of_indicator",
]
"""What plugins may use, as `cfx.plugin.style`."""


Floats = NDArray[np.float64]


_PAIRS_AT_ONCE = 4096
"""Pairs whose frames are read at once."""


class Indicator(NamedTuple):
    """A measure of a driver's style; `sign` is +1 if a larger value is more aggressive, else -1."""

    name: str
    sign: int
    unit: str


INDICATORS = (
    Indicator("mean_speed", 1, "m/s"),
    Indicator("variance_speed", 1, "m2/s2"),
    Indicator("mean_acceleration", 1, "m/s2"),
    Indicator("variance_acceleration", 1, "m2/s4"),
    Indicator("mean_space_headway", -1, "m"),
    Indicator("mean_time_headway", -1, "s"),
)
"""What a driver's style is scored by, in the order of the columns of the evaluation matrix."""


INDICATOR_NAMES = [indicator.name for indicator in INDICATORS]
"""Their names."""


def name_of_indicator(name: str) -> str:
    """Returns an indicator's name in words: "variance of speed"."""
    return name.replace("variance_", "variance of ").replace("_", " ")


CLUSTERS = ("conservative", "normal", "aggressive")
"""Names of the clusters 0, 1, 2: the bottom quarter, the middle half, the top quarter of scores."""

STANDING_MPS = 0.5
"""Below this speed a vehicle counts as standing. Its time headway, the space headway over the
speed, would grow beyond all bounds, and is left out."""


BETWEEN = "; "
"""Separates the sites of a driver who was recorded at several."""


class StyleSettings(Settings):
    """Settings of the driving style, and of which drivers a job uses."""

    cluster: Literal["all", "conservative", "normal", "aggressive"] = Field(
        "all", description="drivers that the job uses"
    )
    direction: Literal["signed", "printed"] = Field(
        "signed",
        description="signed: headways count against aggressiveness; printed: the rule as the paper"
        " prints it",
    )
    percentiles: tuple[float, float] = Field(
        (25.0, 75.0), description="cuts between the three clusters, percent of the drivers"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.percentiles
        if not 0 < low < high < 100:
            raise ValueError(
                f"style.percentiles=[{low:g}, {high:g}] must rise and lie between 0 and 100"
            )
        return self


@dataclass(frozen=True)
class StyleResult:
    """Driving style of every driver.

    Attributes:
        table: a row per driver: driver, score, cluster (0, 1, 2), cluster_name, the six raw
            indicators `mean_speed`, `variance_speed`, `mean_acceleration`, `variance_acceleration`,
            `mean_space_headway`, `mean_time_headway` (SI units), and where they are known `site`
            (those of a driver of several are joined by "; ") and `driver_type`.
        weights: entropy weight of each indicator; they are not negative and sum to 1.
        cuts: the two scores that separate the clusters.
    """

    table: pd.DataFrame
    weights: Mapping[str, float]
    cuts: tuple[float, float]


def measure_style(pairs: PairSet, settings: StyleSettings) -> StyleResult:
    """Scores every driver (`Pair.driver`) and sorts the drivers into three clusters.

    The frames of all pairs of a driver count together. Scores lie in [0, 1]; the more aggressive,
    the higher. A driver whose score is below the lower percentile is conservative, above the upper
    one aggressive, and normal otherwise, so that equal scores always share a cluster. A single
    driver is normal, with score 0.

    Returns:
        The drivers in the order in which they first appear. The table also has `frames` and
        `standing_frames`, the number of frames that did not count for the time headway.

    Raises:
        DataError: there are no pairs.
    """
    if not len(pairs):
        raise DataError(f"{pairs.source}: no pairs, so no driving style to measure")
    table = indicators(pairs)
    raw = table[INDICATOR_NAMES].to_numpy(dtype=np.float64)
    normalised = normalise(raw, settings.direction)
    weights = entropy_weights(normalised)
    score = (normalised * weights).sum(axis=1)
    low, high = np.percentile(score, settings.percentiles)
    cluster = np.where(score < low, 0, np.where(score > high, 2, 1))
    table.insert(1, "score", score)
    table.insert(2, "cluster", cluster)
    table.insert(3, "cluster_name", [CLUSTERS[number] for number in cluster])
    has_sites = False
    for pair in pairs:
        has_sites |= bool(pair.site)
    if has_sites:
        table["site"], table["driver_type"] = _whereabouts(pairs, table["driver"].tolist())
    by_name = dict(zip(INDICATOR_NAMES, weights.tolist(), strict=True))
    return StyleResult(table, by_name, (float(low), float(high)))


def _whereabouts(pairs: PairSet, drivers: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the sites and the type of each driver."""
    sites_of: dict[str, dict[str, None]] = {}
    type_of: dict[str, str] = {}
    for pair in pairs:
        sites_of.setdefault(pair.driver, {})[pair.site] = None
        type_of[pair.driver] = pair.driver_type
    sites, types = [], []
    for driver in drivers:
        sites.append(BETWEEN.join(sites_of[driver]))
        types.append(type_of[driver])
    return sites, types


def select_cluster(pairs: PairSet, style: StyleResult, cluster: str) -> PairSet:
    """Keeps the pairs of the drivers of one cluster and counts the others; `all` keeps every pair.

    Raises:
        DataError: no driver is in this cluster.
    """
    if cluster == "all":
        return pairs
    drivers = set(style.table.loc[style.table["cluster_name"] == cluster, "driver"])
    chosen = pairs.select([pair.driver in drivers for pair in pairs], f"driver is not {cluster}")
    if not len(chosen):
        sizes = style.table["cluster_name"].value_counts()
        in_words = ", ".join([f"{sizes.get(name, 0)} {name}" for name in CLUSTERS])
        raise DataError(
            f"style.cluster={cluster}: none of the {len(style.table)} drivers is in this cluster"
            f" ({in_words}); give more pairs, another style.cluster, or"
            " style.percentiles further apart from 0 and 100"
        )
    return chosen


def indicators(pairs: PairSet) -> pd.DataFrame:
    """Returns a row per driver with the six indicators, in SI units.

    The space headway is front bumper to front bumper, `x_l - x_s`, as NGSIM's Space_Headway. The
    time headway is that over the follower's speed, averaged over the frames with a speed of 0.5 m/s
    or more; for a driver who is never that fast, it is the mean space headway over 0.5 m/s.
    Variances are those of the population (divided by the number of frames).
    """
    import pandas as pd

    parts = [_indicators(whole_drivers) for whole_drivers in _by_driver(pairs)]
    return pd.concat(parts, ignore_index=True)


def _by_driver(pairs: PairSet) -> Iterator[list[Pair]]:
    """Yields the pairs of a few drivers at a time: the frames of all at once need much memory."""
    of_driver: dict[str, list[int]] = {}
    for index, pair in enumerate(pairs.pairs):
        of_driver.setdefault(pair.driver, []).append(index)
    part: list[Pair] = []
    for indices in of_driver.values():
        for index in indices:
            part.append(pairs[index])
        if len(part) >= _PAIRS_AT_ONCE:
            yield part
            part = []
            memory.release()
    if part:
        yield part


def _indicators(pairs: Sequence[Pair]) -> pd.DataFrame:
    """Returns the indicators of drivers all of whose pairs are given."""
    import pandas as pd

    code, drivers = pd.factorize(np.array(of_each(pairs, "driver"), dtype=object))
    code = np.repeat(code, frames_of_each(pairs))
    speed = over_frames(pairs, "follower_speed")
    acceleration = over_frames(pairs, "follower_acceleration")
    space = over_frames(pairs, "leader_position") - over_frames(pairs, "follower_position")
    moving = speed >= STANDING_MPS
    time = np.where(moving, space / np.where(moving, speed, 1.0), 0.0)

    def total(values: Floats) -> Floats:
        return np.bincount(code, values, len(drivers)).astype(np.float64, copy=False)

    frames = np.bincount(code, minlength=len(drivers))
    counted = np.bincount(code[moving], minlength=len(drivers))
    mean_speed = total(speed) / frames
    mean_acceleration = total(acceleration) / frames
    mean_space = total(space) / frames
    mean_time = np.where(
        counted > 0, total(time) / np.maximum(counted, 1), mean_space / STANDING_MPS
    )
    return pd.DataFrame(
        {
            "driver": drivers,
            "mean_speed": mean_speed,
            "variance_speed": total((speed - mean_speed[code]) ** 2) / frames,
            "mean_acceleration": mean_acceleration,
            "variance_acceleration": total((acceleration - mean_acceleration[code]) ** 2) / frames,
            "mean_space_headway": mean_space,
            "mean_time_headway": mean_time,
            "frames": frames,
            "standing_frames": frames - counted,
        }
    )


def normalise(raw: Floats, direction: Literal["signed", "printed"] = "signed") -> Floats:
    """Maps each column of `raw` `(m, n)` to [0, 1], 1 being the most aggressive.

    A constant column becomes 0.

    With `printed`, (max - e) / (max - min) where e < 0 and (e - min) / (max - min) elsewhere, as
    the paper prints it: a column with both signs is then not monotonic.
    """
    low, high = raw.min(axis=0), raw.max(axis=0)
    extent = high - low
    # An extent that rounding alone can cause is none.
    varies = extent > 1e-9 * np.maximum(np.abs(low), np.abs(high)) + 1e-12
    if direction == "printed":
        backwards = raw < 0
    else:
        signs = np.array([indicator.sign for indicator in INDICATORS])
        backwards = signs[: raw.shape[1]] < 0
    rise = np.where(backwards, high - raw, raw - low) / np.where(varies, extent, 1.0)
    scaled: Floats = np.where(varies, np.clip(rise, 0.0, 1.0), 0.0)
    return scaled


def entropies(normalised: Floats) -> Floats:
    """Returns the entropy of each column of `(m, n)`, in [0, 1]: 1 is evenly spread.

    ent_j = -(1 / ln m) sum_i p_ij ln p_ij with p_ij = e_ij / sum_i e_ij and 0 ln 0 = 0. A column of
    zeros (a constant indicator) and a single driver carry no information: 1.
    """
    drivers = len(normalised)
    sums = normalised.sum(axis=0)
    if drivers < 2:
        return np.ones(normalised.shape[1])
    share = normalised / np.where(sums > 0, sums, 1.0)
    terms = share * np.log(np.where(share > 0, share, 1.0))
    entropy: Floats = np.where(sums > 0, -terms.sum(axis=0) / np.log(drivers), 1.0)
    return np.clip(entropy, 0.0, 1.0)


def entropy_weights(normalised: Floats) -> Floats:
    """Returns the weight of each column `(n,)`: not negative, sum 1; 0 for a constant column.

    w_j = (1 - ent_j) / (n - sum_j ent_j). If no indicator varies, as with a single driver, all
    weigh the same.
    """
    information = 1.0 - entropies(normalised)
    total = float(information.sum())
    if total <= 0:
        return np.full(normalised.shape[1], 1.0 / normalised.shape[1])
    return np.asarray(information / total, dtype=np.float64)


# --- sites ----------------------------------------------------------------------------------------

ALL_TYPES = "all"
"""The `driver_type` of a group that holds all drivers of a site."""

NOT_KNOWN = "not known"
"""The `driver_type` of a group whose recording does not say what drives."""

_FEWEST = 2
"""A group needs at least as many drivers for its distances to be computed."""

_PERMUTATIONS = 999
"""Of the drivers of two groups, at most: no p-value is below 1 / (this + 1)."""


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
        Nothing where there is one site alone, or where sites are not known.
    """
    if "site" not in drivers:
        return []
    drivers_at: dict[str, NDArray[np.bool_]] = {}
    for number, names in enumerate(drivers["site"].fillna("")):
        for site in str(names).split(BETWEEN):
            if site:
                is_there = drivers_at.setdefault(site, np.zeros(len(drivers), dtype=bool))
                is_there[number] = True
    if len(drivers_at) < 2:
        return []
    types = drivers["driver_type"].fillna("").replace("", NOT_KNOWN)
    every = []
    for site, is_there in drivers_at.items():
        every.append(Group(site, ALL_TYPES, is_there))
        types_there = types[is_there].unique()
        if len(types_there) > 1:
            for kind in types_there:
                every.append(Group(site, str(kind), is_there & (types == kind).to_numpy()))
    return every


def styles_by_site(style: StyleResult) -> pd.DataFrame | None:
    """Summarises the scores and indicators of each group of drivers.

    Returns:
        A row per group: site, driver_type, drivers, `score_median` with its 95 % interval
        `score_low` and `score_high` (bootstrap over drivers, NaN for a single one), `score_q25`,
        `score_q75`, and the median of each indicator under its name (SI units). None where there
        is one site alone.
    """
    every = groups(style.table)
    if not every:
        return None
    import pandas as pd
    from scipy import stats  # slow to import: only where there is something to summarise

    rows: list[dict[str, object]] = []
    for group in every:
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
    Székely, M. L. Rizzo: Energy statistics, 2013), here in one dimension. Its p-value comes from
    permutations of the drivers between the two groups, and is corrected for the number of
    comparisons (Benjamini, Hochberg). The distance of each indicator is computed in the same way
    from its normalised values times its weight, which makes the six distances comparable; `most`
    names the indicator with the largest.

    Returns:
        A row per two groups: site, driver_type, other_site, other_driver_type, distance, p_value,
        most, and `distance_INDICATOR`. Groups of fewer than two drivers are left out. None where
        there is nothing to compare.
    """
    compared = list(_compared(style.table))
    if not compared:
        return None
    import pandas as pd
    from scipy import stats  # slow to import: only where there is something to compare

    scaled = normalise(style.table[INDICATOR_NAMES].to_numpy(dtype=np.float64))
    weighted = scaled * np.array([style.weights[name] for name in INDICATOR_NAMES])
    score = style.table["score"].to_numpy(dtype=np.float64)
    rows: list[dict[str, object]] = []
    for group, other in compared:
        # A driver of both sites says nothing about their difference.
        first, second = group.chosen & ~other.chosen, other.chosen & ~group.chosen
        if min(first.sum(), second.sum()) < _FEWEST:
            continue
        tested = stats.permutation_test(
            (score[first], score[second]),
            stats.energy_distance,
            n_resamples=_PERMUTATIONS,
            alternative="greater",
            rng=np.random.default_rng(0),
        )
        distances = {}
        for indicator, values in zip(INDICATORS, weighted.T, strict=True):
            distance = stats.energy_distance(values[first], values[second])
            distances[f"distance_{indicator.name}"] = float(distance)
        most = max(distances, key=distances.__getitem__).removeprefix("distance_")
        row: dict[str, object] = {"site": group.site, "driver_type": group.driver_type}
        row |= {"other_site": other.site, "other_driver_type": other.driver_type}
        row |= {"distance": float(tested.statistic), "p_value": float(tested.pvalue), "most": most}
        rows.append(row | distances)
    if not rows:
        return None
    table = pd.DataFrame(rows)
    table["p_value"] = stats.false_discovery_control(table["p_value"].to_numpy())
    return table


def _compared(drivers: pd.DataFrame) -> Iterator[tuple[Group, Group]]:
    """Yields every pair of sites, then every pair of types of drivers within one site."""
    sites, types = [], []
    for group in groups(drivers):
        if group.driver_type == ALL_TYPES:
            sites.append(group)
        else:
            types.append(group)
    yield from combinations(sites, 2)
    for first, second in combinations(types, 2):
        if first.site == second.site:
            yield first, second
