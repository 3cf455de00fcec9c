"""What some seconds of watching a driver bring: the same stretch, driven after more and more past.

Every driver is tested on what they do after the longest past; how much of it may be read is what
differs. So all errors are of the same frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from cfx.errors import DataError
from cfx.plugin import Pair, PairSet, files, statistics
from cfx_report.benchmark.methods import Entry, Training
from cfx_report.benchmark.predictions import trajectory_table
from cfx_report.benchmark.score import errors_of_segments
from cfx_report.benchmark.segments import Segments, stretch, whole
from cfx_report.benchmark.work import Recordings

SECONDS = (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)
"""s of the past that may be read."""

_LEAST_S = 10.0
"""s that are tested at least."""


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
        for past in seconds:
            segments = _segments(tested, longest, past)
            knowing = driver.adapted(segments.past, seed) if past else driver
            speed = knowing.drive(segments.blanked(), segments.first, None)
            table = trajectory_table("", segments, speed)
            errors = errors_of_segments(suite, segments, tested, table)
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
