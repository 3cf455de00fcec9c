"""The suite `roads`: every openly licensed recording that cfx reads by its name.

Each road is left out once, and drivers of each road once; a driver's past is given, or is not.
"""

from __future__ import annotations

from dataclasses import replace

from cfx_report.benchmark.suite import Scheme, Site, Suite, Task

FILES = (
    "i80_reconstructed_pairs.parquet",
    "ngsim_i80_hov_ramp_pairs.parquet",
    "tgsim_freeway_pairs.parquet",
    "openacc_zalazone_pairs.parquet",
    "openacc_vicolungo_pairs.parquet",
    "openacc_ispra_low_speed_pairs.parquet",
    "carma_platoon_pairs.parquet",
)

SITES = (
    Site("I-80", r"i80-\d{4}$", "human"),
    Site("I-80 HOV lane, ramp", r"i80-\d{4}-(hov|ramp)$", "human"),
    Site("TGSIM freeways", "tgsim-", "human"),
    Site("ZalaZone, people", "openacc-zalazone", "human"),
    Site("ZalaZone, ACC", "openacc-zalazone", "acc"),
    Site("Vicolungo, people", "openacc-vicolungo", "human"),
    Site("Vicolungo, ACC", "openacc-vicolungo", "acc"),
    Site("Ispra, ACC", "openacc-jrclowspeed", "acc"),
    Site("Aberdeen, ACC", "carma-", "acc"),
)

NEW_ROAD = Scheme("new_road", "site", None)
"""A road is left out with all its drivers: I-80 with its HOV lane and ramp."""

SAME_ROAD = Scheme("same_road", "vehicle", 5)
"""Other drivers of the same roads are learned from; a car is one with ACC and without."""

TASKS = (
    Task("new_road", "unseen drivers of a road that nobody learned from", "new_road", "full"),
    Task("same_road", "unseen drivers of roads that were learned from", "same_road", "full"),
    Task("known", "drivers of a new road, whose past is given", "new_road", "last_part"),
    Task("forecast", "forecasts of drivers of a new road", "new_road", "forecast"),
)

ROADS = Suite(
    name="roads",
    version="roads-1",
    files=FILES,
    sites=SITES,
    schemes=(NEW_ROAD, SAME_ROAD),
    tasks=TASKS,
    fingerprint="ef72556ce498da880c0f442acd77d7baf7f566520133d779ea6bfac439060481",
    about="seven recordings of six roads: 483 pairs of 374 drivers",
)

QUICK = replace(
    ROADS,
    version="roads-1-quick",
    files=("openacc_vicolungo_pairs.parquet", "openacc_ispra_low_speed_pairs.parquet"),
    longest=2,
    fingerprint="aa3713543a3cd3abecce30c7f044f7b12ab3ac73b6caf45056721f0ced762fc2",
    about="Vicolungo and Ispra: 16 pairs",
)
"""Two roads in two minutes, to see that a rival works. Its rows compare with one another alone."""
