"""Values come by subscription over TraCI and by a compiled call in libsumo: those of its calls."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cfx.simulation.kernel.compiler import find_compiler
from tests.forks import Forks

pytest.importorskip("traci", reason="needs the extra sumo")

BOTH_WAYS = """
import sys
sys.modules["pyarrow"] = None
import json, os
from pathlib import Path
os.environ["LIBSUMO_AS_TRACI"] = "quiet"
import libsumo
import torch
from cfx.errors import SumoError
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.live.bridge import bridge_of
from cfx_sumo.live.surroundings import DirectReader, SubscribedReader, look, view_of
scenario = SCENARIOS["motorway"].write(Path("."))
libsumo.start(["sumo", "-c", str(scenario), "--no-step-log", "--no-warnings"])
found, compiled = [], None
for _ in range(300):
    libsumo.simulationStep()
    names = [name for name in libsumo.vehicle.getIDList() if name.startswith("car")]
    calls = view_of(DirectReader(libsumo.vehicle, 100.0), names, 100.0)
    sent = view_of(SubscribedReader(libsumo.vehicle, 100.0), names, 100.0)
    compiled = look(libsumo, names, 100.0, compiled)
    same = all(
        calls.arrangement.is_still(names, other.arrangement.read)
        and calls.arrangement[2:5] == other.arrangement[2:5]
        and torch.equal(calls.arrangement.rows, other.arrangement.rows)
        and torch.equal(torch.stack(list(calls.seen)), torch.stack(list(other.seen)))
        for other in (sent, compiled)
    )
    found.append([same, len(calls.following), len(calls.alone)])
said = []
vehicle = libsumo.vehicle
for reader in (DirectReader(vehicle, 100.0), SubscribedReader(vehicle, 100.0)):
    try:
        view_of(reader, ["nobody"], 100.0)
    except SumoError as error:
        said.append(str(error))
try:
    look(libsumo, ["nobody"], 100.0)
except SumoError as error:
    said.append(str(error))
bridge = bridge_of(vehicle)
libsumo.close()
print(json.dumps([found, said, bridge is not None]))
"""


def test_subscriptions_and_the_compiled_call_say_what_calls_say(
    tmp_path: Path, live: Forks
) -> None:
    """In libsumo, which has both, while vehicles come and change lanes."""
    done = live.run(["-c", BOTH_WAYS], tmp_path)
    assert done.returncode == 0, done.stderr
    found, said, is_compiled = json.loads(done.stdout.splitlines()[-1])
    assert all(same for same, _, _ in found)
    assert max(following for _, following, _ in found) > 10
    assert max(alone for _, _, alone in found) > 1
    assert len(said) == 3
    assert is_compiled == (find_compiler() is not None)
    for sentence in said:
        assert sentence.startswith("vehicle 'nobody' cannot be driven (")
