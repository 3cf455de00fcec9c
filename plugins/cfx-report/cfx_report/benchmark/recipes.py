"""How each ready-made policy is trained: what `make policies` runs."""

from __future__ import annotations

from typing import NamedTuple

I80 = "i80_reconstructed_pairs.parquet"
CARS_WITH_ACC = (
    "openacc_zalazone_pairs.parquet",
    "openacc_vicolungo_pairs.parquet",
    "openacc_ispra_low_speed_pairs.parquet",
)
PEOPLE = (
    I80,
    "ngsim_i80_hov_ramp_pairs.parquet",
    "openacc_zalazone_pairs.parquet",
    "openacc_vicolungo_pairs.parquet",
    "tgsim_freeway_pairs.parquet",
)
EVERY_ROAD = (*PEOPLE, "openacc_ispra_low_speed_pairs.parquet")
"""Recordings whose licences let weights be published, as they are called in the folder that `make
policies` is given. Ispra's drivers are cars with ACC, and others of whom nobody knows."""

_HUMAN = "data.driver_type=human"
"""People and cars with ACC have different equilibria: a policy that learns from both at once ends
between them."""

_UNSEEN = ("protocol.history=0.0", "protocol.histories=[]", "protocol.combine=false")
"""Tested as drivers of whom nothing is known. Networks that also learn from drivers with history
drive unseen ones better than those that learn from cold starts alone."""


class Recipe(NamedTuple):
    """One policy.

    Attributes:
        overrides: of the job that trains it and tests it on unseen drivers.
        summary: one sentence for people.
        recordings: files that it learns from.
    """

    overrides: tuple[str, ...]
    summary: str
    recordings: tuple[str, ...]


RECIPES = {
    "idm": Recipe(
        ("experiment=every_road", _HUMAN, *_UNSEEN),
        "Intelligent Driver Model for people on any road, unseen; the one to begin with.",
        PEOPLE,
    ),
    "idm-history": Recipe(
        ("experiment=every_road", "protocol.histories=[]"),
        "Intelligent Driver Model for people and cars with adaptive cruise control on any road,"
        " with history: it observes a driver, then drives as they do, beside driver-specific"
        " parameters.",
        EVERY_ROAD,
    ),
    "idm-stochastic": Recipe(
        (
            "experiment=every_road",
            _HUMAN,
            "protocol=forecast",
            "protocol.samples=20",
            "protocol.stride=5",
            *_UNSEEN,
            "policy.driver_features=[]",
            "learner.head=stochastic",
            "learner.epochs=16",
            # Times are weighted alike: relative to the error at each time, as experiment=forecast
            # weights them, drivers hardly accelerate and platoons amplify each dip.
            "learner.cold_start_fraction=1.0",
            "learner.ensemble_size=2",  # its trajectories are simulated several times
        ),
        "Intelligent Driver Model for people on any road, unseen, who vary: each draws their own"
        " parameters and noise, with a seed. For forecasts, and for traffic that makes its own"
        " waves; above 25 m/s its gaps are smaller than people's.",
        PEOPLE,
    ),
    "idm-acc": Recipe(
        (
            "experiment=every_road",
            "data.driver_type=acc",
            "protocol.histories=[]",
            "learner.simulated_queues=0",
        ),
        "Intelligent Driver Model for cars with adaptive cruise control, without history and with.",
        CARS_WITH_ACC,
    ),
    "w99": Recipe(
        (
            "experiment=every_road",
            _HUMAN,
            "model=w99_wide",
            "learner.jerk_weight=0.01",
            "protocol.histories=[]",
        ),
        "Wiedemann 99 for people on any road, without history and with; Vissim's family.",
        PEOPLE,
    ),
    "krauss": Recipe(
        (
            "experiment=every_road",
            _HUMAN,
            "model=krauss",
            "model.parameters.a.tuned=true",
            "model.limits.response_time=0.3",
            # In the paper's form drivers come to rest at the bumper ahead, within millimetres.
            # People stand 1.4 to 6 m apart (NGSIM, 5 and 95 % of 47 pairs; median 2.7 m).
            "model.parameters.min_gap.default=2.0",
            # 0.3, as experiment=every_road has it, costs Krauss's model accuracy at other sites.
            "learner.equilibrium_weight=0.2",
            "protocol.combine=false",
            "protocol.histories=[]",
        ),
        "Krauss's model for people on any road, without history and with; SUMO's own family.",
        PEOPLE,
    ),
}
