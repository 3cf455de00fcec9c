"""How each ready-made policy is trained: what `make policies` runs."""

from __future__ import annotations

from typing import NamedTuple


class Recipe(NamedTuple):
    """One policy.

    Attributes:
        overrides: of the job that trains it and tests it on unseen drivers.
        summary: one sentence for people.
    """

    overrides: tuple[str, ...]
    summary: str


SHARED_OVERRIDES = (
    "optimizer=random",  # by which the constants that they start from were found
    "data=tidy",
    "data.min_frames=300",
    "protocol.min_test_frames=700",
)
"""What all jobs share; `data.path` is added."""

RECIPES = {
    "i80-idm": Recipe(
        ("experiment=unseen_drivers", "model=idm"),
        "Intelligent Driver Model for unseen drivers; the smoothest, and the one to begin with.",
    ),
    "i80-krauss": Recipe(
        ("experiment=unseen_drivers_smooth", "model.limits.response_time=0.3"),
        "Krauss's model for unseen drivers, SUMO's own family.",
    ),
    "i80-w99": Recipe(
        (
            "experiment=unseen_drivers",
            "model=w99_wide",
            "learner=rollout_distilled",
            "model.limits.response_time=0.1",
        ),
        "Wiedemann 99 for unseen drivers, Vissim's family.",
    ),
    "i80-idm-stochastic": Recipe(
        (
            "experiment=stochastic",
            "model=idm",
            "learner.drivers=32",
            "learner.cold_start_fraction=1.0",
            "protocol.base=population",
            "protocol.history=0.0",
        ),
        "Intelligent Driver Model for unseen drivers who vary as people do: each draws their own"
        " parameters and noise, with a seed.",
    ),
    "i80-idm-history": Recipe(
        ("experiment=conditioned", "model=idm"),
        "Intelligent Driver Model for drivers with history: it observes a driver, then drives as"
        " they do.",
    ),
}
