"""An OSMP unit keeps to FMI 2.0 and OSMP, sees what a scene of OSI has, and drives as cfx does."""

from __future__ import annotations

import importlib.util
import math
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch

from cfx.app.cli import main
from cfx.policies.checkpoint import save_agent
from cfx.policies.driver_step import DriverStep, Motion
from cfx_drivers.osmp.description import OSI_VERSION
from tests.agents import adaptive
from tests.further import known_inputs

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install fmpy")
osi3 = pytest.importorskip("osi3", reason="needs OSI's messages: pip install osi-python")
validation = pytest.importorskip("fmpy.validation")
if shutil.which("cc") is None:
    pytest.skip("needs a C compiler", allow_module_level=True)

from osi3.osi_lane_pb2 import Lane  # noqa: E402
from osi3.osi_sensorview_pb2 import SensorView  # noqa: E402
from osi3.osi_trafficupdate_pb2 import TrafficUpdate  # noqa: E402

PLUGIN = Path(__file__).parents[1]


def _example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("follow", PLUGIN / "examples/osmp/follow.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


follow = _example()


def export(folder: Path, **options: bool) -> str:
    """Returns the unit of a driver of IDM."""
    save_agent(adaptive({"name": "idm"}, **options), folder / "policy")
    assert main(["export", str(folder), "--to", "osmp"]) == 0
    return str(folder / "driver.osmp.fmu")


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> str:
    return export(tmp_path_factory.mktemp("unit") / "job")


@pytest.fixture
def make(unit: str, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    made: list[Any] = []

    def of(source: str = unit, **parameters: int) -> Any:
        made.append(follow.Participant(source, str(tmp_path / f"{len(made)}"), **parameters))
        return made[-1]

    yield of
    for one in made:
        one.close()


def scene(*ahead: tuple[float, float], speed: float = 10.0, y: float = 0.0) -> SensorView:
    """Returns a scene of an ego vehicle at 0, and others at x with a speed, in a row at y."""
    view = SensorView()
    view.host_vehicle_id.value = follow.EGO
    truth = view.global_ground_truth
    follow.add_vehicle(truth, follow.EGO, 0.0, speed).base.acceleration.x = 0.0
    for number, (x, leader_speed) in enumerate(ahead, follow.LEADER):
        vehicle = follow.add_vehicle(truth, number, x, leader_speed)
        vehicle.base.acceleration.x = 0.0
        vehicle.base.position.y = y
    return view


def ego_after(participant: Any, view: SensorView, dt: float = 0.1) -> Any:
    """Returns the ego vehicle after a step."""
    (update,) = participant.step(view, 0.0, dt).update
    return update


def speed_after(make: Callable[..., Any], view: SensorView) -> float:
    """Returns the speed of a driver who begins, after their first step."""
    return float(ego_after(make(), view).base.velocity.x)


def test_it_keeps_to_fmi_2_and_osmp(unit: str) -> None:
    assert validation.validate_fmu(unit) == []
    description = fmpy.read_model_description(unit)
    assert description.fmiVersion == "2.0"
    assert description.coSimulation.canGetAndSetFMUstate
    assert description.variableNamingConvention == "structured"
    names = {one.name: (one.causality, one.variability) for one in description.modelVariables}
    for part in ("base.lo", "base.hi", "size"):
        assert names[f"OSMPSensorViewIn.{part}"] == ("input", "discrete")
        assert names[f"OSMPTrafficUpdateOut.{part}"] == ("output", "discrete")
    with zipfile.ZipFile(unit) as archive:
        contents = archive.namelist()
        root = ET.fromstring(archive.read("modelDescription.xml"))  # noqa: S314  # our own
    space = "{http://xsd.pmsf.net/OSISensorModelPackaging}"
    (about,) = root.iter(f"{space}osmp")
    assert about.attrib == {"version": "1.6.0", "osi-version": OSI_VERSION}
    kinds = {
        one.get("name"): one.get("mime-type") for one in root.iter(f"{space}osmp-binary-variable")
    }
    start = "application/x-open-simulation-interface; type="
    assert kinds["OSMPSensorViewIn"] == f"{start}SensorView; version={OSI_VERSION}"
    assert kinds["OSMPTrafficUpdateOut"] == f"{start}TrafficUpdate; version={OSI_VERSION}"
    assert not [name for name in contents if name.endswith((".py", ".onnx"))]
    assert "documentation/licenses/nanopb.txt" in contents


def test_our_messages_are_part_of_osi() -> None:
    """`osi.proto` has OSI's names, numbers and types; nanopb's tables have its numbers."""
    message, osi = "", {}
    for line in (PLUGIN / "cfx_drivers/osmp/osi.proto").read_text().splitlines():
        words = line.split("//")[0].replace(";", "").split()
        if words[:1] == ["message"]:
            message = f"{message}.{words[1]}".strip(".")
        elif words == ["}"]:
            message = message.rpartition(".")[0]
        elif words[:1] in (["optional"], ["repeated"]):
            osi[message, words[2]] = (words[0], words[1], int(words[4]))
    assert len(osi) > 40
    tags = (PLUGIN / "cfx_drivers/osmp/osi.pb.h").read_text()
    for (name, field), (label, kind, number) in osi.items():
        outer, *inner = name.split(".")
        descriptor = _osi_message(outer)
        for part in inner:
            descriptor = descriptor.nested_types_by_name[part]
        theirs = descriptor.fields_by_name[field]
        assert (theirs.number, theirs.is_repeated) == (number, label == "repeated"), field
        if theirs.message_type is not None:
            assert theirs.message_type.name == kind
        else:
            assert theirs.type == getattr(theirs, f"TYPE_{kind.upper()}")
        tag = f"#define osi3_{name.replace('.', '_')}_{field}_tag "
        assert tags.partition(tag)[2].split()[:1] == [str(number)]


def _osi_message(name: str) -> Any:
    pool = SensorView.DESCRIPTOR.file.pool
    TrafficUpdate.DESCRIPTOR.file  # noqa: B018  # has registered its messages
    return pool.FindMessageTypeByName(f"osi3.{name}")


def test_the_example_drives_as_cfx_does(unit: str) -> None:
    step = DriverStep(adaptive({"name": "idm"}))
    time = 0.1 * np.arange(80)
    leader = np.maximum(0.0, 8 + 6 * np.sin(0.8 * time))
    found = np.array(list(follow.follow(unit, time.tolist(), leader.tolist(), 9.0, 15.0)))
    state, speed, gap = step.begin(1), 9.0, 15.0
    acceleration = leader_acceleration = 0.0
    expected = []
    for number in range(len(time)):
        expected.append((speed, gap))
        if number + 1 == len(time):
            break
        values = (speed, acceleration, leader[number], leader_acceleration, gap)
        v, a, v_l, a_l, g = (torch.tensor([value], dtype=torch.float64) for value in values)
        after, state = step(state, Motion(v, a), Motion(v_l, a_l), g)
        acceleration = (float(after) - speed) / 0.1
        leader_acceleration = (leader[number + 1] - leader[number]) / 0.1
        speed = float(after)
        gap += (leader[number + 1] - speed) * 0.1
    assert np.ptp(found[:, 2]) > 3.0
    np.testing.assert_allclose(found[:, 2:], expected, atol=1e-4)


def test_the_update_is_the_vehicle_after_the_step(make: Callable[..., Any]) -> None:
    view = scene((30.0, 10.0))
    view.timestamp.seconds, view.timestamp.nanos = 2, 950_000_000
    ego = view.global_ground_truth.moving_object[0]
    ego.base.position.x, ego.base.position.y, ego.base.position.z = 3.0, 4.0, 5.0
    yaw = ego.base.orientation.yaw = 0.5
    ego.base.velocity.x, ego.base.velocity.y = 10 * math.cos(yaw), 10 * math.sin(yaw)
    update = make().step(view, 2.95, 0.1)
    version = update.version
    numbers = (version.version_major, version.version_minor, version.version_patch)
    assert ".".join(map(str, numbers)) == OSI_VERSION == osi3.__version__
    assert (update.timestamp.seconds, update.timestamp.nanos) == (3, 50_000_000)
    (moved,) = update.update
    speed = math.hypot(moved.base.velocity.x, moved.base.velocity.y)
    assert moved.id.value == follow.EGO
    assert moved.base.position.x == pytest.approx(3.0 + 0.1 * speed * math.cos(yaw))
    assert moved.base.position.y == pytest.approx(4.0 + 0.1 * speed * math.sin(yaw))
    assert moved.base.position.z == 5.0
    assert moved.base.orientation.yaw == pytest.approx(yaw)
    assert math.atan2(moved.base.velocity.y, moved.base.velocity.x) == pytest.approx(yaw)
    change = math.hypot(moved.base.acceleration.x, moved.base.acceleration.y)
    assert change == pytest.approx(abs(speed - 10.0) / 0.1)


def test_who_is_ahead_in_the_way_counts(make: Callable[..., Any]) -> None:
    near, free = speed_after(make, scene((12.0, 4.0))), speed_after(make, scene())
    assert near < free - 0.1
    assert speed_after(make, scene((12.0, 4.0), (40.0, 20.0))) == near
    assert speed_after(make, scene((-12.0, 4.0))) == free
    assert speed_after(make, scene((12.0, 4.0), y=3.5)) == free
    assert speed_after(make, scene((12.0, 4.0), y=1.5)) == near  # half in the lane
    across = scene((12.0, 4.0), y=3.3)
    across.global_ground_truth.moving_object[1].base.orientation.yaw = math.pi / 2
    assert speed_after(make, across) < free - 0.1  # 5 m long, so 2.5 m of it reach the lane


def lane(view: SensorView, number: int, line: list[tuple[float, float]], *after: int) -> Lane:
    """Adds a lane, which goes on in those after it."""
    made = view.global_ground_truth.lane.add()
    made.id.value = number
    made.classification.type = Lane.Classification.TYPE_DRIVING
    made.classification.centerline_is_driving_direction = True
    for x, y in line:
        made.classification.centerline.add(x=x, y=y)
    for follower in after:
        made.classification.lane_pairing.add().successor_lane_id.value = follower
    return made


def assign(view: SensorView, *lanes: int) -> SensorView:
    """Assigns a lane to each vehicle."""
    for vehicle, number in zip(view.global_ground_truth.moving_object, lanes, strict=True):
        vehicle.moving_object_classification.assigned_lane_id.add().value = number
    return view


def test_lanes_say_who_is_in_the_way(make: Callable[..., Any]) -> None:
    near, free = speed_after(make, scene((12.0, 4.0))), speed_after(make, scene())
    beside = assign(scene((12.0, 4.0), y=1.5), 7, 8)  # overlaps, but is in another lane
    lane(beside, 7, [(-50.0, 0.0), (100.0, 0.0)])
    assert speed_after(make, beside) == free
    same = assign(scene((12.0, 4.0), y=2.5), 7, 7)  # no overlap, but the same lane
    assert speed_after(make, same) == near
    early = assign(scene((12.0, 4.0), y=2.5), 7, 8)  # on two lanes: is coming in
    early.global_ground_truth.moving_object[1].assigned_lane_id.add().value = 7
    assert speed_after(make, early) == near
    next_one = assign(scene((12.0, 4.0), y=2.5), 7, 9)
    lane(next_one, 7, [(-50.0, 0.0), (5.0, 0.0)], 8, 9)
    lane(next_one, 8, [(5.0, 0.0), (5.0, 50.0)])  # turns off
    lane(next_one, 9, [(60.0, 0.0), (5.0, 0.0)])  # goes on, drawn the other way
    assert speed_after(make, next_one) == near
    crossing = assign(scene((12.0, 4.0), y=6.0), 7, 7)  # both are in one intersection
    lane(crossing, 7, []).classification.type = Lane.Classification.TYPE_INTERSECTION
    assert speed_after(make, crossing) == free


def arc(radius: float, *degrees: float) -> list[tuple[float, float]]:
    """Returns points of a left turn about (0, radius) that begins at the origin."""
    angles = np.radians(degrees)
    return [(radius * math.sin(a), radius * (1 - math.cos(a))) for a in angles]


def test_it_follows_a_bend_and_measures_the_gap_along_it(make: Callable[..., Any]) -> None:
    radius = 50.0
    line = arc(radius, *range(-20, 91))
    straight = ego_after(make(), scene((25.0, 6.0)))
    view = assign(scene((0.0, 0.0)), 7, 7)
    lane(view, 7, line[::-1])  # drawn against the direction that the ego vehicle heads in
    other = view.global_ground_truth.moving_object[1].base
    angle = 25.0 / radius
    other.position.x, other.position.y = arc(radius, math.degrees(angle))[0]
    other.orientation.yaw = angle
    other.velocity.x, other.velocity.y = 6.0 * math.cos(angle), 6.0 * math.sin(angle)
    turned = ego_after(make(), view, 0.1)
    speed = math.hypot(turned.base.velocity.x, turned.base.velocity.y)
    assert speed == pytest.approx(straight.base.velocity.x, abs=2e-3)
    x = y = yaw = 0.0
    driver = make()
    for number in range(50):
        ego = view.global_ground_truth.moving_object[0].base
        ego.position.x, ego.position.y, ego.orientation.yaw = x, y, yaw
        ego.velocity.x, ego.velocity.y = 8.0 * math.cos(yaw), 8.0 * math.sin(yaw)
        moved = driver.step(view, 0.1 * number, 0.1).update[0].base
        x, y, yaw = moved.position.x, moved.position.y, moved.orientation.yaw
    assert yaw > 0.5
    assert math.hypot(x, y - radius) == pytest.approx(radius, abs=0.05)
    assert yaw == pytest.approx(math.atan2(x, radius - y), abs=math.radians(1.0))


def test_lanes_may_come_once_before_it_starts(unit: str, tmp_path: Path) -> None:
    view = assign(scene((12.0, 4.0), y=2.5), 7, 9)
    lane(view, 7, [(-50.0, 0.0), (5.0, 0.0)], 9)
    lane(view, 9, [(5.0, 0.0), (60.0, 0.0)])
    truth = view.global_ground_truth.SerializeToString()
    buffer = follow.ctypes.create_string_buffer(truth, len(truth))
    address = follow.ctypes.addressof(buffer)
    low, high = (
        follow.ctypes.c_int32(part).value for part in (address & 0xFFFFFFFF, address >> 32)
    )
    place = {"base.lo": low, "base.hi": high, "size": len(truth)}
    given = {f"OSMPGroundTruthInit.{part}": value for part, value in place.items()}
    with_map = follow.Participant(unit, str(tmp_path / "map"), **given)
    without = follow.Participant(unit, str(tmp_path / "none"))
    full = follow.Participant(unit, str(tmp_path / "full"))
    expected = ego_after(full, view).base.velocity.x
    del view.global_ground_truth.lane[:]
    assert ego_after(with_map, view).base.velocity.x == expected
    assert ego_after(without, view).base.velocity.x > expected + 0.1
    for one in (with_map, without, full):
        one.close()


# The example gives no accelerations, so that the leader's is that of the step before.
@pytest.mark.parametrize(
    ("step", "tolerance"), [(0.01, 0.05), (0.05, 0.05), (0.5, 0.3), (1.0, 0.6)]
)
def test_steps_of_other_lengths_drive_alike(unit: str, step: float, tolerance: float) -> None:
    speeds = []
    for dt in (0.1, step):
        time = dt * np.arange(round(20 / dt) + 1)
        leader = 10 + 2 * np.sin(time)
        frames = list(follow.follow(unit, time.tolist(), leader.tolist(), 10.0, 20.0))
        speeds.append([frame[2] for frame in frames[:: round(1 / dt)]])
    assert np.ptp(speeds[0]) > 1.0
    np.testing.assert_allclose(speeds[1], speeds[0], atol=tolerance)


def speeds_after(driver: Any, leader_speeds: list[float]) -> list[float]:
    """Returns the speeds of a driver behind a leader whose speed changes."""
    speeds = []
    for speed in leader_speeds:
        speeds.append(float(ego_after(driver, scene((25.0, speed))).base.velocity.x))
    return speeds


LEADER_SPEEDS = [8 + 3 * math.sin(number) for number in range(8)]


def test_a_state_is_gone_back_to(make: Callable[..., Any]) -> None:
    driver = make()
    speeds_after(driver, LEADER_SPEEDS[:4])
    state = driver.unit.getFMUState()
    first = speeds_after(driver, LEADER_SPEEDS[4:])
    assert speeds_after(driver, LEADER_SPEEDS[4:]) != first
    again = driver.unit.deserializeFMUState(driver.unit.serializeFMUState(state))
    driver.unit.setFMUState(again)
    assert speeds_after(driver, LEADER_SPEEDS[4:]) == first
    driver.unit.freeFMUState(state)
    driver.unit.freeFMUState(again)


@pytest.mark.slow
def test_a_seed_says_what_is_left_to_chance(make: Callable[..., Any], tmp_path: Path) -> None:
    unit = export(tmp_path / "job", stochastic=True)
    assert validation.validate_fmu(unit) == []
    first, again, other = (speeds_after(make(unit, seed=seed), LEADER_SPEEDS) for seed in (1, 1, 2))
    assert first == again
    assert np.abs(np.subtract(first, other)).max() > 1e-3


def test_another_vehicle_than_the_host_is_driven(make: Callable[..., Any]) -> None:
    view = scene((12.0, 4.0), (40.0, 20.0))
    assert ego_after(make(vehicle_id=3), view).id.value == 3
    view.ClearField("host_vehicle_id")
    view.global_ground_truth.host_vehicle_id.value = 2
    assert ego_after(make(), view).id.value == 2


def test_no_scene_is_no_update(make: Callable[..., Any]) -> None:
    driver = make()
    driver.unit.doStep(0.0, 0.1)
    references = [driver.references[f"OSMPTrafficUpdateOut.{part}"] for part in ("base.lo", "size")]
    assert driver.unit.getInteger(references) == [0, 0]


def no_host(view: SensorView) -> bytes:
    view.ClearField("host_vehicle_id")
    return view.SerializeToString()


def other_host(view: SensorView) -> bytes:
    view.host_vehicle_id.value = 9
    return view.SerializeToString()


def no_velocity(view: SensorView) -> bytes:
    view.global_ground_truth.moving_object[1].base.ClearField("velocity")
    return view.SerializeToString()


def no_number(view: SensorView) -> bytes:
    view.global_ground_truth.moving_object[1].base.position.x = math.nan
    return view.SerializeToString()


@pytest.mark.parametrize(
    ("change", "status", "sentence"),
    [
        (no_host, 3, "the sensor view names no host vehicle; set its host_vehicle_id"),
        (other_host, 3, "vehicle 9, which is driven, is not among the 2 moving objects"),
        (no_velocity, 3, "moving object 2 has no velocity"),
        (no_number, 2, "a number of moving object 2 is none"),
        (lambda view: view.SerializeToString()[:-5], 3, "are no osi3::SensorView ("),
    ],
)
def test_a_scene_that_cannot_be_used_is_said(
    make: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    change: Callable[[SensorView], bytes],
    status: int,
    sentence: str,
) -> None:
    driver, view = make(), scene((12.0, 4.0))
    good = view.SerializeToString()

    class Message:
        """Stands for a view."""

        def SerializeToString(self) -> bytes:  # noqa: N802  # protobuf's name
            return change(view)

    with pytest.raises(Exception, match=f"fmi2DoStep.*{status}"):
        driver.step(Message(), 0.0, 0.1)
    assert sentence in capsys.readouterr().out
    assert ego_after(driver, SensorView.FromString(good)).base.velocity.x == speed_after(
        make, SensorView.FromString(good)
    )


def test_a_policy_that_reads_more_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "job"
    with known_inputs():
        save_agent(adaptive({"name": "idm"}, further=("rain",)), folder / "policy")
        assert main(["export", str(folder), "--to", "osmp"]) == 2
    assert "which scenes of OSI do not have" in capsys.readouterr().err
