"""cfx's drivers and recordings as Gymnasium environments, and as vehicles of highway-env.

    import gymnasium, cfx_drivers.gym

    gymnasium.register_envs(cfx_drivers.gym)
    env = gymnasium.make("cfx/CarFollowing-v0", recording="pairs.parquet", driver="cfx://idm")

Importing it makes the environments known, as Gymnasium's convention is.
"""

from __future__ import annotations

import gymnasium

gymnasium.register(
    id="cfx/CarFollowing-v0",
    entry_point="cfx_drivers.gym.single:CarFollowingEnv",
    vector_entry_point="cfx_drivers.gym.vector:CarFollowingVectorEnv",
)
