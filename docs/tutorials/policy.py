# %% [markdown]
# # Train and judge a policy
#
# A policy chooses a driving model's parameters anew every half second, from what its vehicle
# perceives. Here one is trained through the simulation for drivers that it has never seen, and
# then judged as a sceptic would: against what, with which interval, after the transient, and how
# safely?

# %%
import os
from pathlib import Path

import cfx

SMOKE = "CFX_SMOKE" in os.environ  # a test runs this file small
size = ["data.pairs=6", "data.frames=200", "learner.epochs=1"] if SMOKE else ["data.pairs=24"]

# %% [markdown]
# ## Train
#
# Drivers are divided into five folds; each fold is driven by networks that learned from the other
# four. Every trajectory begins from the pooled parameters and without history, as an unseen
# driver's does. With your own recording, add `data=tidy data.path=FILE`.

# %%
result = cfx.run(
    [
        "experiment=unseen_drivers",
        "model=idm",
        "optimizer=gradient",
        "learner=rollout_short",
        "tracking.enabled=false",
        "hydra.run.dir=outputs/unseen",
        *size,
    ]
)

# %% [markdown]
# ## Against what?
#
# For a driver that nobody has recorded there are no driver-specific parameters, so the fair
# baseline is `pooled`: one pooled set, calibrated on the same training drivers, on full
# trajectories. The interval is over drivers, because frames of one driver say little about the
# next.

# %%
metrics = result.metrics
key = "full_trajectory/improvement/rmse_speed/pooled"
print(f"pooled {metrics['full_trajectory/rmse_speed/pooled']:.3f} m/s")
print(f"policy {metrics['full_trajectory/rmse_speed/policy']:.3f} m/s")
low, high = metrics[f"{key}/ci95_low"], metrics[f"{key}/ci95_high"]
print(f"improvement {metrics[f'{key}/geometric']:+.1%} (95 % interval {low:+.1%} to {high:+.1%})")

# %% [markdown]
# Does the interval exclude zero? Run it again with `seed=1`: other folds, other networks. With
# real drivers expect less than with these: [on I-80](../results.md#unseen-drivers) a policy for IDM
# is hardly closer to the drivers than pooled parameters, one for Krauss's model clearly.
#
# ## For whom?
#
# A mean hides who loses. `result.pairs` has a row per pair and method, of the last 20 % of each
# trajectory. Look at a bad ratio in m/s before you believe it: a small error divided by a tiny
# one is a large percentage. Such a driver pulls the mean down, and the interval with it, which
# is why a job prints the median and the number of drivers too.

# %%
errors = result.pairs.pivot(index="pair_id", columns="method", values="rmse_speed")
gain = 1 - errors["policy"] / errors["pooled"]
print(f"better for {(gain > 0).sum()} of {len(gain)}")
print(f"worst {gain.min():+.0%}, median {gain.median():+.0%}, best {gain.max():+.0%}")
print("the worst, m/s:", errors.loc[gain.idxmin(), ["pooled", "policy"]].round(3).to_dict())

# %% [markdown]
# ![Speed and gap of the best, the median and the worst driver](drives.png)
#
# ## How safe, how smooth?

# %%
for name, unit in (("collisions", ""), ("hard_braking", "frames"), ("jerk", "m/s3")):
    values = {method: metrics.get(f"{name}/{method}") for method in ("pooled", "policy")}
    print(name, {method: round(value, 2) for method, value in values.items()}, unit)

figure = result.folder / "figures" / "drives.png"
Path("drives.png").write_bytes(figure.read_bytes())

# %% [markdown]
# ## Use it
#
# The job's folder holds the policy. Load it, [test it on another
# recording](../how-to/transfer.md), or [let it drive in SUMO](sumo.md):

# %%
again = cfx.load(result.folder)
print(again)
