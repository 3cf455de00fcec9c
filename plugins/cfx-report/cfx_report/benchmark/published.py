"""Splits that others have published: cfx's numbers on their pairs and events, beside theirs.

Nothing of theirs is part of cfx. Who has downloaded the files names them.

Shapes: P pairs, T frames. SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch

import cfx
from cfx.errors import ConfigError, DataError
from cfx.plugin import PairSet, names
from cfx_report.benchmark.methods import Entry
from cfx_report.benchmark.predictions import trajectory_table
from cfx_report.benchmark.segments import Segments, whole


@dataclass(frozen=True)
class Published:
    """A published split.

    Attributes:
        title: what it is.
        pairs: how many are tested; None: it depends on the recording.
        source: where its files are.
        metrics: what its authors report, of those that `scores` gives.
        rows: their numbers, in the order of `metrics`.
        note: how they measure, where that matters.
    """

    title: str
    pairs: int | None
    source: str
    metrics: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float, ...]], ...]
    note: str = ""


SPLITS = {
    "segments": Published(
        title="Segment-based calibration, test pairs of reconstructed I-80",
        pairs=20,
        source="the authors' repository: per-pair CSV files; the test pairs are listed there",
        metrics=("rmse_gap", "rmse_speed"),
        rows=(
            ("IDM, segment-based", (3.177, 0.606)),
            ("cfx, IDM, pooled", (3.341, 0.618)),
            ("cfx, policy with Krauss", (2.82, 0.588)),
        ),
        note="whole trajectories, means over pairs",
    ),
    "transfollower": Published(
        title="TransFollower, events of 15 s of NGSIM",
        pairs=202,
        source="github.com/MeixinZhu/TransFollower, data/raw_data",
        metrics=("mse_sum",),
        rows=(
            ("LSTM, theirs", (7.58,)),
            ("network, theirs", (8.47,)),
            ("IDM, theirs", (17.65,)),
            ("cfx, IDM, pooled", (7.47,)),
            ("cfx://idm", (5.91,)),
        ),
        note="MSE of speed plus MSE of the gap, each over all frames of an event",
    ),
    "follownet": Published(
        title="FollowNet, test events",
        pairs=None,
        source="github.com/HKUST-DRIVE-AI-LAB/FollowNet",
        metrics=("mse_gap", "collision_share"),
        rows=(),
        note="their table has a row for each recording: set yours beside it",
    ),
}
"""By name. Rows of cfx were measured with earlier versions."""


def read(paths: Sequence[Path], chosen: Path | None) -> PairSet:
    """Reads pairs of any format that cfx knows.

    Args:
        paths: the files.
        chosen: a text file with the id of a pair in each line; None: all pairs.

    Raises:
        DataError: a file cannot be read, or a pair is not there.
    """
    pairs = cfx.read(list(paths), min_duration=0)
    if chosen is None:
        return pairs.selected
    try:
        lines = chosen.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{chosen}: cannot be read ({error})") from None
    wanted = names.names_of([line.strip() for line in lines if line.strip()])
    return pairs.select(wanted).selected


def without(pairs: PairSet, tested: PairSet) -> PairSet:
    """Returns the pairs that are not tested.

    Raises:
        DataError: none is left.
    """
    trajectories = {pair.content for pair in tested}
    left = [pair.content not in trajectories for pair in pairs]
    if not any(left):
        raise DataError(f"{pairs.source}: every pair is tested; nothing is left to learn from")
    return pairs.select(left, "tested")


def scores(entry: Entry, learned: PairSet | None, tested: PairSet, seed: int) -> pd.DataFrame:
    """Lets an entry learn, and drives the tested pairs from their first frames.

    Args:
        entry: who drives.
        learned: pairs to learn from; None: a ready-made policy needs none.
        tested: P pairs.
        seed: of training.

    Returns:
        A row per pair: pair_id, rmse_speed, rmse_gap, mse_speed, mse_gap, mse_sum, collision_share.

    Raises:
        ConfigError: there is nothing to learn from.
    """
    if learned is None and not entry.words[0].startswith("driver="):
        raise ConfigError(f"{entry.words[0]}: has to learn; give --learn FILE")
    if learned is not None:
        learned = without(learned, tested)
    driver = entry.learned(learned or tested, seed)
    segments = whole(list(tested), [0] * len(tested))
    speed = driver.drive(segments.blanked(), segments.first, None)
    return _errors(segments, trajectory_table("", segments, speed))


def _errors(segments: Segments, simulated: pd.DataFrame) -> pd.DataFrame:
    batch = segments.batch()
    row, frame = (batch.mask & (torch.arange(batch.mask.shape[1]) > 0)).nonzero(as_tuple=True)
    table = simulated.assign(
        square_speed=(simulated["speed_mps"] - batch.follower_speed[row, frame].numpy()) ** 2,
        square_gap=(simulated["gap_m"] - batch.gap[row, frame].numpy()) ** 2,
        collides=simulated["gap_m"] < 0.0,
    )
    grouped = table.groupby("pair_id", sort=False)
    errors = pd.DataFrame(
        {
            "mse_speed": grouped["square_speed"].mean(),
            "mse_gap": grouped["square_gap"].mean(),
            "collision_share": grouped["collides"].max().astype(float),
        }
    )
    errors["mse_sum"] = errors["mse_speed"] + errors["mse_gap"]
    errors["rmse_speed"] = np.sqrt(errors["mse_speed"])
    errors["rmse_gap"] = np.sqrt(errors["mse_gap"])
    return errors.reset_index()


def lines(split: Published, name: str, errors: pd.DataFrame) -> list[str]:
    """Returns a row's numbers beside the published ones, as Markdown."""
    heads = {
        "rmse_gap": "RMSE of gap [m]",
        "rmse_speed": "RMSE of speed [m/s]",
        "mse_speed": "MSE of speed [m2/s2]",
        "mse_gap": "MSE of gap [m2]",
        "mse_sum": "MSE of speed and gap, summed",
        "collision_share": "share with a collision",
    }
    lines = [f"{split.title}: {len(errors)} pairs; {split.note}", ""]
    if split.pairs not in {None, len(errors)}:
        lines[-1:] = [
            f"These are {len(errors)} pairs, and {split.pairs} were published: they are others, and"
            f" the published numbers do not compare. {split.source}.",
            "",
        ]
    lines += [
        f"| row | {' | '.join(heads[metric] for metric in split.metrics)} |",
        "|" + " --- |" * (1 + len(split.metrics)),
    ]
    mine = tuple(float(errors[metric].mean()) for metric in split.metrics)
    for row, values in ((f"{name} (now)", mine), *split.rows):
        cells = [f"{value:.3f}" for value in values]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return lines
