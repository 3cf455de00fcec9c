"""A co-simulation of OSI messages: a driver's unit behind a recorded leader, on a straight road.

python follow.py driver.osmp.fmu pairs.csv > ego.csv

pairs.csv has cfx's tidy layout: time_s, leader_speed_mps, follower_speed_mps and gap_m, or in place
of the gap leader_position_m, leader_length_m and follower_position_m. FMPy loads the unit, OSI's
Python package makes the messages; this program is the simulator: it moves the leader, tells of both
vehicles, and puts the ego vehicle where the unit says.
"""

import csv
import ctypes
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import fmpy
from fmpy.fmi2 import FMU2Slave
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_object_pb2 import MovingObject
from osi3.osi_sensorview_pb2 import SensorView
from osi3.osi_trafficupdate_pb2 import TrafficUpdate

EGO, LEADER = 1, 2
LENGTH, WIDTH = 5.0, 1.8


class Participant:
    """A traffic participant: a unit that takes a scene and gives an update."""

    def __init__(self, path: str, folder: str, **parameters: int) -> None:
        description = fmpy.read_model_description(path)
        self.references = {one.name: one.valueReference for one in description.modelVariables}
        self.unit = FMU2Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(path, folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="ego",
        )
        self.unit.instantiate()
        self.unit.setupExperiment()
        self.unit.enterInitializationMode()
        for name, value in parameters.items():
            self.unit.setInteger([self.references[name]], [value])
        self.unit.exitInitializationMode()

    def step(self, view: SensorView, time: float, dt: float) -> TrafficUpdate:
        """Returns what becomes of the vehicle in a step, in which the unit sees the scene."""
        message = view.SerializeToString()
        buffer = ctypes.create_string_buffer(message, len(message))
        address = ctypes.addressof(buffer)
        halves = [ctypes.c_int32(address & 0xFFFFFFFF).value, ctypes.c_int32(address >> 32).value]
        self.unit.setInteger(self._of("OSMPSensorViewIn"), [*halves, len(message)])
        self.unit.doStep(time, dt)
        low, high, size = self.unit.getInteger(self._of("OSMPTrafficUpdateOut"))
        address = (high & 0xFFFFFFFF) << 32 | (low & 0xFFFFFFFF)
        return TrafficUpdate.FromString(ctypes.string_at(address, size) if size else b"")

    def close(self) -> None:
        self.unit.terminate()
        self.unit.freeInstance()

    def _of(self, name: str) -> list[int]:
        return [self.references[f"{name}.{part}"] for part in ("base.lo", "base.hi", "size")]


def add_vehicle(truth: GroundTruth, number: int, x: float, speed: float) -> MovingObject:
    """Adds a vehicle on the road along x, and returns it."""
    vehicle = truth.moving_object.add(type=MovingObject.TYPE_VEHICLE)
    vehicle.id.value = number
    base = vehicle.base
    base.dimension.length, base.dimension.width, base.dimension.height = LENGTH, WIDTH, 1.5
    base.position.x, base.position.y, base.position.z = x, 0.0, 0.75
    base.orientation.yaw = 0.0
    base.velocity.x, base.velocity.y = speed, 0.0
    return vehicle


def follow(
    path: str, time: Sequence[float], leader_speed: Sequence[float], speed: float, gap: float
) -> Iterator[tuple[float, float, float, float]]:
    """Yields time, speed of the leader and of the ego vehicle, and the gap, frame by frame."""
    with tempfile.TemporaryDirectory() as folder:
        driver = Participant(path, folder)
        x, ahead = 0.0, gap + LENGTH
        for number, now in enumerate(time):
            yield now, leader_speed[number], speed, ahead - x - LENGTH
            if number + 1 == len(time):
                break
            dt = time[number + 1] - now
            view = SensorView()
            view.timestamp.seconds, nanos = divmod(round(now * 1e9), 10**9)
            view.timestamp.nanos = nanos
            view.host_vehicle_id.value = EGO
            add_vehicle(view.global_ground_truth, EGO, x, speed)
            add_vehicle(view.global_ground_truth, LEADER, ahead, leader_speed[number])
            ego = driver.step(view, now, dt).update[0].base
            x, speed = ego.position.x, ego.velocity.x
            ahead += leader_speed[number + 1] * dt
        driver.close()


def gap_of(row: dict[str, str]) -> float:
    """Returns the gap of a row of the table, bumper to bumper, m."""
    if "gap_m" in row:
        return float(row["gap_m"])
    rear = float(row["leader_position_m"]) - float(row["leader_length_m"])
    return rear - float(row["follower_position_m"])


def main() -> None:
    """Prints the drive behind the first pair's leader."""
    with Path(sys.argv[2]).open(newline="") as file:
        rows = list(csv.DictReader(file))
    pair = rows[0].get("pair_id")
    rows = [row for row in rows if row.get("pair_id") == pair]
    time = [float(row["time_s"]) for row in rows]
    leader_speed = [float(row["leader_speed_mps"]) for row in rows]
    start = float(rows[0]["follower_speed_mps"]), gap_of(rows[0])
    print("time_s", "leader_speed_mps", "ego_speed_mps", "gap_m", sep=",")
    for frame in follow(sys.argv[1], time, leader_speed, *start):
        print(*(f"{value:.6f}" for value in frame), sep=",")


if __name__ == "__main__":
    main()
