# %% [markdown]
# # From a data frame
#
# A table of your own, with its own names and units, calibrated with four models and compared on
# what they were not calibrated on. Nothing is written but the pictures.

# %%
import os

import pandas as pd

import cfx

SMOKE = "CFX_SMOKE" in os.environ  # a test runs this file small

# %% [markdown]
# ## A table
#
# Here drivers are made up, in a table as one often has it: the follower's speed in km/h, in a
# column `v`. With a recording of your own, `pd.read_csv` it, or give `cfx.read` the file.

# %%
made = cfx.read(dataset="synthetic_drivers", pairs=4 if SMOKE else 12)
table = made.frame.rename(columns={"follower_speed_mps": "v"})
table["v"] *= 3.6
print(table[["pair_id", "time_s", "leader_speed_mps", "v"]].head(3).round(2))

# %% [markdown]
# Names and units are mapped once, when the pairs are read. What contradicts itself is refused: a
# speed in km/h that is called m/s does not fit the positions.

# %%
own = {"columns": {"speed": "v"}, "units": {"speed": "km/h"}}
pairs = cfx.read(table, min_duration=10, **own)
print(pairs)
try:
    cfx.read(table, min_duration=10, columns=own["columns"])
except cfx.errors.CfxError as error:
    print(error)

# %% [markdown]
# ## One model
#
# Driver-specific parameters are calibrated on the first 80 % of each driver's trajectory. A prior,
# as strong as predicts them best, holds what the recording does not determine near the default.

# %%
fit = cfx.calibrate(pairs, "idm", objective="gap_rmse")
print(fit.parameters.head(3).round(2))
print(fit.summary.round(2).to_string())

# %% [markdown]
# `fit.plot()` shows them between their bounds:
#
# ![Parameters of IDM between their bounds](frames.png)

# %%
fit.plot().savefig("frames.png")

# %% [markdown]
# ## Four models
#
# Errors on the rest, simulated in closed loop: `default` parameters, one pooled set
# (`pooled`), one of each driver (`driver_specific`).

# %%
fits = {"idm": fit}
for model in ("krauss", "w99", "w74"):
    fits[model] = cfx.calibrate(pairs, model, objective="gap_rmse")
means = {}
for model, one in fits.items():
    means[model] = one.losses.groupby("method")["test_rmse_gap"].mean()
print("RMSE of the gap on the test part, m")
print(pd.DataFrame(means).round(2))

# %% [markdown]
# `pd.DataFrame(means).to_latex()` is a paper's table. Is the best model better for most drivers?

# %%
errors = {}
for model, one in fits.items():
    own_sets = one.losses[one.losses["method"] == "driver_specific"]
    errors[model] = own_sets.set_index("pair_id")["test_rmse_gap"]
best = pd.DataFrame(errors).idxmin(axis=1)
print(best.value_counts().to_string())

# %% [markdown]
# ## What would they do behind another leader?
#
# `simulate` returns a row per follower and frame: behind the recorded leaders, or behind one that
# you make up.

# %%
leader = pd.DataFrame({"time_s": [0.1 * step for step in range(300)], "speed": 12.0})
leader.loc[100:150, "speed"] = 4.0  # it brakes
drive = cfx.simulate("idm", fit.parameters, leader=leader)
print(drive.groupby("pair_id")["gap"].min().describe()[["min", "50%", "max"]].round(1).to_string())

# %% [markdown]
# The same on the command line needs a file: `pairs.save("pairs.parquet")`, and `fit.command` of a
# fit to these pairs prints it. [More from Python](../how-to/python.md)
