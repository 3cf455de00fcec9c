"""SUMO's FCD output: as its documentation has it, and as SUMO itself writes it."""

from __future__ import annotations

import gzip
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from cfx.app.cli import main
from cfx.contracts import check_contract
from cfx.core.errors import DataError
from cfx_sumo.fcd import SumoFcdDataset
from tests.data.layouts import made_pairs, write_fcd


@pytest.mark.parametrize("leaders", [True, False])
def test_contract(leaders: bool, tmp_path: Path) -> None:
    path = write_fcd(tmp_path / "fcd.xml", made_pairs(), leaders=leaders)
    check_contract(SumoFcdDataset(path=path, min_frames=100, max_gap=None))


@pytest.mark.parametrize("leaders", [True, False])
def test_gives_gaps_and_speeds_back(tmp_path: Path, leaders: bool) -> None:
    made = made_pairs()
    path = write_fcd(tmp_path / "fcd.xml", made, leaders=leaders, length=7.0)
    pairs = SumoFcdDataset(path=path, min_frames=2, max_gap=None, lengths={"car": 7.0}).load()
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
    ("text", "says"),
    [
        ("<fcd-export><timestep", "the XML is cut off or damaged"),
        ("<routes><vehicle/></routes>", "is XML of <routes>, not SUMO's FCD output"),
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
    pairs = SumoFcdDataset(path=of_sumo, min_frames=50).load()
    assert len(pairs) > 5
    lengths = {pair.leader_driver_type: pair.leader_length for pair in pairs}
    assert lengths == {"car": 4.3, "truck": 12.0}, "lengths follow from gaps and positions"
    for pair in pairs:
        moved = np.diff(pair.follower_position)
        # Gaps and speeds are SUMO's own; they belong together to the digits that it writes.
        np.testing.assert_allclose(moved, pair.follower_speed[1:] * pair.dt, atol=1e-5)


def test_leaders_are_those_that_sumo_names(of_sumo: Path, tmp_path: Path) -> None:
    text = of_sumo.read_text()
    plain = tmp_path / "plain.xml"
    plain.write_text(text.replace("leaderGap=", "other=").replace("leaderID=", "another="))
    options = {"min_frames": 50, "lengths": {"car": 4.3, "truck": 12.0}}
    by_name = SumoFcdDataset(path=of_sumo, **options).load()
    by_place = SumoFcdDataset(path=plain, **options).load()
    gaps = {(p.follower_id, p.leader_id, p.first_frame): p.gap for p in by_place}
    matched = 0
    for pair in by_name:
        other = gaps.get((pair.follower_id, pair.leader_id, pair.first_frame))
        if other is not None and len(other) == len(pair):
            np.testing.assert_allclose(pair.gap, other, atol=1e-4)
            matched += 1
    assert matched > len(by_name) / 2


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
    pairs = SumoFcdDataset(path=path, min_frames=50, lengths=lengths).load()
    behind = [pair for pair in pairs if pair.leader_id == "t.0"]
    assert behind, "somebody follows it"
    assert {(pair.leader_driver_type, pair.leader_length) for pair in behind} == {("truck", 12.0)}
