"""Which simulator takes the steps. Imports nothing heavy: every configuration reads this."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cfx.component import Settings


class MemorySettings(Settings):
    """`simulator=memory`: the model's own equations."""

    name: Literal["memory"] = Field(
        "memory", description="the model's equations, batched in memory"
    )


class SumoSettings(Settings):
    """`simulator=sumo`: SUMO, in processes of its own."""

    name: Literal["sumo"] = Field("sumo", description="SUMO itself takes the steps")
    workers: int | None = Field(
        None, ge=1, description="SUMO processes at most; null: one for each core"
    )
    followers: int = Field(
        50,
        ge=1,
        le=4000,
        description="followers in one network, each on its own road; 10 to 100 is fastest",
    )
    seed: int = Field(
        23423, ge=0, lt=2**31, description="SUMO's own seed, for models that draw random numbers"
    )


SIMULATORS: dict[str, type[MemorySettings] | type[SumoSettings]] = {
    "memory": MemorySettings,
    "sumo": SumoSettings,
}
"""The settings by the simulator's name."""
