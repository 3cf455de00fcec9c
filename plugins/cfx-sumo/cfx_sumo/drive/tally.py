"""What `cfx drive` counts of the vehicles of a scenario.

SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Histogram:
    """Counts values in bins of equal width; those beyond the ends count in the last bins.

    Args:
        low, high: ends.
        width: of a bin, which is also how exactly quantiles are known.
    """

    def __init__(self, low: float, high: float, width: float) -> None:
        self.low, self.width = low, width
        self.counts = np.zeros(round((high - low) / width), dtype=np.int64)

    def add(self, values: Sequence[float] | np.ndarray) -> None:
        """Counts values; those that are not finite are left out."""
        array = np.asarray(values, dtype=np.float64)
        array = array[np.isfinite(array)]
        places = ((array - self.low) / self.width).astype(np.int64)
        last = len(self.counts) - 1
        self.counts += np.bincount(places.clip(0, last), minlength=last + 1)

    def quantile(self, share: float) -> float:
        """Returns the value below which this share lies, to half a bin; NaN if there is none."""
        total = int(self.counts.sum())
        if total == 0:
            return float("nan")
        place = int(np.searchsorted(self.counts.cumsum(), share * total))
        return self.low + (place + 0.5) * self.width


@dataclass
class Tally:
    """What the vehicles of one vType did.

    Attributes:
        vehicles: ids of all that were on the road.
        steps: vehicle steps.
        behind: those of them behind a leader; in the others no vehicle was ahead.
        metres: the distance that all covered together.
        lane_changes: on the same edge.
        hard_brakings: times that a vehicle began to brake harder than its vType's `decel`.
        hardest_braking: the largest deceleration of any, m/s2.
        braking: decelerations of all steps, m/s2; 0 where a vehicle did not brake.
        speeds: of all steps, m/s.
        accelerations: of all steps, m/s2.
        time_gaps: of the steps behind a leader faster than walking, s.
        collisions: of those that SUMO reported, the ones with contact (`Collision.contact`) of a
            vehicle and the one ahead of it.
        below_min_gap: those in which the gap was below minGap, and nobody was touched.
        crossings: those of vehicles whose paths cross at a junction.
        teleports: vehicles that SUMO reported; a vehicle may teleport more than once.
    """

    vehicles: set[str] = field(default_factory=set)
    steps: int = 0
    behind: int = 0
    metres: float = 0.0
    lane_changes: int = 0
    hard_brakings: int = 0
    hardest_braking: float = 0.0
    braking: Histogram = field(default_factory=lambda: Histogram(0.0, 20.0, 0.02))
    speeds: Histogram = field(default_factory=lambda: Histogram(0.0, 70.0, 0.1))
    accelerations: Histogram = field(default_factory=lambda: Histogram(-15.0, 8.0, 0.02))
    time_gaps: Histogram = field(default_factory=lambda: Histogram(0.0, 30.0, 0.05))
    collisions: int = 0
    below_min_gap: int = 0
    crossings: int = 0
    teleports: int = 0


@dataclass
class Collision:
    """What SUMO reports as a collision of two vehicles, however many steps it lasts.

    SUMO reports a gap below the follower's `minGap` as well (`collision.mingap-factor`).

    Attributes:
        time: s, of the first step.
        kind: the driven vType of the collider; of the victim, where no policy drives the collider.
        collider, victim: their ids.
        lane: of the collider.
        position: of the collider's front on it, m.
        gap: the smallest, from bumper to bumper, m; None: not known, as where paths cross.
        crossing: whether their paths cross at a junction; otherwise one is behind the other.
        inserted: whether SUMO has just put the collider there, as it does on an edge that is
            shorter than a vehicle.
    """

    time: float
    kind: str
    collider: str
    victim: str
    lane: str
    position: float
    gap: float | None
    crossing: bool = False
    inserted: bool = False

    @property
    def contact(self) -> bool:
        """Whether they touched; also where the gap is not known."""
        return self.gap is None or self.gap <= 0.0

    def __str__(self) -> str:
        """Returns who, where and when on one line."""
        if self.crossing:
            return (
                f"{self.time:.2f} s: {self.collider} and {self.victim}, whose paths cross, on"
                f" {self.lane} at {self.position:.1f} m"
            )
        what = "contact"
        if not self.contact:
            what = "below minGap"
        gap = "gap not known"
        if self.gap is not None:
            gap = f"gap {self.gap:.2f} m"
        where = ", where SUMO has just inserted it" if self.inserted else ""
        return (
            f"{self.time:.2f} s: {self.collider} behind {self.victim} on {self.lane} at"
            f" {self.position:.1f} m{where}: {what}, {gap}"
        )


class CollisionCounts(NamedTuple):
    """How many collisions there were with contact.

    Attributes:
        behind: of a vehicle and the one ahead of it.
        crossing: of vehicles whose paths cross at a junction.
    """

    behind: int
    crossing: int

    def __str__(self) -> str:
        """Returns both in words."""
        return f"{self.behind} with the vehicle ahead, {self.crossing} where paths cross"


@dataclass(frozen=True)
class ScenarioRun:
    """What `run_scenario` reports.

    Attributes:
        tallies: for each vType that was driven.
        steps: of the simulation.
        dt: its time step, s.
        seconds: how long it took.
        others: most vehicles of other types at one time.
        most: most vehicles of the driven types at one time.
        limited: for each vType, the share of the model's steps behind a leader that are at a limit
            of acceleration.
        changed: for each vType, the share of the speeds that SUMO's checks changed.
        outside: for each vType, how much was driven outside what its policy has learned, in words;
            "" where nothing was.
        recorded: for each vType, quantiles of the recording that its policy learned from, by
            signal (`Agent.recorded`).
        expected: for each vType, what error of speed to expect of its policy, in words; "" where
            that is not known.
        collisions: that SUMO reported of driven vehicles, in their order.
        collisions_of_sumo: how many SUMO has in the same scenario where its own models drive all;
            None where there was nothing to compare with them.
        left_out: what SUMO says of the vehicles and flows of the scenario that it left out.
        fleets: for each vType, in words, who drives its vehicles.
    """

    tallies: Mapping[str, Tally]
    steps: int
    dt: float
    seconds: float
    others: int
    most: int
    limited: Mapping[str, float] = field(default_factory=dict)
    changed: Mapping[str, float] = field(default_factory=dict)
    outside: Mapping[str, str] = field(default_factory=dict)
    recorded: Mapping[str, Mapping[str, Sequence[float]]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    collisions: Sequence[Collision] = ()
    collisions_of_sumo: CollisionCounts | None = None
    left_out: Sequence[str] = ()
    fleets: Mapping[str, str] = field(default_factory=dict)

    @property
    def real_time(self) -> float:
        """Simulated seconds per second."""
        if self.seconds <= 0:
            return float("inf")
        return self.steps * self.dt / self.seconds
