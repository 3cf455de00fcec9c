"""A platoon behind a leader that brakes and recovers, with ONNX Runtime and NumPy alone.

python platoon.py driver.onnx > platoon.csv
"""

import sys

import numpy as np
import onnxruntime

VEHICLES, LENGTH = 10, 5.0
session = onnxruntime.InferenceSession(sys.argv[1])
dt = float(session.get_modelmeta().custom_metadata_map["cfx.dt"].split()[0])
random = np.random.default_rng(0)
state = {}
for one in session.get_inputs():
    kind = {"tensor(int64)": np.int64, "tensor(float)": np.float32}.get(one.type, np.float64)
    state[one.name] = np.zeros((VEHICLES, *one.shape[1:]), kind)  # zeros: a driver who begins
speed, acceleration = np.full(VEHICLES, 15.0), np.zeros(VEHICLES)
position = -30.0 * np.arange(1, VEHICLES + 1)
leader_speed, leader_position = 15.0, 0.0
print("time", *(f"speed_{k}" for k in range(VEHICLES + 1)), sep=",")
for step in range(round(90 / dt)):
    print(f"{step * dt:.3f}", *(f"{v:.9f}" for v in (leader_speed, *speed)), sep=",")
    leader_acceleration = -2.0 if 100 <= step < 140 else 1.0 if 240 <= step < 320 else 0.0
    state["ego_speed"], state["ego_acceleration"] = speed, acceleration
    state["leader_speed"] = np.append(leader_speed, speed[:-1])
    state["leader_acceleration"] = np.append(leader_acceleration, acceleration[:-1])
    state["gap"] = np.append(leader_position, position[:-1]) - LENGTH - position
    if "noise" in state:  # of a stochastic driver
        state["noise"] = random.standard_normal(state["noise"].shape)
    next_speed, *remembered = session.run(None, state)
    for one, value in zip(session.get_outputs()[1:], remembered, strict=True):
        state[one.name.removeprefix("next_")] = value
    acceleration = (next_speed - speed) / dt
    position, speed = position + next_speed * dt, next_speed
    leader_speed += leader_acceleration * dt
    leader_position += leader_speed * dt
