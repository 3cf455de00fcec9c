"""SUMO's FCD output: as its documentation has it, and as SUMO itself writes it."""

from __future__ import annotations

import gzip
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cfx.app.cli import main
from cfx.data.describe import describe
from cfx.errors import DataError
from cfx_contracts import check_contract
from cfx_sumo.fcd import SumoFcdDataset
from cfx_sumo.fcd_lanes import Lanes
from tests.data.layouts import made_pairs, write_fcd


@pytest.mark.parametrize("leaders", [True, False])
def test_contract(leaders: bool, tmp_path: Path) -> None:
    path = write_fcd(tmp_path / "fcd.xml", made_pairs(), leaders=leaders)
    check_contract(SumoFcdDataset(path=path, min_duration=10, max_gap=None))


@pytest.mark.parametrize("leaders", [True, False])
def test_gives_gaps_and_speeds_back(tmp_path: Path, leaders: bool) -> None:
    made = made_pairs()
    path = write_fcd(tmp_path / "fcd.xml", made, leaders=leaders, length=7.0)
    pairs = SumoFcdDataset(path=path, min_duration=0, max_gap=None, lengths={"car": 7.0}).load()
    for pair, original in zip(pairs, made, strict=True):
        np.testing.assert_allclose(pair.gap, original.gap, atol=2e-6)
        np.testing.assert_allclose(pair.follower_speed, original.follower_speed, atol=1e-6)
        assert pair.leader_length == 7.0
        assert pair.driver_type == "car"


def test_is_recognised_packed_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = write_fcd(tmp_path / "fcd.xml", made_pairs())
    packed = tmp_path / "fcd.xml.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    for path in (plain, packed):
        assert main(["data", "describe", str(path)]) == 0
        assert "SUMO's FCD output" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("--netstate-dump", "<netstate><timestep time='0'/></netstate>"),
        ("--amitran-output", "<trajectories timeStepSize='1000'><actorConfig/></trajectories>"),
        ("--tripinfo-output", "<?xml version='1.0'?>\n<!-- generated -->\n<tripinfos/>"),
        ("--emission-output", "<emission-export><timestep time='0'/></emission-export>"),
        ("--netstate-dump", ' time="0.00" id="e"lane_id;vehicle_id;vehicle_pos\ne_0;f.0;5.10\n'),
        ("--amitran-output", "actorConfig_id;actorConfig_fuel;vehicle_id\n0;gasoline;f.0\n"),
        ("--tripinfo-output", "tripinfo_id;tripinfo_depart\nf.0;0.00\n"),
        ("--summary-output", "step_time;step_loaded\n0.00;1\n"),
    ],
)
def test_another_output_of_sumo_names_the_option_that_writes_this_one(
    tmp_path: Path, option: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out"
    path.write_text(text)
    assert main(["data", "describe", str(path)]) == 2
    said = capsys.readouterr().err
    assert f"is what SUMO writes with {option}" in said
    assert "SUMO writes with --fcd-output fcd.xml" in said


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<fcd-export><timestep", "the XML is cut off or damaged"),
        ("<gpx><trk/></gpx>", "is XML of <gpx>, not SUMO's FCD output"),
        ("<routes><vehicle/></routes>", "writes with --vehroute-output"),
        ("<netstate/>", "writes with --netstate-dump .*which SUMO writes with --fcd-output"),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><fcd-export/>", "has a DOCTYPE"),
        ("<fcd-export/>", "holds no vehicles"),
        (
            '<fcd-export><timestep time="0"><vehicle id="a" speed="1"/></timestep></fcd-export>',
            "has no attribute 'pos'; write it with --fcd-output.attributes",
        ),
        (
            '<fcd-export><timestep time="x"></timestep></fcd-export>',
            "time='x' is not a number",
        ),
    ],
)
def test_says_what_is_wrong(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "fcd.xml"
    path.write_text(text)
    with pytest.raises(DataError, match=says):
        SumoFcdDataset(path=path).read()


NETWORK = """
<net version="1.20">
<location netOffset="0,0" convBoundary="0,0,2000,10" origBoundary="0,0,1,1" projParameter="!"/>
<edge id="e1" from="a" to="b" priority="1">
<lane id="e1_0" index="0" speed="25" length="2000" shape="0,0 2000,0"/>
<lane id="e1_1" index="1" speed="25" length="2000" shape="0,3.5 2000,3.5"/></edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
<junction id="b" type="dead_end" x="2000" y="0" incLanes="e1_0 e1_1" intLanes="" shape="2000,0"/>
</net>
"""

ROUTES = """
<routes><vType id="car" length="4.3"/><vType id="truck" length="12" maxSpeed="20"/>
<route id="r" edges="e1"/>
<flow id="f" type="car" route="r" begin="0" end="60" period="3" departLane="random" departSpeed="max"/>
<flow id="t" type="truck" route="r" begin="0" end="60" period="11" departLane="0" departSpeed="max"/>
</routes>
"""

RUN = """
import sys, libsumo
libsumo.start(["sumo", "-n", "n.net.xml", "-r", "r.rou.xml", "--step-length", "0.1", "--seed", "3",
    "--no-step-log", "--precision", "6", "--fcd-output", "fcd.xml", *sys.argv[1:]])
while libsumo.simulation.getTime() < 60:
    libsumo.simulationStep()
libsumo.close()
"""


@pytest.fixture(scope="module")
def of_sumo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What SUMO writes of two lanes with cars and lorries."""
    pytest.importorskip("importlib.metadata").version("libsumo")
    folder = tmp_path_factory.mktemp("sumo")
    (folder / "n.net.xml").write_text(NETWORK)
    (folder / "r.rou.xml").write_text(ROUTES)
    options = ["--fcd-output.max-leader-distance", "200", "--fcd-output.acceleration"]
    command = [sys.executable, "-c", textwrap.dedent(RUN), *options]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "fcd.xml"


def test_reads_what_sumo_writes(of_sumo: Path) -> None:
    pairs = SumoFcdDataset(path=of_sumo, min_duration=5).load()
    assert len(pairs) > 5
    lengths = {pair.leader_driver_type: pair.leader_length for pair in pairs}
    assert lengths == {"car": 4.3, "truck": 12.0}, "lengths follow from gaps and positions"
    assert not pairs.remarks
    for pair in pairs:
        moved = np.diff(pair.follower_position)
        # Gaps and speeds are SUMO's own; they belong together to the digits that it writes.
        np.testing.assert_allclose(moved, pair.follower_speed[1:] * pair.dt, atol=1e-5)


@pytest.mark.parametrize("rule", ["euler", "ballistic"])
def test_positions_follow_speeds_as_sumo_integrates(rule: str) -> None:
    """Over an edge's end too, where positions within lanes do not say it."""
    speed = np.array([10.0, 12.0, 15.0, 14.0, 11.0, 11.0])
    moved = speed[1:] if rule == "euler" else 0.5 * (speed[1:] + speed[:-1])
    way = np.append(0.0, np.cumsum(moved))
    lane = np.array([0, 0, 0, 1, 1, 1])
    unknown = np.full(6, np.nan)
    lanes = Lanes(
        vehicle=np.ones(6, dtype=np.int64),
        frame=np.arange(6),
        lane=lane,
        position=way - 30.0 * lane,
        speed=speed,
        lateral=unknown,
        x=unknown,
        y=unknown,
        heading=unknown,
    )
    np.testing.assert_allclose(lanes.driven(1.0), way)


def test_leaders_are_those_that_sumo_names(
    of_sumo: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = of_sumo.read_text()
    plain = tmp_path / "plain.xml"
    plain.write_text(text.replace("leaderGap=", "other=").replace("leaderID=", "another="))
    options = {"min_duration": 5, "lengths": {"car": 4.3, "truck": 12.0}}
    by_name = SumoFcdDataset(path=of_sumo, **options).load()
    by_place = SumoFcdDataset(path=plain, **options).load()
    assert "how long vehicles are" not in caplog.text
    SumoFcdDataset(path=plain, min_duration=5, lengths={"car": 4.3}).read()
    assert "how long vehicles are: those of type truck count as 5 m" in caplog.text
    gaps = {(p.follower_id, p.leader_id, p.first_frame): p.gap for p in by_place}
    matched = 0
    for pair in by_name:
        other = gaps.get((pair.follower_id, pair.leader_id, pair.first_frame))
        if other is not None and len(other) == len(pair):
            np.testing.assert_allclose(pair.gap, other, atol=1e-4)
            matched += 1
    assert matched > len(by_name) / 2


@pytest.mark.parametrize(
    ("attribute", "factor", "says"),
    [
        ("leaderGap", 1 / 0.3048, "leaderGap is typically 3.28 times .* feet and metres"),
        ("leaderSpeed", 3.6, r"leaderSpeed is typically 3\.6 times .* km/h and m/s"),
    ],
)
def test_leaders_in_another_unit_are_refused(
    of_sumo: Path, tmp_path: Path, attribute: str, factor: float, says: str
) -> None:
    def scaled(match: re.Match[str]) -> str:
        return f'{attribute}="{float(match[1]) * factor:.6f}"'

    path = tmp_path / "fcd.xml"
    path.write_text(re.sub(rf'{attribute}="([0-9.]+)"', scaled, of_sumo.read_text()))
    with pytest.raises(DataError, match=says):
        SumoFcdDataset(path=path, min_duration=5).load()


def test_lengths_are_taken_as_the_docs_write_them(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data=sumo_fcd", "data.path=fcd.xml", "data.lengths={truck: 12.0}", "--cfg", "job"]
    assert main(words) == 0
    assert "lengths:\n    truck: 12.0\n" in capsys.readouterr().out


def test_types_of_one_vehicle_are_the_type_they_came_from(of_sumo: Path) -> None:
    own = RUN.replace("fcd.xml", "own.xml").replace(
        "    libsumo.simulationStep()\n",
        "    libsumo.simulationStep()\n    if libsumo.simulation.getTime() == 1:\n"
        '        libsumo.vehicle.setTau("t.0", 1.4)\n',
    )
    subprocess.run([sys.executable, "-c", own], cwd=of_sumo.parent, check=True, capture_output=True)
    path = of_sumo.with_name("own.xml")
    assert 'type="truck@t.0"' in path.read_text(), "SUMO gives the vehicle a type of its own"
    lengths = {"car": 4.3, "truck": 12.0}
    pairs = SumoFcdDataset(path=path, min_duration=5, lengths=lengths).load()
    behind = [pair for pair in pairs if pair.leader_id == "t.0"]
    assert behind, "somebody follows it"
    assert {(pair.leader_driver_type, pair.leader_length) for pair in behind} == {("truck", 12.0)}


TWO_WAYS = """
<net version="1.20">
<location netOffset="0,0" convBoundary="0,0,2000,10" origBoundary="0,0,1,1" projParameter="!"/>
<edge id="e1" from="a" to="b" priority="1">
<lane id="e1_0" index="0" speed="25" length="2000" shape="0,-1.6 2000,-1.6"><neigh lane="e2_0"/></lane></edge>
<edge id="e2" from="b" to="a" priority="1">
<lane id="e2_0" index="0" speed="25" length="2000" shape="2000,1.6 0,1.6"><neigh lane="e1_0"/></lane></edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="e2_0" intLanes="" shape="0,0"/>
<junction id="b" type="dead_end" x="2000" y="0" incLanes="e1_0" intLanes="" shape="2000,0"/>
</net>
"""

PARKED = """
<routes><vType id="car" length="4.3"/><route id="r" edges="e1"/>
<vehicle id="parked" type="car" route="r" depart="0" departPos="300" departSpeed="0">
<stop lane="e1_0" startPos="295" endPos="320" duration="17" parking="true"/></vehicle>
<flow id="f" type="car" route="r" begin="0" end="30" period="3" departLane="0" departSpeed="max"/>
</routes>
"""

SUBLANE = """
<routes><vType id="car" length="4.3" latAlignment="compact" maxSpeed="15"/>
<vType id="moto" vClass="motorcycle" length="2.2" latAlignment="right" maxSpeed="22" lcPushy="0.5"/>
<route id="r" edges="e1"/>
<flow id="f" type="car" route="r" begin="0" end="60" period="3" departLane="0" departSpeed="max"/>
<flow id="m" type="moto" route="r" begin="0" end="60" period="5" departLane="0" departSpeed="max"/>
</routes>
"""

ONCOMING = """
<routes><vType id="car" length="4.3"/><vType id="slow" length="4.3" maxSpeed="8"/>
<route id="r" edges="e1"/><route id="q" edges="e2"/>
<vehicle id="slow" type="slow" route="r" depart="0" departSpeed="max"/>
<flow id="f" type="car" route="r" begin="3" end="30" period="6" departSpeed="max"/>
<vehicle id="on0" type="car" route="q" depart="14" departSpeed="5"/>
<vehicle id="on1" type="car" route="q" depart="17" departSpeed="5"/>
</routes>
"""

KINDS = """
import sys, libsumo
LEADERS = ["--fcd-output.max-leader-distance", "200"]
SUBLANE = ["--lateral-resolution", "0.4"]
PLAIN = ["--fcd-output.attributes", "id,type,speed,pos,lane"]
for net, routes, end, file, options in [
    ("n", "parked", 35, "parked.xml", []),
    ("n", "parked", 35, "parked-leaders.xml", LEADERS),
    ("n", "parked", 35, "parked-plain.xml", PLAIN),
    ("n", "parked", 9, "nobody-passes.xml", []),
    ("n", "sublane", 40, "sublane.xml", SUBLANE),
    ("n", "sublane", 40, "sublane-leaders.xml", SUBLANE + LEADERS),
    ("n", "sublane", 40, "sublane-plain.xml", SUBLANE + PLAIN),
    ("two", "oncoming", 40, "oncoming.xml", []),
    ("two", "oncoming", 40, "oncoming-leaders.xml", LEADERS),
    ("n", "r", 40, "some.xml", ["--device.fcd.probability", "0.4"]),
    ("n", "r", 40, "some-leaders.xml", ["--device.fcd.probability", "0.4"] + LEADERS),
    ("n", "r", 20, "same.xml", []),
    ("n", "r", 20, "same.csv", []),
    ("n", "r", 20, "same.csv.gz", ["--output.column-header", "plain"]),
    ("n", "r", 20, "same.parquet", []),
    ("n", "r", 20, "leaders.csv", LEADERS + ["--fcd-output.acceleration", "--output.column-separator", ","]),
]:
    libsumo.start(["sumo", "-n", net + ".net.xml", "-r", routes + ".rou.xml", "--step-length",
        "0.1", "--seed", "3", "--no-step-log", "--no-warnings", "--precision", "6",
        "--fcd-output", file, *options])
    while libsumo.simulation.getTime() < end:
        libsumo.simulationStep()
    libsumo.close()
"""


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of what SUMO writes of parked, sublane and oncoming vehicles, and its formats."""
    pytest.importorskip("importlib.metadata").version("libsumo")
    folder = tmp_path_factory.mktemp("kinds")
    files = {
        "n.net.xml": NETWORK,
        "two.net.xml": TWO_WAYS,
        "r.rou.xml": ROUTES,
        "parked.rou.xml": PARKED,
        "sublane.rou.xml": SUBLANE,
        "oncoming.rou.xml": ONCOMING,
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    command = [sys.executable, "-c", textwrap.dedent(KINDS)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder


LENGTHS = {"car": 4.3, "slow": 4.3, "moto": 2.2, "truck": 12.0}


def _rows(path: Path) -> dict[tuple[str, int], dict[str, str]]:
    """What SUMO wrote of each vehicle in each frame."""
    rows = {}
    root = ElementTree.parse(path).getroot()  # noqa: S314 - SUMO has just written it
    for frame, step in enumerate(root):
        for vehicle in step:
            rows[vehicle.attrib["id"], frame] = dict(vehicle.attrib)
    return rows


@pytest.mark.parametrize("name", ["parked", "parked-leaders", "parked-plain", "nobody-passes"])
def test_parked_vehicles_neither_lead_nor_follow(kinds: Path, name: str) -> None:
    path = kinds / f"{name}.xml"
    rows = _rows(path)
    pairs = SumoFcdDataset(path=path, min_duration=0, lengths=LENGTHS).read()
    assert len(pairs) >= 2
    assert any(drop.reason == "parked beside the lane" for drop in pairs.dropped)
    for pair in pairs:
        for frame in range(pair.first_frame, pair.first_frame + len(pair)):
            for who in (pair.leader_id, pair.follower_id):
                assert float(rows[who, frame].get("y", 0)) >= 0.0
                assert who != "parked" or float(rows[who, frame]["speed"]) > 0.0


@pytest.mark.parametrize("name", ["sublane", "sublane-leaders"])
def test_vehicles_side_by_side_in_a_lane_are_no_pair(kinds: Path, name: str) -> None:
    path = kinds / f"{name}.xml"
    rows = _rows(path)
    pairs = SumoFcdDataset(path=path, min_duration=2, lengths=LENGTHS).load()
    assert len(pairs) > 10
    for pair in pairs:
        frames = range(pair.first_frame, pair.first_frame + len(pair))
        leader = [float(rows[pair.leader_id, frame]["y"]) for frame in frames]
        follower = [float(rows[pair.follower_id, frame]["y"]) for frame in frames]
        assert np.abs(np.subtract(leader, follower)).max() < 1.8
        assert pair.gap.min() > 0


def test_vehicles_that_pass_each_other_in_a_lane_are_no_pair_there(kinds: Path) -> None:
    pairs = SumoFcdDataset(path=kinds / "sublane-plain.xml", min_duration=0, lengths=LENGTHS).load()
    couples = {(pair.leader_id, pair.follower_id) for pair in pairs}
    assert couples, "cars still follow cars"
    assert not {(one, other) for other, one in couples} & couples


@pytest.mark.parametrize("name", ["oncoming", "oncoming-leaders"])
def test_oncoming_vehicles_are_no_pair(kinds: Path, name: str) -> None:
    path = kinds / f"{name}.xml"
    rows = _rows(path)
    overtakes = [who for (who, _), row in rows.items() if row["lane"] == "e2_0" and who[0] == "f"]
    assert overtakes, "somebody overtakes in the lane of those who come towards it"
    pairs = SumoFcdDataset(path=path, min_duration=0, max_gap=None, lengths=LENGTHS).load()
    assert {(pair.leader_id, pair.follower_id) for pair in pairs} >= {("on0", "on1")}
    for pair in pairs:
        ways = {rows[who, pair.first_frame]["angle"] for who in (pair.leader_id, pair.follower_id)}
        assert len(ways) == 1
        assert rows[pair.leader_id, pair.first_frame]["lane"] in {"e1_0", "e2_0"}
        heads_back = ways == {"270.000000"}
        assert (rows[pair.follower_id, pair.first_frame]["lane"] == "e2_0") == heads_back


def test_vehicles_that_are_not_recorded_are_said(kinds: Path, tmp_path: Path) -> None:
    path = kinds / "some.xml"
    text = describe(path).text
    assert "vehicles of flows are not in it (" in text
    assert "Problems: none found" not in text
    for whole in ("some-leaders.xml", "same.xml"):
        assert (
            not SumoFcdDataset(path=kinds / whole, min_duration=0, lengths=LENGTHS).read().remarks
        )
    named = tmp_path / "named.xml"
    named.write_text(re.sub(r'id="(.)\.', r'id="\1', path.read_text()))
    remarks = SumoFcdDataset(path=named, min_duration=0, lengths=LENGTHS).read().remarks
    assert not [remark for remark in remarks if "flows" in remark.text]


@pytest.mark.parametrize("name", ["same.csv", "same.csv.gz", "same.parquet"])
def test_every_format_gives_the_same_pairs(
    kinds: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = SumoFcdDataset(path=kinds / "same.xml", min_duration=0, lengths=LENGTHS).read()
    pairs = SumoFcdDataset(path=kinds / name, min_duration=0, lengths=LENGTHS).read()
    assert pairs.dropped == expected.dropped
    for pair, other in zip(pairs, expected, strict=True):
        assert (pair.pair_id, pair.driver_type) == (other.pair_id, other.driver_type)
        np.testing.assert_allclose(pair.gap, other.gap, atol=2e-6)
        np.testing.assert_allclose(pair.follower_speed, other.follower_speed, atol=1e-6)
    assert main(["data", "describe", str(kinds / name)]) == 0
    assert "SUMO's FCD output" in capsys.readouterr().out


def test_csv_with_leaders_gives_lengths(kinds: Path) -> None:
    pairs = SumoFcdDataset(path=kinds / "leaders.csv", min_duration=0).load()
    lengths = {pair.leader_driver_type: pair.leader_length for pair in pairs}
    assert lengths == {"car": 4.3, "truck": 12.0}


def test_rows_of_persons_and_empty_steps_are_no_vehicles(tmp_path: Path) -> None:
    path = tmp_path / "fcd.csv"
    head = "timestep_time;vehicle_id;vehicle_type;vehicle_speed;vehicle_pos;vehicle_lane"
    rows = [head, "0.000;;;;;"]
    for frame in range(1, 6):
        rows.append(f"{frame};a;car;10;{100 + 10 * frame};e_0")
        rows.append(f"{frame};b;car;10;{80 + 10 * frame};e_0")
        rows.append(f"{frame};walker;DEFAULT_PEDTYPE;1;{frame};")
    path.write_text("\n".join(rows) + "\n")
    pairs = SumoFcdDataset(path=path, min_duration=0).read()
    assert [(pair.leader_id, pair.follower_id, len(pair)) for pair in pairs] == [("a", "b", 5)]
    assert ("a person, or in no lane", 5) in [(drop.reason, drop.count) for drop in pairs.dropped]
    path.write_text(path.read_text().replace("1;a;car;10;", "1;a;car;;"))
    with pytest.raises(DataError, match=r"row 3, column speed .*a vehicle in a lane has a speed"):
        SumoFcdDataset(path=path, min_duration=0).read()
