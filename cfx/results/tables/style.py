"""Tables of driving style: of drivers, and of sites."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from cfx.data.style import INDICATOR_NAMES, INDICATORS, style_distances, styles_by_site
from cfx.evaluation.result import Evaluation
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import DRIVER


def _indicator_columns(meaning: str, *, required: bool = True) -> list[Column]:
    """Returns a column for each indicator of driving style."""
    columns = []
    for indicator in INDICATORS:
        columns.append(Column(indicator.name, indicator.unit, meaning, required=required))
    return columns


class Style(ResultTable):
    """Driving style, a row per driver."""

    meaning = "driving style, a row per driver"
    suffix = ".csv"
    order = 50
    always = True
    columns = (
        DRIVER,
        Column("score", "1", "weighted sum of the indicators; large is aggressive"),
        Column("cluster", "1", "0, 1 or 2: conservative, normal, aggressive", "int"),
        Column("cluster_name", "", "the cluster by name", "text", required=False),
        *_indicator_columns("an indicator", required=False),
        Column("frames", "1", "frames of the driver", "int", required=False),
        Column("standing_frames", "1", "frames in which the driver stands", "int", required=False),
        Column("site", "", "the road or area; several are joined by `; `", "text", required=False),
        Column("driver_type", "", "what drives", "text", required=False),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [evaluation.style.table]


class SiteStyles(ResultTable):
    """Driving style by site, where pairs are of several sites."""

    meaning = "driving style by site and type of driver, where there are several sites"
    suffix = ".csv"
    order = 51
    columns = (
        Column("site", "", "the road or area", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("drivers", "1", "its drivers", "int"),
        Column("score_median", "1", "median of their style scores"),
        Column("score_low", "1", "lower end of the median's 95 % interval over drivers"),
        Column("score_high", "1", "its upper end"),
        Column("score_q25", "1", "lower quartile of the scores"),
        Column("score_q75", "1", "upper quartile of the scores"),
        *_indicator_columns("median of an indicator"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [styles_by_site(evaluation.style)]


class StyleDistances(ResultTable):
    """How far apart the driving styles of sites are, and of types of drivers within a site."""

    meaning = "energy distances between the style scores of sites, and of types of drivers there"
    suffix = ".csv"
    order = 52
    columns = (
        Column("site", "", "the road or area", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("other_site", "", "what it is compared with", "text"),
        Column("other_driver_type", "", "likewise", "text"),
        Column("distance", "1", "energy distance of the scores"),
        Column("p_value", "1", "of a permutation of drivers, corrected for all comparisons"),
        Column("most", "", "the indicator that differs most", "text"),
        *(
            Column(f"distance_{name}", "1", "of a normalised indicator times its weight")
            for name in INDICATOR_NAMES
        ),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [style_distances(evaluation.style)]
