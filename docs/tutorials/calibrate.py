# %% [markdown]
# # Calibrate your recording
#
# From a table of trajectories to calibrated parameters of two car-following models, and to a
# judgement of which one describes these drivers better. You need no recording: the first cell
# makes one, and says what to replace.

# %%
import os
from pathlib import Path

import numpy as np
import pandas as pd

import cfx

SMOKE = "CFX_SMOKE" in os.environ  # a test runs this file small
PAIRS = 6 if SMOKE else 24

# %% [markdown]
# ## A table of pairs
#
# cfx reads one row per leader-follower pair and frame, in SI units. Here it is a made-up
# recording, whose drivers follow Krauss's model with parameters that differ from driver to driver
# and drift in time. With a recording of your own, write this table instead: [the
# columns](../how-to/own-recording.md).

# %%
made = cfx.get("dataset", "synthetic")(pairs=PAIRS, frames=300 if SMOKE else 600).load()
rows = []
for pair in made:
    rows.append(
        pd.DataFrame(
            {
                "recording": "my_road",
                "pair_id": pair.pair_id,
                "leader_id": pair.leader_id,
                "follower_id": pair.follower_id,
                "frame": np.arange(len(pair)),
                "time_s": np.arange(len(pair)) * pair.dt,
                "leader_position_m": pair.leader_position,
                "leader_speed_mps": pair.leader_speed,
                "leader_acceleration_mps2": pair.leader_acceleration,
                "follower_position_m": pair.follower_position,
                "follower_speed_mps": pair.follower_speed,
                "follower_acceleration_mps2": pair.follower_acceleration,
                "leader_length_m": pair.leader_length,
            }
        )
    )
pd.concat(rows).to_csv("recording.csv", index=False)
print(pd.read_csv("recording.csv").iloc[:2].T)

# %% [markdown]
# `python -m cfx data describe recording.csv` says what is in it and what would be left out. Look
# at it before anything else: most surprises are in the data.
#
# ## Calibrate two models
#
# `policy=fixed` makes a job a calibration. Each driver's parameters are calibrated on the first
# 80 % of their trajectory and tested in closed loop on the rest: the simulated follower sees the
# recorded leader and its own past, never the recorded follower.

# %%
common = [
    "data=tidy",
    "data.path=recording.csv",
    "data.min_duration=10",
    "policy=fixed",
    "tracking.enabled=false",
]
results = {}
for model in ("idm", "krauss"):
    results[model] = cfx.run([*common, f"model={model}", f"hydra.run.dir=outputs/{model}"])

# %% [markdown]
# ## Which model describes them better?
#
# Compare errors on the part that was not calibrated on. `default` are the model's default
# parameters, `pooled` one set for all training drivers, `driver_specific` one for each driver.

# %%
table = pd.DataFrame(
    {
        model: {
            method: result.metrics[f"rmse_speed/{method}"]
            for method in ("default", "pooled", "driver_specific")
        }
        for model, result in results.items()
    }
)
print("RMSE of speed on the test part, m/s")
print(table.round(3))

# %% [markdown]
# These drivers were made with Krauss's model, yet Krauss's does not win: their parameters drift,
# so constant ones miss them in either model. The lower error does not say which model is true.
# Nor is a difference of means a difference: compare driver by driver.

# %%
errors = pd.DataFrame(
    {
        model: result.pairs[result.pairs["method"] == "driver_specific"].set_index("pair_id")[
            "rmse_speed"
        ]
        for model, result in results.items()
    }
)
difference = errors["idm"] - errors["krauss"]
draws = np.random.default_rng(0).choice(difference.to_numpy(), (2000, len(difference)))
low, high = np.quantile(draws.mean(axis=1), [0.025, 0.975])
print(f"IDM has the lower error for {(difference < 0).sum()} of {len(difference)} drivers")
print(f"mean difference {difference.mean():+.3f} m/s (95 % interval {low:+.3f} to {high:+.3f})")

# %% [markdown]
# What counts are errors on the test part, not on the part that was calibrated on: five or ten
# parameters fit one minute of anybody's driving.
#
# ## The parameters
#
# `pairs.csv` has a row per pair and method. Parameters at a bound, or equal to the default in
# many drivers, were not determined by the data: the weak prior keeps them there.

# %%
pairs = results["idm"].pairs
own = pairs[pairs["method"] == "driver_specific"].filter(like="parameter_")
print(own.rename(columns=lambda name: name.removeprefix("parameter_")).describe().round(2))

# %% [markdown]
# Each job draws them between their bounds, own, pooled and default, with the share of drivers at
# a bound:
#
# ![Calibrated parameters of IDM between their bounds](calibration.png)

# %%
figure = results["idm"].folder / "figures" / "calibration.png"
Path("calibration.png").write_bytes(figure.read_bytes())

# %% [markdown]
# ## For a paper
#
# `python -m cfx report outputs/idm outputs/krauss --tables latex` writes the comparison as a
# table, with intervals over drivers, versions and commands. [More](../how-to/paper.md)
