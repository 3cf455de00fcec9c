"""How the time step of a policy fits into that of a simulation.

A policy has learned to choose at one time step, and its model to take steps of it. In a simulation
with longer steps the model takes several in each: leaders that it drives too take theirs at the
same time, others go on as they accelerate. In one with shorter steps it takes one in several of
them, and its acceleration is held meanwhile.
"""

from __future__ import annotations

from typing import NamedTuple

from cfx.errors import SumoError

SHORTEST_S, LONGEST_S = 0.01, 1.0
"""Steps of simulations in which vehicles are driven."""

_SAME_S = 1e-6


class Clock(NamedTuple):
    """One simulation's steps and the model's.

    Attributes:
        dt: of the simulation, s.
        substeps: steps of the model in one of the simulation; 1 unless that is long.
        held: steps of the simulation in one of the model; 1 unless they are short.
        step: of the model, s.
    """

    dt: float
    substeps: int
    held: int
    step: float

    @classmethod
    def of(cls, simulation_dt: float, policy_dt: float, source: str) -> Clock:
        """Fits the model's steps into a simulation's, as near to the policy's as whole numbers do.

        Args:
            simulation_dt: s.
            policy_dt: at which the policy was trained, s.
            source: of the policy, for messages.

        Raises:
            SumoError: the simulation's step is below 0.01 s or above 1 s.
        """
        if not SHORTEST_S - _SAME_S <= simulation_dt <= LONGEST_S + _SAME_S:
            raise SumoError(
                f"the simulation steps by {simulation_dt:g} s; the policy of {source} drives in"
                f" steps of {SHORTEST_S:g} to {LONGEST_S:g} s, and best in the {policy_dt:g} s that"
                f" it was trained at: start SUMO with --step-length {policy_dt:g}"
            )
        if abs(simulation_dt - policy_dt) <= _SAME_S:
            return cls(simulation_dt, 1, 1, policy_dt)
        if simulation_dt > policy_dt:
            substeps = round(simulation_dt / policy_dt)
            return cls(simulation_dt, substeps, 1, simulation_dt / substeps)
        held = round(policy_dt / simulation_dt)
        return cls(simulation_dt, 1, held, held * simulation_dt)

    @property
    def period(self) -> float:
        """Time from one look at a vehicle to the next, s."""
        return self.held * self.dt

    def steps_in(self, seconds: float) -> int:
        """Returns how many steps of the model are nearest to a time, one at least."""
        return max(1, round(seconds / self.step))
