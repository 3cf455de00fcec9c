"""The sections of the page, in their order: a new one is a module and its line in `SECTIONS`."""

from __future__ import annotations

from cfx.report.blocks import Section
from cfx.report.sections import (
    calibration,
    clusters,
    comparison,
    configurations,
    distributions,
    drivers,
    errors,
    forecasts,
    further,
    history,
    learning,
    metrics,
    paper,
    results,
    run,
    safety,
    seeds,
    style,
    traffic,
    trajectories,
)

SECTIONS: tuple[Section, ...] = (
    seeds.SECTION,
    comparison.SECTION,
    run.SECTION,
    results.SECTION,
    safety.SECTION,
    metrics.SECTION,
    forecasts.SECTION,
    distributions.SECTION,
    traffic.SECTION,
    history.SECTION,
    paper.SECTION,
    drivers.SECTION,
    clusters.SECTION,
    calibration.SECTION,
    style.SECTION,
    trajectories.SECTION,
    errors.SECTION,
    learning.SECTION,
    further.SECTION,
    configurations.SECTION,
)
