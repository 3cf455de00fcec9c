# %% [markdown]
# # A model of your own, and forecasts
#
# A driving model in one cell, calibrated beside IDM; then a ready-made stochastic driver that
# forecasts where drivers will be.

# %%
import os

import cfx

SMOKE = "CFX_SMOKE" in os.environ  # a test runs this file small
pairs = cfx.read(dataset="synthetic", pairs=3 if SMOKE else 8, frames=300 if SMOKE else 600)

# %% [markdown]
# ## A model in one cell
#
# A model says its parameters, with units, bounds and defaults, and the next speed. `@cfx.model`
# makes it known by a name until the program ends; running the cell again replaces it. Its
# equations are compiled like those of all others.


# %%
@cfx.model("optimal_velocity")
class OptimalVelocity(cfx.plugin.DrivingModel):
    """Relaxes to a speed that depends on the gap, and follows the leader's speed."""

    parameters = cfx.plugin.ParameterSpace.of(
        cfx.plugin.Parameter("v0", "m/s", 5.0, 40.0, 20.0, "desired speed"),
        cfx.plugin.Parameter("T", "s", 0.3, 4.0, 1.2, "time gap"),
        cfx.plugin.Parameter("s0", "m", 0.5, 8.0, 2.0, "gap at standstill"),
        cfx.plugin.Parameter("tau", "s", 0.3, 10.0, 2.0, "relaxation time"),
        cfx.plugin.Parameter("gain", "1/s", 0.0, 2.0, 0.5, "response to the relative speed"),
    )

    def next_speed(self, follower, leader, p, dt):
        """Returns the speed after a time step."""
        gap = cfx.plugin.bumper_gap(follower, leader)
        optimal = ((gap - p["s0"]) / p["T"]).clamp(min=0.0).minimum(p["v0"])
        pull = (optimal - follower.speed) / p["tau"]
        acceleration = pull + p["gain"] * (leader.speed - follower.speed)
        return (follower.speed + acceleration * dt).clamp(min=0.0)


# %%
for name in ("optimal_velocity", "idm"):
    print(cfx.calibrate(pairs, name))

# %% [markdown]
# To share it, `python -m cfx plugins new model optimal_velocity` writes a package around it.
#
# ## Where will they be?
#
# `cfx://idm-stochastic` learned to drive as people on a congested motorway do, and to vary as
# they do. From 20 s on, knowing what was measured before, 50 paths of 10 s each:

# %%
future = cfx.forecast(
    "cfx://idm-stochastic", pairs, at=20.0, horizon=10.0 if not SMOKE else 2.0, samples=50
)
bands = future.quantiles((0.05, 0.5, 0.95))
last = bands.index.get_level_values("time_s").max()
print(bands.xs(last, level="time_s").round(1).head(6))

# %% [markdown]
# ![Fans of forecasts and what the drivers did](own_model.png)
#
# How often does such a band hold what happened? One moment of a few drivers says little;
# `cfx.evaluate("cfx://idm-stochastic", pairs, protocol="forecast", **{"protocol.samples": 50})`
# scores every moment of all ([forecasts](../forecasts.md)).

# %%
future.plot().savefig("own_model.png")
