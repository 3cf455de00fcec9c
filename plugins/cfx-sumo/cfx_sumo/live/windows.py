"""A policy that chooses the parameters of live vehicles, window by window.

Shapes: D vehicles, n tuned parameters, L frames of a token.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cfx.plugin import Agent, DriverContext, RowChoice
from cfx_sumo.live.assignments import Assignments
from cfx_sumo.live.clock import Clock
from cfx_sumo.live.draws import standard_normal
from cfx_sumo.live.vehicles import KnownVehicles

_BLOCK = 256
"""Vehicles for which the networks answer at once: what more of them need exceeds the processor's
caches, and takes longer for each."""


class PolicyWindows:
    """Lets the networks answer for the vehicles whose window begins, and keeps their state.

    Args:
        policy: chooses parameters.
        vehicles: in whose rows parameters and state are.
        assignments: which network drives which vehicle.
        seed: of what a stochastic policy leaves to chance; None: nothing is drawn.
    """

    def __init__(
        self, policy: Agent, vehicles: KnownVehicles, assignments: Assignments, seed: int | None
    ) -> None:
        self._policy = policy
        self._vehicles = vehicles
        self._assignments = assignments
        self._seed = seed if policy.core.head.is_stochastic else None
        self._choice = RowChoice(policy)

    def begin(self, rows: Tensor, names: list[str]) -> None:
        """Begins vehicles behind a leader anew, with what is known of them from elsewhere.

        Args:
            rows: of the vehicles, `(D,)` int64.
            names: their ids.

        Raises:
            DataError: no network drives one of them.
        """
        self._begin(rows, names)
        self._begin_networks(rows)

    def begin_free(self, rows: Tensor, names: list[str]) -> None:
        """Begins vehicles without a leader anew: the policy has never seen a free road.

        Args:
            rows: of the vehicles, `(D,)` int64.
            names: their ids.

        Raises:
            DataError: no network drives one of them.
        """
        self._begin(rows, names)
        table = self._vehicles.table
        table.free[rows] = True
        table.parameters[rows] = self._policy.free_road_parameters(
            table.network[rows], self._base(rows)
        )

    def renew(self, row: int) -> None:
        """Lets the memory of a vehicle begin anew; the frames of its last window stay."""
        table, rows = self._vehicles.table, torch.tensor([row])
        latent = table.latent[rows]
        self._begin_networks(rows)
        table.latent[rows] = latent

    def are_due(self, rows: Tensor, clock: Clock) -> Tensor:
        """Says whose window begins, bool `(D,)`."""
        stride = clock.steps_in(self._policy.windows.stride * self._policy.dt)
        steps = self._vehicles.table.steps.numpy()[rows.numpy()]
        return torch.from_numpy(steps % stride == 0)

    def choose(self, rows: Tensor, names: list[str], now: float, clock: Clock) -> None:
        """Chooses the parameters of those vehicles whose window begins.

        Args:
            rows: of the vehicles, `(D,)` int64.
            names: their ids.
            now: at which the model's step begins, s.
            clock: of the simulation.
        """
        due = torch.from_numpy(np.flatnonzero(self.are_due(rows, clock).numpy()))
        if len(due) == 0:
            return
        for block in due.tensor_split(-(-len(due) // _BLOCK)):
            noise = None
            if self._seed is not None:
                drawn = [names[number] for number in block.tolist()]
                noise = standard_normal(self._seed, drawn, now, self._policy.core.head.noise_width)
            self._choice.act(self._vehicles.table.drivers, rows[block], noise)

    def observe(self, rows: Tensor, clock: Clock) -> None:
        """Lets the policy see the windows that begin of vehicles that somebody else drives."""
        rows = rows[self.are_due(rows, clock)]
        if len(rows) == 0:
            return
        self._choice.observe(self._vehicles.table.drivers, rows)

    def _begin(self, rows: Tensor, names: list[str]) -> None:
        table = self._vehicles.table
        table.steps[rows] = 0
        table.driven[rows] = table.free[rows] = False
        table.told[rows] = torch.nan
        self._assignments.begin(table, rows, names)

    def _base(self, rows: Tensor) -> Tensor | None:
        if self._policy.base is None:
            return None
        return self._vehicles.table.base[rows]

    def _begin_networks(self, rows: Tensor) -> None:
        """Puts the state of the networks before their first window into the rows of vehicles."""
        table = self._vehicles.table
        context = DriverContext(self._base(rows), table.driver_features[rows])
        self._choice.begin(table.drivers, rows, context)
