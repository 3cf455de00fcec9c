"""What some seconds of watching a driver bring: the same stretch, driven after more and more past.

Every driver is tested on what they do after the longest past; how much of it may be read is what
differs. So all errors are of the same frames.

Constant parameters of a driver who was watched are drawn towards those that are pooled over the
drivers who were learned from. A few seconds of their own past cannot say how strongly: what is left
out of them is as short. So the strength is the one that would have served the drivers who were
learned from best, after as many seconds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cfx.errors import DataError
from cfx.plugin import Pair, PairSet, files, statistics
from cfx_report.benchmark.constants import ConstantDriver
from cfx_report.benchmark.methods import Entry, Training
from cfx_report.benchmark.predictions import trajectory_table
from cfx_report.benchmark.rival import Driver
from cfx_report.benchmark.score import errors_of_segments
from cfx_report.benchmark.segments import Segments, stretch, whole
from cfx_report.benchmark.suite import Suite
from cfx_report.benchmark.work import Recordings

SECONDS = (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)
"""s of the past that may be read."""

_LEAST_S = 10.0
"""s that are tested at least."""

STRENGTHS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Weights of the prior that are tried on drivers who were learned from. With 10 parameters hardly
leave the pooled ones; with 0.1 a few seconds decide them."""

_TRIED_OF_SITE, _TRIED_S = 8, 60.0
"""So many of these drivers of each site are tried at most, for so many s after the longest past."""

_LEAST_ERROR = 1e-3
"""m/s that a smaller error counts as: drivers who stand are followed without any."""


def watch(
    entry: Entry, recordings: Recordings, folder: Path, seed: int, seconds: Sequence[float]
) -> pd.DataFrame:
    """Drives after more and more past; each road is left out once.

    Args:
        entry: who drives.
        recordings: of the suite.
        folder: of the entry, whose jobs are taken where they are finished.
        seed: of training.
        seconds: of the past that may be read, ascending.

    Returns:
        A row per pair and seconds: watched_s, site, pair_id, driver, rmse_speed, rmse_gap.

    Raises:
        DataError: no pair lasts long enough.
    """
    suite = recordings.suite
    scheme = suite.schemes[0]
    fold = suite.folds_of(recordings.pairs, scheme, seed)
    recording = recordings.file_for_jobs(folder.parent)
    training = Training(suite, scheme, recordings.pairs, fold, recording, folder, seed)
    parts = []
    for number in range(training.folds):
        longest = max(seconds)
        tested = [pair for pair in training.tested(number) if pair.lasts(longest + _LEAST_S)]
        if not tested:
            continue
        driver = entry.driver(training, number)
        tried = _tried(suite, training.learned(number), longest)
        for past in seconds:
            segments = _segments(tested, longest, past)
            knowing = driver
            if past and tried and isinstance(driver, ConstantDriver) and driver.chooses_strength:
                strength = best_strength(suite, driver, tried, longest, past, seed)
                print(f"after {past:g} s: strength {strength:g} of the prior")
                knowing = driver.drawn_back(segments.past, seed, strength)
            elif past:
                knowing = driver.adapted(segments.past, seed)
            errors = _errors(suite, knowing, segments, tested)
            parts.append(errors.assign(watched_s=past))
        print(f"{scheme.name}, fold {number + 1} of {training.folds}: {len(tested)} pairs")
    if not parts:
        raise DataError(f"no pair lasts {max(seconds) + _LEAST_S:g} s")
    columns = ["watched_s", "site", "pair_id", "driver", "rmse_speed", "rmse_gap"]
    errors = pd.concat(parts, ignore_index=True)[columns]
    folder.mkdir(parents=True, exist_ok=True)
    with files.atomic_write(folder / "watching.csv") as temporary:
        errors.to_csv(temporary, index=False)
    return errors


def best_strength(
    suite: Suite,
    driver: ConstantDriver,
    tried: Sequence[Pair],
    longest: float,
    past: float,
    seed: int,
) -> float:
    """Returns the strength of the prior after which drivers are driven best; each site counts once.

    Args:
        suite: says which site a pair is of.
        driver: has the pooled parameters.
        tried: pairs of drivers who were learned from.
        longest: s before what is driven.
        past: s of these that are calibrated on.
        seed: of the optimizer.
    """
    segments = _segments(tried, longest, past)
    errors = {}
    for strength in STRENGTHS:
        knowing = driver.drawn_back(segments.past, seed, strength)
        table = _errors(suite, knowing, segments, tried)
        logarithms = np.log(table["rmse_speed"].clip(lower=_LEAST_ERROR))
        errors[strength] = float(logarithms.groupby(table["site"]).mean().mean())
    return min(errors, key=errors.__getitem__)


def _tried(suite: Suite, learned: PairSet, longest: float) -> list[Pair]:
    """Returns pairs that strengths are tried on: some of each site, from its first to its last."""
    of_site: dict[str, list[Pair]] = defaultdict(list)
    for pair in learned:
        if pair.lasts(longest + _LEAST_S):
            end = min(len(pair), round((longest + _TRIED_S) / pair.dt))
            of_site[suite.site_of(pair)].append(pair.beginning(end))
    tried = []
    for pairs in of_site.values():
        tried += pairs[:: -(-len(pairs) // _TRIED_OF_SITE)]
    return tried


def _errors(
    suite: Suite, driver: Driver, segments: Segments, pairs: Sequence[Pair]
) -> pd.DataFrame:
    """Returns the errors of a driver after the last measured frames, a row per pair."""
    speed = driver.drive(segments.blanked(), segments.first, None)
    return errors_of_segments(suite, segments, pairs, trajectory_table("", segments, speed))


def _segments(pairs: Sequence[Pair], longest: float, past: float) -> Segments:
    """Returns pairs from `past` seconds before the tested part on."""
    cut, first = [], []
    for pair in pairs:
        at = round(longest / pair.dt)
        begin = at - round(past / pair.dt)
        cut.append(stretch(pair, begin, len(pair)))
        first.append(at - begin)
    return whole(PairSet(tuple(cut), "watched"), first)


def lines(errors: pd.DataFrame) -> list[str]:
    """Returns the curve as Markdown: errors, and what watching brings, each site counting once."""
    table = [
        "| watched [s] | RMSE of speed [m/s] | RMSE of gap [m] | better than unwatched by (95 %) |",
        "| --- | --- | --- | --- |",
    ]
    unwatched = errors[errors["watched_s"] == errors["watched_s"].min()].set_index("pair_id")
    for seconds, rows in errors.groupby("watched_s"):
        here = rows.set_index("pair_id").loc[unwatched.index]
        gain = statistics.geometric_over_sites(
            unwatched["rmse_speed"].to_numpy(float),
            here["rmse_speed"].to_numpy(float),
            here["driver"].tolist(),
            here["site"].tolist(),
        )
        means = rows.groupby("site")[["rmse_speed", "rmse_gap"]].mean().mean()
        percent = [f"{100 * value + 0.0:+.1f}" for value in gain[:3]]  # not -0.0
        table.append(
            f"| {seconds:g} | {means['rmse_speed']:.3f} | {means['rmse_gap']:.2f} |"
            f" {percent[0]} % ({percent[1]} to {percent[2]}) |"
        )
    return table
