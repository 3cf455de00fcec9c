"""The tidy layout: what is read, what is refused, and that writing and reading change nothing."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from cfx.data.pairs import Pair, PairSet
from cfx.data.signals import RECORDED
from cfx.data.tidy import TidyDataset, pairs_from_frame, read_tidy, write_tidy
from cfx.errors import DataError, OutputError
from cfx.simulation.synthetic import SyntheticDataset


def same(one: PairSet, other: PairSet) -> None:
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        for f in fields(Pair):
            x, y = getattr(a, f.name), getattr(b, f.name)
            if f.name in RECORDED:
                np.testing.assert_array_equal(x, y, strict=True)
            elif f.name == "truth":
                assert set(x) == set(y)
                for name in x:
                    np.testing.assert_array_equal(x[name], y[name], strict=True)
            else:
                assert x == y
                assert type(x) is type(y)


@pytest.fixture
def good() -> pd.DataFrame:
    """Two pairs of 30 and 20 frames."""
    return pd.concat([table("p", 30, frame=5), table("q", 20, frame=0)], ignore_index=True)


def table(pair: str, frames: int, frame: int) -> pd.DataFrame:
    k = np.arange(frames)
    speed = 10 + np.sin(k / 5)
    position = np.cumsum(speed) * 0.1
    return pd.DataFrame(
        {
            "recording": "rec",
            "pair_id": pair,
            "leader_id": 1,
            "follower_id": 2,
            "frame": frame + k,
            "time_s": (frame + k) * 0.1,
            "leader_position_m": position + 20,
            "leader_speed_mps": speed,
            "leader_acceleration_mps2": 0.0,
            "leader_length_m": 4.5,
            "follower_position_m": position,
            "follower_speed_mps": speed,
            "follower_acceleration_mps2": 0.0,
        }
    )


def read(frame: pd.DataFrame, folder: Path, name: str = "t.csv") -> PairSet:
    path = folder / name
    if name.endswith("parquet"):
        frame.to_parquet(path, index=False)
    else:
        frame.to_csv(path, index=False)
    return read_tidy(path)


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet", "t.txt"])
def test_reads_parquet_and_csv(good: pd.DataFrame, tmp_path: Path, name: str) -> None:
    pairs = read(good, tmp_path, name)
    assert [(pair.pair_id, len(pair), pair.first_frame) for pair in pairs] == [
        ("p", 30, 5),
        ("q", 20, 0),
    ]
    assert pairs[0].leader_id == "1"
    assert pairs[0].dt == 0.1
    assert pairs[0].lane is None
    np.testing.assert_allclose(pairs[0].gap, 15.5, rtol=1e-9)
    assert pairs.dropped == ()


def test_row_order_does_not_matter(good: pd.DataFrame, tmp_path: Path) -> None:
    shuffled = good.sample(frac=1, random_state=1).sort_values("pair_id", kind="stable")
    same(read(shuffled, tmp_path), read(good, tmp_path))


def test_text_ids_lanes_and_truth_are_understood(good: pd.DataFrame, tmp_path: Path) -> None:
    good["leader_id"], good["lane"] = "car x", 2
    good["true_model"], good["true_t_r"] = "krauss", np.linspace(1, 2, len(good))
    pair = read(good, tmp_path)[0]
    assert (pair.leader_id, pair.lane, pair.truth_model, list(pair.truth)) == (
        "car x",
        2,
        "krauss",
        ["t_r"],
    )


def test_other_columns_are_ignored_and_counted(good: pd.DataFrame, tmp_path: Path) -> None:
    for name in ("t.csv", "t.parquet"):
        (dropped,) = read(good.assign(weather="rain", note=1), tmp_path, name).dropped
        assert (dropped.count, dropped.unit) == (2, "columns")
        assert "weather" in dropped.reason


def test_a_table_reads_as_a_file_does(good: pd.DataFrame, tmp_path: Path) -> None:
    same(pairs_from_frame(good), read(good, tmp_path, "t.parquet"))


def test_real_pairs(shared_data: Path, i80_pairs: PairSet) -> None:
    path = shared_data / "i80_reconstructed_pairs.parquet"
    assert len(i80_pairs) == 229
    assert len(TidyDataset(path=path).load()) == 229
    assert len(TidyDataset(path=path, min_duration=70).load()) == 71
    with pytest.raises(
        DataError,
        match="asked for 50 pairs but only 26 last 70 s in the selected recording",
    ):
        TidyDataset(path=path, recording="i80-0400", min_duration=70, max_pairs=50).load()


# --- round trip -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["t.parquet", "t.csv", "t.csv.gz"])
def test_writing_and_reading_real_pairs_changes_nothing(
    i80_pairs: PairSet, tmp_path: Path, name: str
) -> None:
    pairs = i80_pairs.take(range(5))
    write_tidy(pairs, tmp_path / name)
    same(pairs, read_tidy(tmp_path / name))
    assert [path.name for path in tmp_path.iterdir()] == [name], "no temporary file is left"


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@example(
    seed=0, dt=1001 / 30000, first_frame=0, lane=None, name="t.parquet", ids="0"
)  # 29.97 frames per second
@given(
    seed=st.integers(0, 10_000),
    dt=st.sampled_from([0.1, 0.04, 1 / 30, 0.2, 1001 / 30000, 0.123]),
    first_frame=st.integers(-50, 10**7),
    lane=st.none() | st.integers(0, 9),
    name=st.sampled_from(["t.parquet", "t.csv", "t.csv.gz"]),
    ids=st.text("abc XYZ019-_.,;\"'é", min_size=1).map(str.strip).filter(bool),
)
def test_round_trip_is_exact(
    tmp_path: Path, seed: int, dt: float, first_frame: int, lane: int | None, name: str, ids: str
) -> None:
    rng = np.random.default_rng(seed)

    def a_pair(number: int, truth: dict[str, np.ndarray]) -> Pair:
        speed = rng.uniform(0, 30, 12)
        position = np.cumsum(speed) * dt + rng.normal(0, 1e-3, 12)
        acceleration = rng.normal(0, 1, 12)
        return Pair(
            *(f"{ids}{number}", "rec", ids, str(number), first_frame, dt, 4.56789),
            *(position + 50, speed, acceleration, position, speed.copy(), acceleration),
            lane=lane,
            truth=truth,
            truth_model="krauss" if truth else "",
        )

    pairs = PairSet(
        (
            a_pair(0, {}),
            a_pair(1, {"t_r": rng.uniform(1, 2, 12)}),
            a_pair(2, {"t_i": rng.uniform(0, 1, 12)}),
        ),
        "x",
    )
    write_tidy(pairs, tmp_path / name)
    same(pairs, read_tidy(tmp_path / name))


def test_synthetic_pairs_survive_with_their_truth(tmp_path: Path) -> None:
    pairs = SyntheticDataset(pairs=3, frames=40, platoon_size=2).load()
    write_tidy(pairs, tmp_path / "s.parquet")
    again = TidyDataset(path=tmp_path / "s.parquet", min_duration=0).load()
    same(pairs, again)
    assert again.fingerprint == pairs.fingerprint


def test_writing_says_what_is_wrong_and_leaves_what_was_there(
    good: pd.DataFrame, tmp_path: Path
) -> None:
    pairs = pairs_from_frame(good)
    with pytest.raises(OutputError, match=r"named \.parquet, \.csv or \.csv\.gz"):
        write_tidy(pairs, tmp_path / "t.xlsx")
    with pytest.raises(OutputError, match="cannot be written"):
        write_tidy(pairs, tmp_path / "nowhere" / "t.csv")
    (tmp_path / "taken.csv").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        write_tidy(pairs, tmp_path / "taken.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.csv"]


# --- what is refused ------------------------------------------------------------------------------

Change = Callable[[pd.DataFrame], pd.DataFrame | None]


def put(column: str, value: object, row: int = 3) -> Change:
    def change(frame: pd.DataFrame) -> None:
        frame[column] = frame[column].astype(object)
        frame.loc[row, column] = value

    return change


def scale(factor: float, *columns: str) -> Change:
    def change(frame: pd.DataFrame) -> None:
        for column in columns:
            frame[column] *= factor

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.drop(columns="time_s"), ["column time_s is missing", "Columns found"]),
        (
            lambda f: f.rename(columns={"leader_speed_mps": "leader_speed"}),
            ["leader_speed_mps is missing", "Did you mean 'leader_speed'?"],
        ),
        (lambda f: f.iloc[:0], ["no rows"]),
        (
            put("follower_speed_mps", "fast"),
            ["row 5", "follower_speed_mps", "'fast' is not a number"],
        ),
        (
            put("follower_speed_mps", np.nan),
            ["row 5", "pair 'p', frame 8", "empty or NaN", "1 such"],
        ),
        (put("leader_position_m", np.inf), ["row 5", "leader_position_m", "infinite"]),
        (put("pair_id", None), ["row 5", "column pair_id", "empty"]),
        (put("frame", 8.5), ["row 5", "column frame", "no whole number"]),
        (put("frame", 7), ["row 5", "same pair and frame as row 4"]),
        (lambda f: f.drop(index=3), ["row 5 (pair 'p', frame 9)", "frame before is 7", "missing"]),
        (lambda f: f.drop(index=range(1, 30)), ["single frame"]),
        (put("time_s", 0.83), ["time step", "0.13 s here and 0.1 s on average"]),
        (put("time_s", 0.5), ["row 5", "time does not advance"]),
        (put("follower_speed_mps", -0.5), ["row 5", "follower_speed_mps", "-0.5 is negative"]),
        (put("leader_length_m", -1.0), ["row 5", "leader_length_m", "no vehicle length"]),
        (
            put("leader_length_m", 4.6),
            ["row 5", "leader_length_m", "differs from the pair's first row"],
        ),
        (put("leader_id", 7), ["row 5", "leader_id", "differs from the pair's first row"]),
        (put("recording", "x"), ["row 5", "recording", "differs"]),
        (put("leader_position_m", 0.0), ["row 5", "leader is behind its follower", "the gap is -"]),
        (lambda f: f.assign(lane=[1] * 10 + [2] * 40), ["row 12", "column lane", "differs"]),
        (
            lambda f: f.assign(true_a=[1.0] * 10 + [np.nan] * 40),
            ["row 12", "true_a", "part of the pair"],
        ),
        (
            lambda f: f.rename(columns={"pair_id": "Vehicle_ID"}),
            ["pair_id is missing", "use data=ngsim"],
        ),
    ],
)
def test_refuses_what_no_recording_can_hold(
    good: pd.DataFrame, tmp_path: Path, change: Change, said: list[str]
) -> None:
    changed = change(good)
    with pytest.raises(DataError) as error:
        read(good if changed is None else changed, tmp_path)
    message = str(error.value)
    assert str(tmp_path) in message
    assert "\n" not in message
    for words in said:
        assert words in message, message


def test_parquet_and_tables_are_checked_the_same_way(good: pd.DataFrame, tmp_path: Path) -> None:
    broken = good.assign(follower_speed_mps=["fast", *good["follower_speed_mps"].astype(str)[1:]])
    with pytest.raises(
        DataError, match=r"row 1, column follower_speed_mps: 'fast' is not a number"
    ):
        read(broken, tmp_path, "t.parquet")
    with pytest.raises(
        DataError, match=r"table, row 1, column follower_speed_mps: 'fast' is not a number"
    ):
        pairs_from_frame(broken)
    with pytest.raises(DataError, match=r"row 3,.*infinite"):
        read(good.assign(time_s=[0, 0.1, np.inf, *good["time_s"][3:]]), tmp_path, "t.parquet")
    with pytest.raises(DataError, match=r"column time_s is missing"):
        read(good.drop(columns="time_s"), tmp_path, "t.parquet")
    with pytest.raises(DataError, match="row 1, column time_s: 'x' is not a number"):
        pairs_from_frame(good.assign(time_s=["x", *good["time_s"][1:]]))


def test_files_that_cannot_be_read(good: pd.DataFrame, tmp_path: Path) -> None:
    def says(path: Path, words: str) -> None:
        with pytest.raises(DataError, match=words) as error:
            read_tidy(path)
        assert path.name in str(error.value)

    def file(name: str, content: bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    says(tmp_path / "none.csv", "no such file")
    says(tmp_path / "nowhere" / "none.csv", "nor is there a folder")
    says(tmp_path, "is a folder")
    says(file("empty.csv", b""), "is empty")
    says(file("blank.csv", b"\n\n \n"), "holds no rows")
    says(file("binary.csv", bytes(range(256)) * 40), "is a binary file")
    says(file("utf16.csv", good.to_csv(index=False).encode("utf-16")), "UTF-16")
    says(file("a.zip", b"PK\x03\x04 and so on"), "zip file is cut off or damaged")
    text = good.to_csv(index=False)
    says(file("spaces.csv", text.replace(",", " ").encode()), "separated by spaces")
    says(file("colons.csv", text.replace(",", ":").encode()), "is missing")
    says(
        file(
            "headless.csv",
            text.split("\n", 1)[1].replace("rec,p,", "1,2,").replace("rec,q,", "1,3,").encode(),
        ),
        "column names",
    )
    says(file("twice.csv", text.replace("follower_id", "leader_id").encode()), "more than once")
    cut = text.encode()[: len(text) // 2]
    says(
        file("cut.csv", cut[: cut.rfind(b",")]),
        r"row \d+: \d+ columns instead of 13; is the file cut off",
    )
    packed = gzip.compress(text.encode())
    says(file("cut.csv.gz", packed[: len(packed) // 2]), "gzip file is cut off")
    damaged = bytearray(packed)
    damaged[len(packed) // 2] ^= 0xFF
    says(file("damaged.csv.gz", bytes(damaged)), "gzip file is (damaged|cut off)|binary")
    good.to_parquet(tmp_path / "t.parquet", index=False)
    whole = (tmp_path / "t.parquet").read_bytes()
    says(file("cut.parquet", whole[: len(whole) // 2]), "parquet file is cut off or damaged")


def test_bom_blank_lines_and_windows_line_ends_do_no_harm(
    good: pd.DataFrame, tmp_path: Path
) -> None:
    text = good.to_csv(index=False)
    (tmp_path / "w.csv").write_bytes(
        b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode() + b"\r\n\r\n"
    )
    same(read_tidy(tmp_path / "w.csv"), read(good, tmp_path))


def test_remarks_above_the_header_do_no_harm(good: pd.DataFrame, tmp_path: Path) -> None:
    wanted = read(good, tmp_path)
    text = good.to_csv(index=False)
    for above in ("# by a recorder, at 10 Hz\n#\n", "\n\n", "# by a recorder\n\n"):
        (tmp_path / "rec.csv").write_text(above + text)
        same(read_tidy(tmp_path / "rec.csv"), wanted)


# --- gaps in place of positions, and who drives ---------------------------------------------------

LENGTHS_AND_POSITIONS = ["leader_length_m", "leader_position_m", "follower_position_m"]
ACCELERATIONS = ["leader_acceleration_mps2", "follower_acceleration_mps2"]


def with_gap(frame: pd.DataFrame) -> pd.DataFrame:
    gap = frame["leader_position_m"] - frame["leader_length_m"] - frame["follower_position_m"]
    return frame.assign(gap_m=gap)


@pytest.mark.parametrize(
    "absent",
    [
        [],
        ["leader_length_m"],
        ["leader_position_m"],
        ["follower_position_m"],
        ["leader_length_m", "leader_position_m"],
        LENGTHS_AND_POSITIONS,
        [*LENGTHS_AND_POSITIONS, *ACCELERATIONS],
    ],
)
def test_a_column_of_gaps_replaces_what_follows_from_it(
    good: pd.DataFrame, tmp_path: Path, absent: list[str]
) -> None:
    whole = read(good, tmp_path)
    pairs = read(with_gap(good).drop(columns=absent), tmp_path, "gaps.csv")
    for pair, original in zip(pairs, whole, strict=True):
        np.testing.assert_allclose(pair.gap, original.gap, atol=1e-9)
        for who in ("leader", "follower"):
            moved = np.diff(getattr(pair, f"{who}_position"))
            np.testing.assert_allclose(
                moved, np.diff(getattr(original, f"{who}_position")), atol=1e-9
            )
            np.testing.assert_array_equal(
                getattr(pair, f"{who}_speed"), getattr(original, f"{who}_speed")
            )
        known = "leader_length_m" not in absent or "leader_position_m" not in absent
        assert pair.leader_length == pytest.approx(4.5 if known else 0.0)
    if "leader_acceleration_mps2" in absent:
        expected = np.gradient(whole[0].follower_speed, whole[0].dt)
        np.testing.assert_allclose(pairs[0].follower_acceleration, expected)


def test_a_length_of_0_says_that_positions_are_rear_bumpers(
    good: pd.DataFrame, tmp_path: Path
) -> None:
    rear = good["leader_position_m"] - 4.5
    pairs = read(good.assign(leader_position_m=rear, leader_length_m=0), tmp_path)
    np.testing.assert_allclose(pairs[0].gap, read(good, tmp_path, "front.csv")[0].gap)


def test_a_gap_that_contradicts_the_positions_is_refused(
    good: pd.DataFrame, tmp_path: Path
) -> None:
    wrong = with_gap(good)
    wrong.loc[3, "gap_m"] = 2.0
    with pytest.raises(DataError, match=r"row 5, column gap_m .* is 2.00 m, but the positions and"):
        read(wrong, tmp_path)


def test_without_a_gap_a_length_is_still_needed(good: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="column leader_length_m is missing"):
        read(good.drop(columns=["leader_length_m"]), tmp_path)


def test_who_drives_is_kept_and_selected(good: pd.DataFrame, tmp_path: Path) -> None:
    labelled = good.assign(driver_type=np.where(good["pair_id"] == "p", "human", "acc"))
    path = tmp_path / "t.csv"
    labelled.to_csv(path, index=False)
    assert [pair.driver_type for pair in read_tidy(path)] == ["human", "acc"]
    pairs = TidyDataset(path=path, min_duration=0, driver_type="acc").load()
    assert [pair.pair_id for pair in pairs] == ["q"]
    assert pairs.dropped[-1].count == 1
    write_tidy(read_tidy(path), tmp_path / "again.parquet")
    same(read_tidy(path), read_tidy(tmp_path / "again.parquet"))
    with pytest.raises(DataError, match="does not say what drives"):
        TidyDataset(path=path, min_duration=0, leader_driver_type="acc").load()


def test_a_driver_that_changes_within_a_pair_is_refused(good: pd.DataFrame, tmp_path: Path) -> None:
    labels = np.where(good["frame"] > 10, "human", "acc")
    with pytest.raises(DataError, match=r"column driver_type .* differs from the pair's first row"):
        read(good.assign(driver_type=labels), tmp_path)
