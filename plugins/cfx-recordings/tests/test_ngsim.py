"""NGSIM's layouts, recordings and pairs."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.data.describe import describe
from cfx.data.pairs import PairSet
from cfx.errors import DataError
from cfx_recordings.ngsim import FOOT, NgsimDataset, read_ngsim

COLUMNS = [
    *(
        "Vehicle_ID",
        "Frame_ID",
        "Total_Frames",
        "Global_Time",
        "Local_X",
        "Local_Y",
        "Global_X",
        "Global_Y",
        "v_Length",
        "v_Width",
    ),
    *(
        "v_Class",
        "v_Vel",
        "v_Acc",
        "Lane_ID",
        "Preceding",
        "Following",
        "Space_Headway",
        "Time_Headway",
    ),
]
ARTERIAL = [
    *COLUMNS[:14],
    "O_Zone",
    "D_Zone",
    "Int_ID",
    "Section_ID",
    "Direction",
    "Movement",
    *COLUMNS[14:],
]
CLOCK = 1_113_433_136_300


def vehicle(
    number: int,
    leader: int,
    at: float,
    frames: range = range(10, 60),
    lane: int = 2,
    clock: int = CLOCK,
) -> pd.DataFrame:
    """A vehicle at a steady 30 ft/s; `at` is its position at frame 0, ft."""
    k = np.array(frames)
    values = {
        "Vehicle_ID": number,
        "Frame_ID": k,
        "Total_Frames": len(k),
        "Global_Time": clock + 100 * k,
        "Local_Y": at + 3.0 * k,
    }
    values |= {
        "v_Length": 15.0,
        "v_Width": 6.0,
        "v_Class": 2,
        "v_Vel": 30.0,
        "v_Acc": 0.5,
        "Lane_ID": lane,
        "Preceding": leader,
    }
    return pd.DataFrame({name: values.get(name, 0.0) for name in COLUMNS}, index=k)


def traffic(clock: int = CLOCK) -> pd.DataFrame:
    """Vehicle 2 behind 1, and 3 behind 2."""
    rows = [
        vehicle(1, 0, 200.0, clock=clock),
        vehicle(2, 1, 120.0, clock=clock),
        vehicle(3, 2, 60.0, clock=clock),
    ]
    return pd.concat(rows, ignore_index=True)


def save(rows: pd.DataFrame, path: Path, layout: str = "csv") -> Path:
    if layout == "text":
        lines = [
            " ".join(
                f"{value:>12g}" if name != "Global_Time" else f"{value:>14.0f}"
                for name, value in row.items()
            )
            for _, row in rows.iterrows()
        ]
        path.write_text("  " + "\n".join(lines) + " \n")
    else:
        rows.to_csv(path, index=False)
    return path


def found(path: Path) -> list[tuple[str, int, int]]:
    return [(pair.pair_id, pair.first_frame, len(pair)) for pair in read_ngsim(path).pairs()]


def counts(pairs: PairSet) -> dict[str, int]:
    return {dropped.reason: dropped.count for dropped in pairs.dropped}


@pytest.fixture
def rows() -> pd.DataFrame:
    return traffic()


# --- layouts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["csv", "text"])
def test_feet_become_metres(rows: pd.DataFrame, tmp_path: Path, layout: str) -> None:
    first, second = read_ngsim(save(rows, tmp_path / "site.any", layout)).pairs()
    assert (first.pair_id, first.follower_id, first.leader_id) == ("site-2-1", "2", "1")
    assert second.pair_id == "site-3-2"
    assert (first.first_frame, len(first), first.dt, first.lane, first.recording) == (
        10,
        50,
        0.1,
        2,
        "site",
    )
    np.testing.assert_allclose(first.gap, (80 - 15) * 0.3048, rtol=1e-12)
    np.testing.assert_allclose(
        first.follower_position, (120 + 3 * np.arange(10, 60)) * 0.3048, rtol=1e-12
    )
    np.testing.assert_allclose(first.leader_speed, 30 * 0.3048)
    np.testing.assert_allclose(first.follower_acceleration, 0.5 * 0.3048)
    assert first.leader_length == pytest.approx(15 * 0.3048)


def test_all_ways_of_writing_give_the_same_pairs(rows: pd.DataFrame, tmp_path: Path) -> None:
    wanted = found(save(rows, tmp_path / "f.csv"))
    assert len(wanted) == 2
    assert found(save(rows, tmp_path / "f.txt", "text")) == wanted
    (tmp_path / "f.txt.gz").write_bytes(gzip.compress((tmp_path / "f.txt").read_bytes()))
    assert found(tmp_path / "f.txt.gz") == wanted
    assert found(save(rows.sample(frac=1, random_state=0), tmp_path / "f.csv")) == wanted
    (tmp_path / "f.txt").write_bytes(
        (tmp_path / "f.txt").read_bytes().replace(b"\n", b"\r\n").replace(b"  ", b"\t")
    )
    assert found(tmp_path / "f.txt") == wanted
    headless = rows.to_csv(index=False, header=False)
    (tmp_path / "f.csv").write_text(headless)
    assert found(tmp_path / "f.csv") == wanted
    other_names = {
        "v_Vel": "v_vel",
        "v_Length": "v_length",
        "Preceding": "Preceeding",
        "Lane_ID": "Lane ID",
        "Space_Headway": "Space_Hdwy",
    }
    assert found(save(rows.rename(columns=other_names), tmp_path / "f.csv")) == wanted


def test_arterial_text_has_six_columns_more(rows: pd.DataFrame, tmp_path: Path) -> None:
    assert found(
        save(rows.reindex(columns=ARTERIAL, fill_value=7), tmp_path / "f.txt", "text")
    ) == [
        ("f-2-1", 10, 50),
        ("f-3-2", 10, 50),
    ]


def test_thousands_separators_and_quotes(rows: pd.DataFrame, tmp_path: Path) -> None:
    text = rows.astype({"Local_Y": object, "Global_Time": object, "Vehicle_ID": str})
    text["Global_Time"] = rows["Global_Time"].map("{:,}".format)
    text["Local_Y"] = (rows["Local_Y"] + 1000).map("{:,.3f}".format)
    path = tmp_path / "f.csv"
    text.to_csv(path, index=False, quoting=1)
    assert '"1,113,433,137,300"' in path.read_text()
    assert found(path) == [("f-2-1", 10, 50), ("f-3-2", 10, 50)]
    np.testing.assert_allclose(read_ngsim(path).pairs()[0].follower_position[0], 1150 * FOOT)


# --- recordings -----------------------------------------------------------------------------------


def test_recordings_are_told_apart_by_place_and_clock(tmp_path: Path) -> None:
    minutes = 60_000
    parts = [
        traffic(CLOCK + 75 * minutes).assign(Location="i-80"),  # 5:15
        traffic(CLOCK).assign(Location="i-80"),  # 4:00
        traffic(CLOCK + 60 * minutes).assign(Location="i-80"),  # 5:00
        traffic(CLOCK).assign(Location="us-101"),
    ]
    path = save(pd.concat(parts).sample(frac=1, random_state=2), tmp_path / "all.csv")
    pairs = read_ngsim(path).pairs()
    assert [pair.pair_id for pair in pairs] == [
        *(
            "i-80-1-2-1",
            "i-80-1-3-2",
            "i-80-2-2-1",
            "i-80-2-3-2",
            "i-80-3-2-1",
            "i-80-3-3-2",
            "us-101-2-1",
            "us-101-3-2",
        ),
    ]
    assert {len(pair) for pair in pairs} == {50}
    assert len({pair.driver for pair in pairs}) == 8, (
        "vehicle 2 of one recording is not vehicle 2 of another"
    )
    assert [pair.site for pair in pairs] == [*["i-80"] * 6, *["us-101"] * 2]
    chosen = NgsimDataset(path=path, location="US-101", min_duration=0).load()
    assert [pair.pair_id for pair in chosen] == ["us-101-2-1", "us-101-3-2"]
    assert counts(chosen)["other locations than 'US-101'"] == 450
    assert len(NgsimDataset(path=path, recording="i-80-2", min_duration=0).load()) == 2
    with pytest.raises(DataError, match=r"no such location. Did you mean 'us-101'\? Known: "):
        NgsimDataset(path=path, location="us101", min_duration=0).load()


@pytest.mark.parametrize(
    ("day", "site"),
    [
        ("2005-04-13 16:00", "i-80"),
        ("2005-04-13 17:29", "i-80"),
        ("2005-06-15 07:50", "us-101"),
        ("2005-06-16 08:28", "lankershim"),
        ("2006-11-08 13:00", "peachtree"),
        ("2005-04-14 16:00", ""),
    ],
)
def test_without_a_location_the_day_tells_the_site(tmp_path: Path, day: str, site: str) -> None:
    place = "America/New_York" if site == "peachtree" else "America/Los_Angeles"
    clock = round(1000 * pd.Timestamp(day, tz=place).timestamp())
    path = save(traffic(clock), tmp_path / "trajectories.csv")
    assert {pair.site for pair in read_ngsim(path).pairs()} == {site}


def test_recordings_that_overlap_in_time_are_told_apart(tmp_path: Path) -> None:
    """The second recording's clock starts two minutes after the first's, while that still runs."""
    long = pd.concat([vehicle(1, 0, 200.0, range(2000)), vehicle(2, 1, 120.0, range(2000))])
    late = pd.concat(
        [
            vehicle(1, 0, 200.0, range(2000), clock=CLOCK + 120_000),
            vehicle(2, 1, 120.0, range(2000), clock=CLOCK + 120_000),
        ]
    )
    assert found(save(pd.concat([long, late]), tmp_path / "f.csv")) == [
        ("f-1-2-1", 0, 2000),
        ("f-2-2-1", 0, 2000),
    ]


@pytest.mark.parametrize("clock", ["none", "rounded"])
def test_without_a_usable_clock_there_is_one_recording(
    rows: pd.DataFrame, tmp_path: Path, clock: str
) -> None:
    rows = (
        rows.drop(columns="Global_Time") if clock == "none" else rows.assign(Global_Time=1.11343e12)
    )
    assert len(found(save(rows, tmp_path / "f.csv"))) == 2
    with pytest.raises(DataError, match="give it Global_Time in milliseconds"):
        found(save(pd.concat([rows, rows.assign(Local_Y=rows["Local_Y"] + 9)]), tmp_path / "f.csv"))


# --- pairs ----------------------------------------------------------------------------------------


def reference(rows: pd.DataFrame) -> dict[tuple[int, int, int], int]:
    """Pairs as METHOD says, row by row: (follower, leader, first frame) -> frames."""
    at = {(r.Vehicle_ID, r.Frame_ID): r for r in rows.itertuples()}
    runs: dict[tuple[int, int, int], int] = {}
    before: tuple[object, ...] = ()
    first = 0
    for r in sorted(rows.itertuples(), key=lambda r: (r.Vehicle_ID, r.Frame_ID)):
        leader = at.get((r.Preceding, r.Frame_ID)) if r.Preceding else None
        if (
            leader is None
            or leader.Lane_ID != r.Lane_ID
            or leader.Local_Y - leader.v_Length <= r.Local_Y
        ):
            before = ()
            continue
        if before != (r.Vehicle_ID, r.Preceding, r.Lane_ID, r.Frame_ID - 1):
            first = r.Frame_ID
        before = (r.Vehicle_ID, r.Preceding, r.Lane_ID, r.Frame_ID)
        runs[r.Vehicle_ID, r.Preceding, first] = r.Frame_ID - first + 1
    return {key: size for key, size in runs.items() if size > 1}


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_pairs_are_those_of_the_definition(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    parts = []
    for number in range(1, 6):
        rows = vehicle(number, number - 1, 400.0 - 60 * number, range(40))
        rows["Preceding"] = np.where(
            rng.random(40) < 0.1, rng.integers(0, 7, 40), rows["Preceding"]
        )
        rows["Lane_ID"] = np.where(np.arange(40) >= rng.integers(20, 60), 3, 2)
        rows["Local_Y"] += rng.choice([0, 70], 40, p=[0.97, 0.03])
        parts.append(rows[rng.random(40) > 0.05])
    rows = pd.concat(parts, ignore_index=True)
    path = save(rows.sample(frac=1, random_state=seed), tmp_path_factory.mktemp("ngsim") / "f.csv")
    pairs = read_ngsim(path).pairs()
    assert {
        (int(p.follower_id), int(p.leader_id), p.first_frame): len(p) for p in pairs
    } == reference(rows)
    rows_in_pairs = sum(len(pair) for pair in pairs)
    assert rows_in_pairs + sum(d.count for d in pairs.dropped if d.unit == "rows") == len(rows), (
        "every row is used or counted"
    )


def test_everything_left_out_is_counted_with_its_reason(tmp_path: Path) -> None:
    rows = traffic().set_index(["Vehicle_ID", "Frame_ID"], drop=False)
    rows.loc[(1, 20), "Lane_ID"] = 3
    rows.loc[(3, 30), "Preceding"] = 99
    rows.loc[(2, 40), "Local_Y"] += 70.0
    rows.loc[(3, 31), "Preceding"] = 1  # a leader for a single frame
    again = pd.concat([rows, rows.loc[[(3, 50), (3, 51)]]])
    pairs = read_ngsim(save(again, tmp_path / "f.csv")).pairs()
    assert counts(pairs) == {
        "the same row again": 2,
        "no vehicle ahead": 50,
        "the vehicle ahead has no row at that frame": 1,
        "the vehicle ahead is in another lane": 1,
        "the leader is behind its follower (gap of 0 or less)": 1,
        "a single frame makes no pair": 1,
    }
    assert [(pair.pair_id, pair.first_frame, len(pair)) for pair in pairs] == [
        *(
            ("f-2-1", 10, 10),
            ("f-2-1-run2", 21, 19),
            ("f-2-1-run3", 41, 19),
            ("f-3-2", 10, 20),
            ("f-3-2-run2", 32, 28),
        ),
    ]


def test_both_ends_of_every_vehicle_are_left_out_if_wanted(tmp_path: Path) -> None:
    rows = pd.concat(
        [traffic(), vehicle(4, 3, 0.0, range(10, 25))], ignore_index=True
    )  # the last one is too short to be left
    path = save(rows, tmp_path / "f.csv")
    whole, pairs = (
        NgsimDataset(path=path, min_duration=0, trim=trim).load() for trim in (0.0, 1.0)
    )
    assert [(pair.pair_id, pair.first_frame, len(pair)) for pair in pairs] == [
        ("f-2-1", 20, 30),
        ("f-3-2", 20, 30),
    ]
    np.testing.assert_array_equal(pairs[0].follower_position, whole[0].follower_position[10:40])
    assert counts(pairs)["within 1 s of their vehicle's first or last row"] == 3 * 20 + 15
    assert sum(map(len, pairs)) + sum(d.count for d in pairs.dropped if d.unit == "rows") == len(
        rows
    )


def test_boundary_artefacts_are_said_until_they_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = pd.concat(
        [vehicle(1, 0, 200.0, range(10, 200)), vehicle(2, 1, 120.0, range(10, 200))],
        ignore_index=True,
    )
    straight = save(rows, tmp_path / "straight.csv")
    rows.loc[rows.Frame_ID < 40, "v_Acc"] = 4.5
    smoothed = save(rows, tmp_path / "smoothed.csv")
    with caplog.at_level("INFO"):
        NgsimDataset(path=straight, min_duration=0, accelerations="recorded").load()
        NgsimDataset(path=smoothed, min_duration=0, trim=3, accelerations="recorded").load()
        assert not caplog.messages
        NgsimDataset(path=smoothed, min_duration=0, check="off", accelerations="recorded").load()
    assert len(caplog.messages) == 1
    assert "accelerate by +1.4 and +0.2 m/s2 on average (+0.2 between)" in caplog.messages[0]
    assert "data.trim=3" in describe(smoothed).text
    assert "data.trim" not in describe(straight).text


@pytest.mark.parametrize(
    ("in_metres", "says"),
    [
        ([], []),
        (["Local_Y", "v_Vel", "v_Acc"], ["Space_Headway is typically 3.28", "Time_Headway"]),
        (["v_Vel"], ["Time_Headway is typically 0.305 times"]),
        (["Space_Headway"], ["Space_Headway is typically 0.305 times", "Time_Headway"]),
    ],
)
def test_a_file_in_two_units_is_refused(
    rows: pd.DataFrame, tmp_path: Path, in_metres: list[str], says: list[str]
) -> None:
    rows["Space_Headway"] = rows["Vehicle_ID"].map({1: 0.0, 2: 80.0, 3: 60.0})
    rows["Time_Headway"] = (rows["Space_Headway"] / 30).replace(0.0, 9999.99)
    rows[in_metres] *= FOOT
    dataset = NgsimDataset(path=save(rows, tmp_path / "f.csv"), min_duration=0)
    remarks = dataset.read().remarks
    assert all(remark.is_contradiction for remark in remarks)
    assert [words in remark.text for words, remark in zip(says, remarks, strict=True)] == [
        True for _ in says
    ]
    if says:
        with pytest.raises(DataError, match="feet and metres: the file seems to be in two units"):
            dataset.load()


def test_two_recordings_in_one_file_without_a_clock_keep_their_lengths(
    rows: pd.DataFrame, tmp_path: Path
) -> None:
    second = rows.assign(Frame_ID=rows["Frame_ID"] + 60, v_Length=25.0)
    path = save(pd.concat([rows, second]).drop(columns="Global_Time"), tmp_path / "f.csv")
    contents = NgsimDataset(path=path, min_duration=0).contents()
    gaps = [round(float(pair.gap[0]) / FOOT, 6) for pair in contents.pairs]
    assert dict(zip((pair.pair_id for pair in contents.pairs), gaps, strict=True)) == {
        "f-2-1": 65.0,
        "f-2-vehicle2-1-vehicle2": 55.0,
        "f-3-2": 45.0,
        "f-3-vehicle2-2-vehicle2": 35.0,
    }
    assert contents.vehicles == 6
    assert "3 ids stand for two vehicles" in describe(path).text


def test_a_preceding_that_is_not_the_next_in_the_lane_is_said(
    rows: pd.DataFrame, tmp_path: Path
) -> None:
    rows.loc[rows["Vehicle_ID"] == 3, "Preceding"] = 1
    alone = rows[rows["Frame_ID"] % 2 == 0].loc[lambda some: some["Vehicle_ID"] != 2]
    between = rows[rows["Vehicle_ID"] == 2].assign(Preceding=0)
    path = save(pd.concat([alone, between]), tmp_path / "f.csv")
    (remark,) = NgsimDataset(path=path, min_duration=0).read().remarks
    assert "the distance to the Preceding agrees with" in remark.text
    assert not remark.is_contradiction


# --- real recordings ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def raw(shared_data: Path) -> PairSet:
    return NgsimDataset(path=shared_data / "i80_0400_raw_sample.csv.gz", min_duration=30).load()


def test_raw_sample_has_142_pairs(raw: PairSet) -> None:
    assert len(raw) == 142
    assert all((pair.gap > 0).all() for pair in raw)
    assert counts(raw)["no vehicle ahead"] == 42_566
    assert counts(raw)["the leader is behind its follower (gap of 0 or less)"] == 24
    assert {pair.recording for pair in raw} == {"i80_0400_raw_sample"}
    assert {pair.site for pair in raw} == {"i-80"}
    assert not raw.remarks


def test_raw_speeds_have_artefacts_for_three_seconds(shared_data: Path) -> None:
    rows = read_ngsim(shared_data / "i80_0400_raw_sample.csv.gz")
    assert "by +0.8 and -1.1 m/s2" in rows.boundary_artefacts()
    assert rows.trimmed(3.0).boundary_artefacts() == ""


def test_raw_pairs_agree_with_their_reconstruction(raw: PairSet, i80_pairs: PairSet) -> None:
    reconstructed = [pair for pair in i80_pairs if pair.recording == "i80-0400"]
    by_ids = {(pair.follower_id, pair.leader_id): pair for pair in reconstructed}
    both = [
        (pair, by_ids[pair.follower_id, pair.leader_id])
        for pair in raw
        if (pair.follower_id, pair.leader_id) in by_ids
    ]
    assert len(both) == 10
    errors: dict[str, list[np.ndarray]] = {
        "follower_position": [],
        "leader_position": [],
        "follower_speed": [],
    }
    for one, other in both:
        assert one.leader_length == pytest.approx(other.leader_length, abs=1e-9)
        first = max(one.first_frame, other.first_frame)
        last = min(one.first_frame + len(one), other.first_frame + len(other))
        assert last - first > 200
        for name, found in errors.items():
            a = getattr(one, name)[first - one.first_frame : last - one.first_frame]
            b = getattr(other, name)[first - other.first_frame : last - other.first_frame]
            found.append(a - b)
    median = {
        name: float(np.median(np.abs(np.concatenate(found)))) for name, found in errors.items()
    }
    assert median["follower_position"] < 0.6
    assert median["leader_position"] < 0.6
    assert median["follower_speed"] < 0.3


# --- what is refused ------------------------------------------------------------------------------

Change = Callable[[pd.DataFrame], pd.DataFrame | None]


def put(column: str, value: object, row: int = 3) -> Change:
    def change(rows: pd.DataFrame) -> None:
        rows[column] = rows[column].astype(object)
        rows.loc[row, column] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda r: r.rename(columns={"v_Vel": "v_Speed"}),
            ["column v_Vel is missing", "Columns found"],
        ),
        (
            lambda r: r.rename(columns={"Preceding": "Precedes"}),
            ["Preceding is missing", "Did you mean 'Precedes'?"],
        ),
        (lambda r: r.iloc[:0], ["no rows"]),
        (put("v_Vel", "fast"), ["row 5", "column v_Vel", "'fast' is not a number"]),
        (put("v_Vel", np.nan), ["row 5", "column v_Vel", "empty or NaN", "1 such"]),
        (put("Local_Y", np.inf), ["row 5", "column Local_Y", "infinite"]),
        (put("v_Vel", -3.0), ["row 5", "column v_Vel", "-3 is negative"]),
        (put("v_Length", 0.0), ["row 5", "column v_Length", "no vehicle length"]),
        (put("Frame_ID", 12.5), ["row 5", "column Frame_ID", "12.5 is no whole number"]),
        (put("Frame_ID", 12), ["rows 4 and 5", "vehicle 1", "two different rows at frame 12"]),
        (
            lambda r: r.assign(**{c: r[c] * 0.3048 for c in ("Local_Y", "v_Length", "v_Vel")}),
            ["v_Length", "4.6 long", "metres", "data=tidy"],
        ),
        (
            lambda r: r.assign(Location=["x"] * 3 + [""] + ["x"] * 146),
            ["row 5", "Location", "empty"],
        ),
        (
            lambda r: r.rename(columns={"Vehicle_ID": "pair_id"}),
            ["Vehicle_ID is missing", "use data=tidy"],
        ),
    ],
)
def test_refuses_what_no_recording_can_hold(
    rows: pd.DataFrame, tmp_path: Path, change: Change, said: list[str]
) -> None:
    changed = change(rows)
    with pytest.raises(DataError) as error:
        read_ngsim(save(rows if changed is None else changed, tmp_path / "f.csv"))
    message = str(error.value)
    assert str(tmp_path) in message
    assert "\n" not in message
    for words in said:
        assert words in message, message


@pytest.mark.parametrize(
    ("factor", "unit"), [(0.3048, "m/s"), (1 / 1.46667, "mph"), (1.09728, "km/h")]
)
def test_a_unit_is_told_from_feet(
    factor: float, unit: str, tmp_path: Path, shared_data: Path
) -> None:
    raw = pd.read_csv(shared_data / "i80_0400_raw_sample.csv.gz").query("Lane_ID == 2")
    save(raw.assign(v_Vel=raw["v_Vel"] * factor), tmp_path / "f.csv")
    with pytest.raises(DataError, match=f"the speeds look like {unit}, not ft/s"):
        NgsimDataset(path=tmp_path / "f.csv", min_duration=30).load()


def test_files_that_cannot_be_read(rows: pd.DataFrame, tmp_path: Path) -> None:
    def says(path: Path, words: str) -> None:
        with pytest.raises(DataError, match=words) as error:
            read_ngsim(path)
        assert path.name in str(error.value)

    def file(name: str, content: bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    text = save(rows, tmp_path / "good.txt", "text").read_bytes()
    says(tmp_path / "none.txt", "no such file")
    says(tmp_path, "is a folder")
    says(file("empty.txt", b""), "is empty")
    says(file("binary.txt", bytes(range(256)) * 40), "is a binary file")
    lines = text.split(b"\n")
    narrow = b"\n".join(b" ".join(line.split()[:17]) for line in lines)
    says(file("narrow.txt", narrow), "has 17 columns; NGSIM's files without a header have 18")
    ragged = b"\n".join([*lines[:5], lines[5] + b" 1 2", *lines[6:]])
    says(file("ragged.txt", ragged), "row 6: 20 columns instead of 18")
    says(
        file("cut.txt", text[: text.rfind(b" 30 ")]),
        r"row \d+: \d+ columns instead of 18; is the file cut off",
    )
    says(
        file("word.txt", text.replace(b" 30 ", b" -- ", 1)),
        "row 1, column v_Vel: '--' is not a number",
    )
    packed = gzip.compress(text)
    says(file("cut.txt.gz", packed[: len(packed) // 2]), "gzip file is cut off")
    rows.to_parquet(tmp_path / "f.parquet")
    says(tmp_path / "f.parquet", "is a parquet file")


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_other_separators_and_decimal_commas(
    rows: pd.DataFrame, tmp_path: Path, separator: str
) -> None:
    wanted = found(save(rows, tmp_path / "f.csv"))
    rows.to_csv(tmp_path / "g.csv", index=False, sep=separator, decimal=",")
    (tmp_path / "g.csv").rename(tmp_path / "f.csv")
    assert found(tmp_path / "f.csv") == wanted


@pytest.mark.parametrize("renumbered", [False, True])
def test_a_thinned_file_has_the_step_that_its_frames_or_its_clock_say(
    rows: pd.DataFrame, tmp_path: Path, renumbered: bool
) -> None:
    rows = rows[rows["Frame_ID"] % 2 == 0]
    if renumbered:
        rows = rows.assign(Frame_ID=rows["Frame_ID"] // 2)
    path = tmp_path / "thinned.csv"
    rows.assign(Space_Headway=0, Time_Headway=0).to_csv(path, index=False)
    pairs = NgsimDataset(path=path, min_duration=0, check="off").load()
    assert pairs.dt == 0.2
    assert max(len(pair) for pair in pairs) > 10


def test_vehicles_at_different_frames_of_a_thinned_file_are_refused(
    rows: pd.DataFrame, tmp_path: Path
) -> None:
    rows = rows[(rows["Frame_ID"] + rows["Vehicle_ID"]) % 2 == 0]
    path = tmp_path / "thinned.csv"
    rows.to_csv(path, index=False)
    with pytest.raises(DataError, match="not all at the same ones"):
        NgsimDataset(path=path, min_duration=0).load()
