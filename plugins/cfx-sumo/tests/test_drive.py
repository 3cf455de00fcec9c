from __future__ import annotations

import csv
import json
import logging
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from cfx.app.cli import main
from cfx.core.distributions import install_line
from cfx.errors import ConfigError
from cfx.policies.checkpoint import save_agent
from cfx_sumo.commands import parse_drivers
from cfx_sumo.demo.motorway import SHIPPED
from cfx_sumo.drive.printed import report
from cfx_sumo.drive.sumo_process import command_line
from cfx_sumo.drive.tally import Collision, CollisionCounts, ScenarioRun, Tally
from tests.agents import adaptive
from tests.forks import Forks

pytest.importorskip("traci", reason="needs the extra sumo")

DEMAND = """<routes>
  <vType id="calm" minGap="1"/> <vType id="hasty"/> <vType id="other"/> <vType id="ghost"/>
  <route id="whole" edges="1001 1002 1003"/> <route id="ramp" edges="1004 1002 1003"/>
  <flow id="c" type="calm" route="whole" begin="0" end="20" vehsPerHour="3000"
      departLane="random" departSpeed="12"/>
  <flow id="h" type="hasty" route="whole" begin="0" end="20" vehsPerHour="3000"
      departLane="random" departSpeed="12"/>
  <flow id="o" type="other" route="whole" begin="0" end="20" vehsPerHour="900"
      departLane="random" departSpeed="9"/>
  <flow id="r" type="calm" route="ramp" begin="0" end="20" vehsPerHour="600"/>
</routes>"""

CONFIGURATION = """<configuration><input><net-file value="{net}"/>
  <route-files value="{demand}"/></input>
<time><end value="30"/><step-length value="{step}"/></time></configuration>"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenario")
    demand = folder / "demand.rou.xml"
    demand.write_text(DEMAND)
    (folder / "lost.rou.xml").write_text(DEMAND.replace("1001 1002 1003", "1001 1002 9999"))
    for name, values in {
        "motorway": {"demand": demand, "step": 0.1},
        "slow": {"demand": demand, "step": 2},
        "lost": {"demand": folder / "lost.rou.xml", "step": 0.1},
    }.items():
        (folder / f"{name}.sumocfg").write_text(CONFIGURATION.format(net=SHIPPED, **values))
    (folder / "torn.sumocfg").write_text("<configuration><input><net-file")
    for name, model in (("calm", "krauss"), ("hasty", "w99")):
        save_agent(adaptive({"name": model}), folder / name / "policy")
    return folder


def python(live: Forks, script: str, folder: Path) -> Any:
    """Runs a script in a process of its own; returns the JSON of its last line."""
    done = live.run(["-c", textwrap.dedent(script)], folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_command_drives_a_scenario_and_says_what_happened(scenario: Path, live: Forks) -> None:
    command = ["-m", "cfx", "drive", "motorway.sumocfg", "--drivers", "calm=calm", "hasty=hasty"]
    command += ["--seed", "7", "--output", "out/drives.csv", "--", "--collision.action", "warn"]
    done = live.run(command, scenario)
    assert done.returncode == 0, done.stderr
    table = {
        line.split()[0]: line.split()
        for line in reversed(done.stdout.splitlines())
        if line.strip().startswith(("calm", "hasty"))
    }
    assert int(table["calm"][1]) > 15
    assert int(table["hasty"][1]) > 12
    assert "300 steps of 0.1 s in" in done.stdout
    assert "times real time" in done.stdout
    with (scenario / "out" / "drives.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["type"] for row in rows} == {"calm", "hasty"}
    assert len({row["vehicle"] for row in rows if row["type"] == "calm"}) == int(table["calm"][1])
    driven = [row for row in rows if row["parameter_cc1"]]
    assert {row["type"] for row in driven} == {"hasty"}
    assert all(0.1 <= float(row["parameter_cc1"]) <= 6 for row in driven)
    assert len({row["parameter_cc1"] for row in driven}) > 100, "parameters change while they drive"
    assert any(row["type"] == "calm" and row["parameter_t_r"] for row in rows)
    assert not [row for row in rows if row["type"] == "calm" and row["parameter_cc1"]]


def test_what_cannot_be_driven_is_one_sentence_and_leaves_no_file(
    scenario: Path, live: Forks
) -> None:
    said = python(
        live,
        """
        import sys
        sys.modules["pyarrow"] = None
        import json
        from pathlib import Path
        from cfx.errors import CfxError
        from cfx_sumo.drive.run import run_scenario
        said = []
        for name, kinds in (("motorway", ["clam"]), ("motorway", ["calm", "ghost"]),
                            ("slow", ["calm"]), ("lost", ["calm"]),
                            ("torn", ["calm"])):
            try:
                runs = {kind: "calm" for kind in kinds}
                run_scenario(Path(name + ".sumocfg"), runs, output=Path("never.csv"), end=2.0)
            except CfxError as error:
                said.append(str(error))
        # And the process still drives afterwards.
        driven = run_scenario(Path("motorway.sumocfg"), {"calm": "calm"}, end=2.0)
        print(json.dumps([said, driven.steps, "pyarrow.lib" in sys.modules]))
        """,
        scenario,
    )
    (unknown, never, step, edge, torn), steps, pyarrow = said
    assert "has no vType 'clam'. Did you mean 'calm'? It has: calm, ghost, hasty, other" in unknown
    assert never.startswith(
        "no vehicle of vType 'ghost' was ever on the road in motorway.sumocfg (2 s)"
    )
    assert "the simulation steps by 2 s; the policy of calm drives in steps of 0.01 to 1 s" in step
    assert edge.startswith(
        "SUMO refuses lost.sumocfg: The edge '9999' within the route 'whole' is not known"
    )
    assert torn.startswith("SUMO refuses torn.sumocfg: ")
    assert not any("\n" in one for one in said[0])
    assert steps == 20
    assert not pyarrow, "libsumo does not get on with it"
    assert not list(scenario.glob("*never*"))


def test_mistakes_are_reported_before_sumo_starts(
    scenario: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scenario)
    monkeypatch.setitem(
        sys.modules, "pyarrow", sys.modules.get("pyarrow")
    )  # the command does without it, later tests do not
    with pytest.raises(ConfigError, match=r"--drivers calm: write TYPE=RUN"):
        parse_drivers(["calm"])
    with pytest.raises(ConfigError, match="'calm' stands twice"):
        parse_drivers(["calm=a", "calm=b"])
    assert parse_drivers(["a=b=c"]) == {"a": "b=c"}
    handlers = list(logging.getLogger("cfx").handlers)
    for step in ("-1", "2", "nan"):
        assert main(["drive", "--step", step]) == 2
        assert capsys.readouterr().err == f"--step {step}: give 0.01 to 1 s\n"
    assert main(["drive", "nowhere.sumocfg", "--drivers", "calm=calm"]) == 2
    assert "nowhere.sumocfg is not there" in capsys.readouterr().err
    with monkeypatch.context() as without:
        without.setattr("importlib.metadata.version", _not_found)
        assert main(["drive", "motorway.sumocfg", "--drivers", "calm=calm"]) == 2
    assert install_line("cfx-sumo") in capsys.readouterr().err
    assert logging.getLogger("cfx").handlers == handlers, "nothing is left behind"


def _not_found(name: str) -> str:
    from importlib.metadata import PackageNotFoundError

    raise PackageNotFoundError(name)


def test_a_distribution_is_driven_and_far_positions_are_exact(scenario: Path, live: Forks) -> None:
    """And a simulation that the caller has open is left alone, as is the environment."""
    demand = DEMAND.replace(
        "</routes>",
        """<vTypeDistribution id="mixed" vTypes="calm hasty"/>
        <include href="own.add.xml"/>
        <flow id="d" type="own" route="whole" begin="0" end="20" vehsPerHour="900"/></routes>""",
    )
    (scenario / "mixed.rou.xml").write_text(demand)
    (scenario / "own.add.xml").write_text(
        '<additional><vTypeDistribution id="own"><vType id="own1"/><vType id="own2"/>'
        "</vTypeDistribution></additional>"
    )
    text = (scenario / "motorway.sumocfg").read_text()
    (scenario / "mixed.sumocfg").write_text(
        text.replace(str(scenario / "demand.rou.xml"), "mixed.rou.xml")
    )
    found = python(
        live,
        """
        import sys
        sys.modules["pyarrow"] = None
        import csv, json, os
        from pathlib import Path
        from cfx.errors import CfxError
        from cfx_sumo.drive.run import run_scenario
        mixed = Path("mixed.sumocfg")
        runs = {"mixed": "calm", "own": "hasty"}
        run = run_scenario(mixed, runs, end=15.0, output=Path("rows.csv"))
        counts = {name: len(tally.vehicles) for name, tally in run.tallies.items()}
        said = []
        try:
            run_scenario(mixed, {"mixed": "calm", "hasty": "calm"}, end=15.0)
        except CfxError as error:
            said.append(str(error))
        environment = dict(os.environ)
        os.environ["LIBSUMO_AS_TRACI"] = "quiet"
        import libsumo
        del os.environ["LIBSUMO_AS_TRACI"]
        libsumo.start(["sumo", "-c", "motorway.sumocfg", "--no-step-log"])
        libsumo.simulationStep()
        try:
            run_scenario(mixed, runs, end=15.0)
        except CfxError as error:
            said.append(str(error))
        libsumo.simulationStep()
        now = libsumo.simulation.getTime()
        libsumo.close()
        same = environment == dict(os.environ)
        with open("rows.csv") as file:
            rows = list(csv.DictReader(file))
        print(json.dumps([counts, said, now, same, rows]))
        """,
        scenario,
    )
    counts, said, now, same, rows = found
    assert counts["mixed"] > 20
    assert counts["own"] > 2
    assert {row["type"] for row in rows} == {"mixed", "own"}
    assert "vType 'hasty' is a member of the vTypeDistribution 'mixed', and --drivers" in said[0]
    assert said[1].startswith("a simulation is open in this process, and libsumo has room for one")
    assert now == pytest.approx(0.2), "and goes on"
    assert same
    digits = [len(row["x_m"].partition(".")[2]) for row in rows]
    assert max(digits) == 6


def test_a_vehicle_that_collides_teleports_or_changes_lanes_is_counted_and_ends_nothing(
    scenario: Path, live: Forks
) -> None:
    """One drives into a car that stands, one is told to change lanes."""
    counts = python(
        live,
        """
        import sys
        sys.modules["pyarrow"] = None
        import json, os
        os.environ["LIBSUMO_AS_TRACI"] = "quiet"
        import libsumo
        from pathlib import Path
        from cfx_sumo.drive.run import _Run
        from cfx_sumo.live.driver import Driver
        from cfx_sumo.live.fleet import Fleet
        Path("crash.rou.xml").write_text('''<routes><vType id="calm"/>
          <route id="m" edges="1001 1002 1003"/>
          <vehicle id="wall" type="DEFAULT_VEHTYPE" route="m" depart="0" departPos="200"
            departSpeed="0" departLane="2">
            <stop lane="1001_2" endPos="201" duration="100"/></vehicle>
          <vehicle id="blind" type="calm" route="m" depart="0" departPos="150" departSpeed="25"
            departLane="2"
            insertionChecks="none"/>
          <vehicle id="mover" type="calm" route="m" depart="0" departPos="100"
            departSpeed="10" departLane="4"/></routes>''')
        from cfx_sumo.demo.motorway import SHIPPED
        files = ["-n", str(SHIPPED), "-r", "crash.rou.xml"]
        options = ["--step-length", "0.1", "--no-step-log", "--collision.action", "teleport"]
        libsumo.start(["sumo", *files, *options])
        fleet = Fleet({"calm": Driver.load("calm")})
        run = _Run(libsumo, fleet, Path("crash"), None)
        step = fleet.step
        def careless(connection):
            step(connection)
            present = connection.vehicle.getIDList()
            if "blind" in present and connection.simulation.getTime() < 5:
                connection.vehicle.setSpeed("blind", 25)
                connection.vehicle.setSpeedMode("blind", 0)
                connection.vehicle.setLaneChangeMode("blind", 0)
            if connection.simulation.getTime() == 1.0:
                connection.vehicle.changeLane("mover", 5, 10)
        fleet.step = careless
        driven = run.go(12.0)
        tally = driven.tallies["calm"]
        counts = [tally.collisions + tally.below_min_gap, tally.teleports, tally.lane_changes, driven.steps]
        print(json.dumps([sorted(tally.vehicles), *counts]))
        """,
        scenario,
    )
    vehicles, collided, teleports, lane_changes, steps = counts
    assert vehicles == ["blind", "mover"]
    assert collided == 1, "once, with contact or below minGap"
    assert teleports == 1
    assert lane_changes >= 1
    assert steps == 120


def test_collisions_at_junctions_are_looked_for_unless_the_user_says_otherwise() -> None:
    line = command_line(Path("town.sumocfg"))
    assert line[line.index("--collision.check-junctions") + 1] == "true"
    for own in (["--collision.check-junctions", "false"], ["--collision.check-junctions=false"]):
        assert command_line(Path("town.sumocfg"), own) == [*line[:-2], *own]


RUNS_RED_LIGHTS = """
import sys
sys.modules["pyarrow"] = None
import json
from pathlib import Path
from cfx_sumo.drive.run import run_scenario
Path("cross.rou.xml").write_text('''<routes><vType id="car" sigma="0" speedDev="0"/>
  <flow id="east" type="car" from="left0A0" to="C0right0" begin="0" end="60" period="3"/>
  <flow id="north" type="car" from="bottom0A0" to="A2top0" begin="0" end="60" period="3.5"/>
  </routes>''')
from cfx_sumo.drive.scenarios import SCENARIOS
town = SCENARIOS["town"].network
Path("cross.sumocfg").write_text(f'''<configuration><input><net-file value="{town}"/>
  <route-files value="cross.rou.xml"/></input><processing><collision.action value="warn"/>
  </processing></configuration>''')
run = run_scenario(Path("cross.sumocfg"), {"car": "cfx://idm"}, end=60, step=0.5, speed_mode=0)
print(json.dumps([run.tallies["car"].crossings, run.collisions_of_sumo]))
"""


def test_crossing_paths_are_counted_beside_those_of_sumo_alone(tmp_path: Path, live: Forks) -> None:
    """Drivers without SUMO's checks run red lights; SUMO's own do not."""
    crossings, of_sumo = python(live, RUNS_RED_LIGHTS, tmp_path)
    assert crossings > 0
    assert of_sumo == [0, 0]


SHORT_EDGE = """
import sys
sys.modules["pyarrow"] = None
import json
from pathlib import Path
from cfx_sumo.drive.run import run_scenario
from cfx_sumo.simulation.network import network
Path("short.net.xml").write_text(network(1, 1, length=0.1, speed=10.0, apart=10.0))
Path("short.rou.xml").write_text('''<routes><vType id="car" length="4.5" minGap="2.5" sigma="0"/>
  <route id="r" edges="road0"/>
  <vehicle id="a" type="car" route="r" depart="0"><stop lane="road0_0" endPos="0.1" duration="60"/>
  </vehicle><vehicle id="b" type="car" route="r" depart="2"/></routes>''')
Path("short.sumocfg").write_text('''<configuration><input><net-file value="short.net.xml"/>
  <route-files value="short.rou.xml"/></input><processing><collision.action value="warn"/>
  </processing></configuration>''')
run = run_scenario(Path("short.sumocfg"), {"car": "cfx://idm"}, end=6, step=0.5)
print(json.dumps([[str(one) for one in run.collisions], run.collisions_of_sumo]))
"""


def test_who_was_inserted_onto_another_is_said(tmp_path: Path, live: Forks) -> None:
    """SUMO inserts vehicles where the edge is shorter than they are, with any driver."""
    collisions, of_sumo = python(live, SHORT_EDGE, tmp_path)
    assert len(collisions) == 1
    assert "b behind a on road0_0" in collisions[0]
    assert "where SUMO has just inserted it: contact, gap -" in collisions[0]
    assert of_sumo == [1, 0]


OUT_OF_ORDER = f"""
import sys
sys.modules["pyarrow"] = None
import json
from pathlib import Path
from cfx.errors import SumoError
from cfx_sumo.drive.run import run_scenario
Path("late.rou.xml").write_text('''<routes><vType id="car"/> <vType id="bus"/>
  <vType id="tram" vClass="tram"/> <route id="m" edges="1001 1002 1003"/>
  <vehicle id="first" type="car" route="m" depart="1"/>
  <vehicle id="railless" type="tram" route="m" depart="1"/>
  <flow id="early" type="bus" route="m" begin="0" end="9" period="3"/></routes>''')
Path("late.sumocfg").write_text('''<configuration><input><net-file value="{SHIPPED}"/>
  <route-files value="late.rou.xml"/></input><processing><ignore-route-errors value="true"/>
  </processing></configuration>''')
run = run_scenario(Path("late.sumocfg"), {{"car": "cfx://idm"}}, end=2.0)
try:
    run_scenario(Path("late.sumocfg"), {{"bus": "cfx://idm"}}, end=2.0,
                 sumo_options=["--error-log", "own.txt"])
except SumoError as error:
    print(json.dumps([run.left_out, str(error), Path("own.txt").is_file()]))
"""


def test_what_sumo_leaves_out_of_a_scenario_is_said(tmp_path: Path, live: Forks) -> None:
    """Also where the user has SUMO's warnings in a file of their own."""
    sentences, error, is_kept = python(live, OUT_OF_ORDER, tmp_path)
    assert "Route file should be sorted by departure time, ignoring 'early'!" in sentences
    assert any("'railless' is not allowed to depart" in sentence for sentence in sentences)
    assert "no vehicle of vType 'bus' was ever on the road" in error
    assert f"SUMO left out {len(sentences)} of the scenario's vehicles" in error
    assert is_kept


def test_the_table_says_it_all(capsys: pytest.CaptureFixture[str]) -> None:
    tally = Tally(
        {"a", "b"},
        steps=200,
        behind=150,
        metres=240.0,
        lane_changes=3,
        hard_brakings=2,
        hardest_braking=6.25,
        collisions=1,
        below_min_gap=8,
        crossings=5,
        teleports=4,
    )
    tally.braking.add([0.0] * 189 + [0.49] * 10 + [4.99])
    tally.speeds.add([10.05] * 20 + [12.05] * 160 + [14.05] * 20)
    recorded = dict.fromkeys(("speed", "acceleration", "time_gap"), (1.0, 2.0, 3.0))
    run = ScenarioRun(
        {"calm": tally},
        steps=100,
        dt=0.1,
        seconds=2.0,
        others=5,
        most=2,
        limited={"calm": 0.25},
        changed={"calm": 0.5},
        outside={"calm": "3 % of steps outside what the policy has learned (speed above 18 m/s)"},
        recorded={"calm": recorded},
        expected={"calm": "RMSE of speed below 1.20 m/s"},
        collisions=[
            Collision(3.1, "calm", "a", "b", "road_0", 51.26, -0.2),
            Collision(4.0, "calm", "b", "x", "road_0", 80.0, 2.391),
            Collision(4.5, "calm", "a", "y", ":n_0", 3.0, None, crossing=True),
        ],
        collisions_of_sumo=CollisionCounts(behind=0, crossing=6),
        left_out=[f"ignoring 'flow{number}'!" for number in range(12)],
    )
    report(run)
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines() if "calm" in line]
    assert rows[0] == ["calm", "2", "75%", "12.00", "3", "1", "8", "5", "4"]
    assert rows[1] == ["calm", "0.49", "4.99", "6.25", "2", "25.0%", "50.0%"]
    assert rows[2] == ["calm", "10.05,", "12.05,", "14.05", *["nan,", "nan,", "nan"] * 2]
    assert rows[3][0] == "calm:"
    assert "3.10 s: a behind b on road_0 at 51.3 m: contact, gap -0.20 m" in out
    assert "4.00 s: b behind x on road_0 at 80.0 m: below minGap, gap 2.39 m" in out
    assert "4.50 s: a and y, whose paths cross, on :n_0 at 3.0 m" in out
    assert "left out by SUMO: ignoring 'flow9'!\n... and 2 more vehicles and flows left out" in out
    assert "Collisions: 1 with the vehicle ahead, 5 where paths cross; where SUMO's own" in out
    assert "in the same scenario: 0 with the vehicle ahead, 6 where paths cross" in out
    assert "calm: RMSE of speed below 1.20 m/s" in out
    assert "calm: 3 % of steps outside what the policy has learned (speed above 18 m/s)" in out
    assert next(line.split() for line in out.splitlines() if "its recording" in line)[2:5] == [
        "1.00,",
        "2.00,",
        "3.00",
    ]
    assert (
        "100 steps of 0.1 s in 2.0 s, 5.0 times real time; at most 2 of these vehicles at once, 5"
        " others" in out
    )
