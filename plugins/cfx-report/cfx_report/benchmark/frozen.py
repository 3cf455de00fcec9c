"""What the suite `i80` fixes: pairs, folds, seed, split and metrics, and their hash."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

VERSION = "i80-1"
"""Name of the protocol; another one begins whenever anything in this module changes."""

DATA = "686ccc1ea116e6c49e473d944353e6d9dcb523eaeafc6046328510bc2fc222cb"
"""`PairSet.fingerprint` of the 229 pairs of the reconstructed I-80 that are selected below."""

DATA_NAME = "I-80, reconstructed: 229 pairs, of which 71 are tested"

TESTED = 71
"""Pairs that are tested, each in the fold that did not learn from its driver."""

OVERRIDES = (
    "data=tidy",
    "data.min_duration=30",
    "protocol=across_drivers",
    "protocol.folds=5",
    "protocol.together=driver",
    "protocol.min_test_duration=70",
    "protocol.base=pooled",
    "protocol.history=0.0",
    "protocol.histories=[]",
    "split=0.8",
    "windows.length=5",
    "windows.stride=5",
    "style.cluster=all",
    "simulator=memory",
    "seed=0",
    "dtype=float64",
    "metrics=[rmse_speed,rmse_gap,collisions,hard_braking,jerk]",
)
"""What every job of the benchmark has; nobody may give these keys another value."""

SCOPE = "full_trajectory"
"""Errors count over the full trajectories of unseen drivers, from their first frame."""

METRICS = ("rmse_speed", "rmse_gap", "collisions", "hard_braking")
"""What a row holds of each pair, in this scope."""

METHODS: Mapping[str, tuple[str, ...]] = {
    "constant": ("policy=fixed",),
    "imitation": ("policy=gru", "policy.inputs=speeds", "learner=imitation"),
    "closed_loop": ("experiment=unseen_drivers",),
}
"""How a model is used: constant parameters, pooled over the drivers that are not tested; a network
that imitates labels; a network trained through the simulation."""

FROZEN_KEYS = (
    "data",
    "protocol",
    "split",
    "windows",
    "style",
    "simulator",
    "seed",
    "dtype",
    "metrics",
)
"""Keys of a job's configuration that are the benchmark's alone."""

HISTORY = "protocol.history"
"""What a policy learns to read of a driver, which a method may choose: how much it is given is the
benchmark's."""


def protocol_hash(data: str = DATA) -> str:
    """Returns what names the protocol: twelve digits of the SHA-256 of everything fixed here.

    Args:
        data: fingerprint of the pairs.
    """
    fixed = {
        "version": VERSION,
        "data": data,
        "overrides": OVERRIDES,
        "scope": SCOPE,
        "metrics": METRICS,
    }
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:12]
