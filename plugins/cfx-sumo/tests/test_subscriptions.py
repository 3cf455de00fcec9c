"""Over TraCI's connections values come by subscription: the same ones as by calls."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("traci", reason="needs the extra sumo")

BOTH_WAYS = """
import sys
sys.modules["pyarrow"] = None
import json, os
from pathlib import Path
os.environ["LIBSUMO_AS_TRACI"] = "quiet"
import libsumo
import torch
from cfx.core.errors import SumoError
from cfx_sumo.drive.scenarios import SCENARIOS
from cfx_sumo.live.surroundings import DirectReader, SubscribedReader, view_of
scenario = SCENARIOS["motorway"].write(Path("."))
libsumo.start(["sumo", "-c", str(scenario), "--no-step-log", "--no-warnings"])
found = []
for _ in range(300):
    libsumo.simulationStep()
    names = [name for name in libsumo.vehicle.getIDList() if name.startswith("car")]
    calls = view_of(DirectReader(libsumo.vehicle, 100.0), names)
    sent = view_of(SubscribedReader(libsumo.vehicle, 100.0, 100.0), names)
    same = torch.equal(torch.stack(list(calls.seen)), torch.stack(list(sent.seen)))
    found.append([calls[:3] == sent[:3] and same, len(calls.following), len(calls.alone)])
said = []
vehicle = libsumo.vehicle
for reader in (DirectReader(vehicle, 100.0), SubscribedReader(vehicle, 100.0, 100.0)):
    try:
        view_of(reader, ["nobody"])
    except SumoError as error:
        said.append(str(error))
libsumo.close()
print(json.dumps([found, said]))
"""


def test_subscriptions_say_what_calls_say(tmp_path: Path) -> None:
    """In libsumo, which has both, while vehicles come and change lanes."""
    done = subprocess.run(
        [sys.executable, "-c", BOTH_WAYS],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    found, said = json.loads(done.stdout.splitlines()[-1])
    assert all(same for same, _, _ in found)
    assert max(following for _, following, _ in found) > 10
    assert max(alone for _, _, alone in found) > 1
    assert len(said) == 2
    for sentence in said:
        assert sentence.startswith("vehicle 'nobody' cannot be driven (")
