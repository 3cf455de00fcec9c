"""`data describe`: what a file holds, in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfx.data.describe import describe
from cfx.data.pairs import PairSet
from cfx.data.tidy import TidyDataset, frame_of, write_tidy
from cfx.errors import DataError
from cfx.simulation.synthetic import SyntheticDataset
from tests.checkout import needs
from tests.drives import straight_pairs
from tests.installer import Installer


def test_describes_real_tidy_pairs(shared_data: Path) -> None:
    text = describe(shared_data / "i80_reconstructed_pairs.parquet").text
    for words in (
        "147,521",
        "i80-0400 (113 pairs), i80-0500 (116 pairs)",
        "229 of 221 drivers",
        "0.1 s",
        "Left out in reading: nothing",
    ):
        assert words in text
    line = next(line for line in text.splitlines() if "at least 70 s" in line)
    assert line.split()[-1] == "71"


@needs("cfx-recordings")
def test_describes_a_real_raw_recording(shared_data: Path) -> None:
    text = describe(shared_data / "i80_0400_raw_sample.csv.gz").text
    for words in (
        "NGSIM (feet)",
        "110,905",
        "222",
        "145 of 142 drivers",
        "42,566 rows: no vehicle ahead",
        "data=ngsim",
    ):
        assert words in text


def test_describes_synthetic_pairs_with_their_truth(tmp_path: Path) -> None:
    write_tidy(SyntheticDataset(pairs=2, frames=50).load(), tmp_path / "s.csv")
    text = describe(tmp_path / "s.csv").text
    assert "known, of krauss" in text
    assert "Problems: none found" in text


def test_points_at_what_looks_wrong(tmp_path: Path) -> None:
    pairs = SyntheticDataset(pairs=2, frames=50, noise_position_m=1.0).load()
    write_tidy(pairs, tmp_path / "s.csv")
    assert "position moves 1 m more or less" in describe(tmp_path / "s.csv").text


def test_names_pairs_that_are_copies_of_others(tmp_path: Path) -> None:
    pairs = SyntheticDataset(pairs=4, frames=300).load()
    copy = replace(
        pairs[2],
        pair_id="copy",
        recording="elsewhere",
        follower_speed=pairs[2].follower_speed.round(1),
        leader_position=pairs[2].leader_position + 100.0,
        follower_position=pairs[2].follower_position + 100.0,
    )
    standing = straight_pairs([300, 300]).pairs
    write_tidy(PairSet((*pairs, copy, *standing), "s"), tmp_path / "s.csv")
    said = describe(tmp_path / "s.csv").text
    assert "1 of 7 pairs drive as another one does" in said
    assert f"('copy' as '{pairs[2].pair_id}')" in said


@needs("cfx-recordings")
def test_a_file_that_cannot_be_used_says_why(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        describe(tmp_path / "none.csv")
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"Columns found: a, b\. Known layouts:.*NGSIM"):
        describe(tmp_path / "x.csv")


MINE = """
import numpy as np
from cfx.plugin import Dataset, Pair, PairSet
from cfx.data.base import FileDatasetSettings


class Mine(Dataset):
    layout = "my recorder (m)"
    schema = FileDatasetSettings

    @classmethod
    def recognises(cls, start):
        return start.has_columns("my_time", "my_gap")

    def read(self):
        speed = np.full(50, 10.0)
        there = np.cumsum(speed) * 0.1
        signals = [there + 20, speed, 0 * speed, there, speed, 0 * speed]
        return PairSet((Pair("p", "r", "1", "2", 0, 0.1, 4.0, *signals),), "mine")
"""


def test_a_plugin_tells_about_its_layout(tmp_path: Path, install: Installer) -> None:
    install("cfx-mine", {"cfx.datasets": {"mine": "cfx_mine:Mine"}}, {"cfx_mine.py": MINE})
    path = tmp_path / "m.csv"
    path.write_text("my_time,my_gap\n0,1\n")
    text = describe(path).text
    assert "my recorder (m)" in text
    assert f"Use it: data=mine data.path={path}" in text


def test_a_broken_plugin_is_warned_of_and_stops_nothing(
    tmp_path: Path, install: Installer, caplog: pytest.LogCaptureFixture
) -> None:
    install("cfx-bad", {"cfx.datasets": {"bad": "cfx_bad:Bad"}}, {"cfx_bad.py": "1 / 0"})
    (tmp_path / "m.csv").write_text("my_time,my_gap\n0,1\n")
    with pytest.raises(DataError, match="no dataset knows this layout"):
        describe(tmp_path / "m.csv")
    assert "cfx-bad" in caplog.text


def advice(path: Path, pairs: PairSet) -> list[str]:
    """Writes pairs; returns the options behind the path of the line to use, and what stands below.

    A job leaves out pairs of less than 10 s, unless told otherwise.
    """
    write_tidy(pairs, path)
    used, kept = describe(path).text.splitlines()[-2:]
    assert used.startswith(f"Use it: data=tidy data.path={path}")
    return [used.partition(str(path))[2].strip(), kept]


@pytest.mark.parametrize(
    ("lengths", "options", "kept"),
    [
        ([43, 26, 38], "data.min_duration=3.8", (2, 3)),
        ([30, 20], "data.min_duration=2", (2, 2)),
        ([100, 20], "", (1, 2)),
        ([100, 72, 71], "data.min_duration=5", (3, 3)),
        ([100, 72, 30], "data.min_duration=5", (2, 3)),
    ],
)
def test_the_advice_keeps_at_least_half_of_the_pairs_and_says_what_it_leaves_out(
    tmp_path: Path, lengths: list[int], options: str, kept: tuple[int, int]
) -> None:
    path = tmp_path / "pairs.parquet"
    said = advice(path, straight_pairs(lengths))
    assert said[0] == options
    few, every = kept
    if few == every:
        assert said[1] == f"It keeps all {every} pairs."
    else:
        least = options.rpartition("=")[2] or "10"
        assert said[1] == (
            f"It keeps {few} of {every} pairs and leaves out {every - few} shorter than {least}"
            f" s; data.min_duration={min(lengths) / 10:g} keeps all."
        )
    given = {"path": path} | (
        {"min_duration": float(options.rpartition("=")[2])} if options else {}
    )
    assert len(TidyDataset(**given).load()) == few


def test_the_advice_brings_recordings_to_one_step(tmp_path: Path) -> None:
    """A job needs one time step; lengths count in it."""
    slow = straight_pairs([200])
    fast = [
        replace(pair, dt=0.05, pair_id=f"f{pair.pair_id}", recording="fast")
        for pair in SyntheticDataset(pairs=1, frames=401, dt=0.05).load()
    ]
    both = PairSet((*slow, *fast), "both")
    path = tmp_path / "pairs.parquet"
    assert advice(path, both) == ["data.time_step=0.1", "It keeps all 2 pairs."]
    assert len(TidyDataset(path=path, time_step=0.1).load()) == 2


def test_says_what_it_does_not_know(tmp_path: Path) -> None:
    frame = frame_of(SyntheticDataset(pairs=2, frames=50).load())
    gap = frame["leader_position_m"] - frame["leader_length_m"] - frame["follower_position_m"]
    named = ["pair_id", "time_s", "leader_speed_mps", "follower_speed_mps"]
    frame[named].assign(gap_m=gap).to_csv(tmp_path / "t.csv", index=False)
    text = describe(tmp_path / "t.csv").text
    assert "not known: leaders and followers have no ids" in text
    assert "length of 2 of 2 leaders is not known" in text
    assert "front to front), m" not in text
    frame.assign(gap_m=gap).drop(columns="leader_id").to_csv(tmp_path / "t.csv", index=False)
    assert "2; leaders have no ids" in describe(tmp_path / "t.csv").text


def test_says_the_units_that_it_read(tmp_path: Path) -> None:
    frame = frame_of(SyntheticDataset(pairs=2, frames=50).load())
    frame = frame.rename(columns={"follower_speed_mps": "v"})
    frame["v"] *= 3.6
    frame.to_csv(tmp_path / "t.csv", index=False)
    settings = {"name": "tidy", "columns": {"speed": "v"}, "units": {"speed": "km/h"}}
    text = describe(tmp_path / "t.csv", settings).text
    assert "as read: speed in km/h; converted to SI units" in text


def test_says_what_a_noisy_gap_makes_of_positions(tmp_path: Path) -> None:
    frame = frame_of(SyntheticDataset(pairs=2, frames=200).load())
    gap = frame["leader_position_m"] - frame["leader_length_m"] - frame["follower_position_m"]
    noise = np.where(frame["frame"] % 50 == 0, 3.0, 0.0)
    named = ["pair_id", "time_s", "leader_speed_mps", "follower_speed_mps"]
    frame[named].assign(gap_m=gap + noise).to_csv(tmp_path / "t.csv", index=False)
    text = describe(tmp_path / "t.csv").text
    assert "moves backwards" in text
    assert "the noise of the gap while vehicles stand or creep" in text


def test_a_table_with_names_of_its_own_is_told_the_line_that_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "dashcam.csv"
    path.write_text("trip;t;speed_kmh;ahead_kmh;distance\n1,0;0,0;36,0;36,5;12,5\n")
    with pytest.raises(DataError) as error:
        describe(path)
    assert (
        f"cfx data describe {path} data.columns.pair_id=trip data.columns.time=t"
        " data.columns.leader_speed=ahead_kmh data.columns.speed=speed_kmh"
        " data.columns.gap=distance data.units.leader_speed=km/h data.units.speed=km/h"
    ) in str(error.value)
