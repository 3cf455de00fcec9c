# %% [markdown]
# # Drive in SUMO
#
# Real drivers' habits in your own SUMO simulation: first a scenario that comes with cfx, then
# vehicles of a program of your own, and at last parameters without Python. It needs SUMO: `pip
# install "cfx-driving[sumo]"`.

# %%
import os
from pathlib import Path

import libsumo

import cfx
import cfx_sumo
from cfx_sumo.drive.scenarios import SCENARIOS

SMOKE = "CFX_SMOKE" in os.environ  # a test runs this file small
END_S = 20 if SMOKE else 900

# %% [markdown]
# ## A scenario
#
# Any `.sumocfg` will do. Here a ring road with 22 vehicles of the vType `car` is written into a
# folder; yours is already there. From the shell, `python -m cfx drive scenario/ring.sumocfg
# --drivers car=cfx://idm` drives all of them by a [ready-made policy](../policies.md) and
# prints how they drove.

# %%
Path("scenario").mkdir(exist_ok=True)
scenario = SCENARIOS["ring"].write(Path("scenario").resolve(), END_S)
print(scenario)

# %% [markdown]
# ## In your own program
#
# `Driver.step` chooses parameters for all vehicles in one call and sets their speeds. It
# remembers each vehicle, and forgets those that have left. Red lights, stops and junctions are
# obeyed, and SUMO's safe gap is kept; `speed_mode=0` drives what the model says and obeys none.

# %%
driver = cfx_sumo.Driver.load("cfx://idm")
libsumo.start(["sumo", "-c", str(scenario), "--no-step-log", "true", "--no-warnings", "true"])
speeds = []
while libsumo.simulation.getTime() < END_S:
    libsumo.simulationStep()
    vehicles = libsumo.vehicle.getIDList()
    driver.step(libsumo, vehicles)
    if vehicles:
        speeds.append([libsumo.vehicle.getSpeed(vehicle) for vehicle in vehicles])
collisions = libsumo.simulation.getCollidingVehiclesNumber()
libsumo.close()

# %%
last = speeds[-1]
print(f"{len(last)} vehicles, {END_S} s, {collisions} colliding at the end")
print(f"speeds at the end: {min(last):.1f} to {max(last):.1f} m/s")

# %% [markdown]
# On the ring, stop-and-go waves arise by themselves, as people make them in Sugiyama's
# experiment: some vehicles stand while others drive.
#
# ## Without Python
#
# Constant parameters need no program. Calibrate, then write them as vTypes that SUMO loads; each
# vehicle that is drawn from the distribution has one recorded driver's whole set:

# %%
result = cfx.run(
    [
        "model=krauss",
        "policy=fixed",
        "tracking.enabled=false",
        "hydra.run.dir=outputs/to-sumo",
        *(["data.pairs=6", "data.frames=200"] if SMOKE else []),
    ]
)

# %%
from cfx_sumo.export import export  # noqa: E402 - the last step of the tutorial

for line in export(result.folder):
    print(line)
