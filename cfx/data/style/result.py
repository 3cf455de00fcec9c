"""What the style measurement delivers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

CLUSTERS = ("conservative", "normal", "aggressive")
"""Names of the clusters 0, 1, 2: the bottom quarter, the middle half, the top quarter of scores."""


@dataclass(frozen=True)
class StyleResult:
    """Driving style of every driver.

    Attributes:
        table: a row per driver: driver, score, cluster (0, 1, 2), cluster_name, and the six raw
            indicators `mean_speed`, `variance_speed`, `mean_acceleration`, `variance_acceleration`,
            `mean_space_headway`, `mean_time_headway` (SI units).
        weights: entropy weight of each indicator; they are not negative and sum to 1.
        cuts: the two scores that separate the clusters.
    """

    table: pd.DataFrame
    weights: Mapping[str, float]
    cuts: tuple[float, float]
