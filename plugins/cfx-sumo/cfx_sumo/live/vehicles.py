"""What a live driver knows of vehicles: one table of tensors, and whose row is which.

Shapes: C vehicles, L frames of a token, n tuned parameters, m width of the model's memory, s width
of the networks' state, c features of conditioning, k driver features, q numbers that a stochastic
head keeps.
"""

from __future__ import annotations

from collections.abc import Iterable, KeysView, Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from cfx.plugin import OBSERVED, Agent, DriverRows, DrivingModel


@dataclass(frozen=True)
class VehicleTable:
    """A row per vehicle; double precision where nothing else is said.

    Attributes:
        history: `(C, 5, L)`, the signals `OBSERVED`.
        parameters: `(C, n)`, SI units.
        memory: `(C, m)`, of the model.
        state: `(C, s)`, of the networks, in their precision.
        latent: `(C, q)`, what a stochastic head keeps of its random numbers.
        network: `(C,)` int64, which of the agent's networks drives.
        base: `(C, n)`, SI units, the base parameters; NaN where the agent needs none.
        unit_base: `(C, n)`, the base in unit space, as a head needs it; `(C, 0)` where it needs
            none.
        conditioning: `(C, c)`, what networks read of each vehicle in every window.
        driver_features: `(C, k)`; NaN for unseen drivers.
        steps: `(C,)` int64, of the model since the vehicle's first window.
        time: `(C,)` s, of the last frame; NaN before the first.
        driven: `(C,)` bool; the others are watched.
        score: `(C,)`, how far outside what was learned each was when its window began.
        beyond: `(C, 2 f)`, 1 for the signals that alone were unusual then.
        free: `(C,)` bool; these drive without a leader.
        start: `(C,)` m/s, speed at the last frame.
        ramp: `(C,)` m/s2, acceleration until the next frame.
        told: `(C,)` m/s, the speed that SUMO was last told to drive; NaN before the first.
        expected: `(C, 5)`, the next frame where the model has taken several steps until then.
    """

    history: Tensor
    parameters: Tensor
    memory: Tensor
    state: Tensor
    latent: Tensor
    network: Tensor
    base: Tensor
    unit_base: Tensor
    conditioning: Tensor
    driver_features: Tensor
    steps: Tensor
    time: Tensor
    driven: Tensor
    score: Tensor
    beyond: Tensor
    free: Tensor
    start: Tensor
    ramp: Tensor
    told: Tensor
    expected: Tensor

    @classmethod
    def empty(cls, agent: Agent, model: DrivingModel, count: int) -> VehicleTable:
        """Returns rows for `count` vehicles."""
        begun = agent.begin(torch.zeros(1, dtype=torch.int64))
        state = begun.state
        length, parameters = agent.windows.length, len(agent.space)
        features = len(agent.core.driver_features)
        return cls(
            history=_unknown(count, len(OBSERVED), length),
            parameters=_unknown(count, parameters),
            memory=torch.zeros((count, model.memory_size), dtype=torch.float64),
            state=state.new_zeros((count, state.shape[-1])),
            latent=torch.zeros((count, begun.latent.shape[-1]), dtype=torch.float64),
            network=torch.zeros(count, dtype=torch.int64),
            base=_unknown(count, parameters),
            unit_base=_unknown(count, parameters if agent.core.head.needs_base else 0),
            conditioning=_unknown(count, begun.conditioning.shape[-1]),
            driver_features=_unknown(count, features),
            steps=torch.zeros(count, dtype=torch.int64),
            time=_unknown(count),
            driven=torch.zeros(count, dtype=torch.bool),
            score=torch.zeros(count, dtype=torch.float64),
            beyond=torch.zeros((count, begun.beyond.shape[-1]), dtype=torch.float64),
            free=torch.zeros(count, dtype=torch.bool),
            start=_unknown(count),
            ramp=_unknown(count),
            told=_unknown(count),
            expected=_unknown(count, len(OBSERVED)),
        )

    def columns_of(self, rows: Tensor) -> dict[str, Tensor]:
        """Returns the columns of some rows, `(D,)` int64."""
        return {column.name: getattr(self, column.name)[rows] for column in fields(self)}

    def put_columns(self, rows: Tensor, columns: Mapping[str, Tensor]) -> None:
        """Puts what `columns_of` gave into rows `(D,)`.

        Raises:
            KeyError: a column is missing.
            RuntimeError: the columns are those of another agent.
        """
        for column in fields(self):
            getattr(self, column.name)[rows] = columns[column.name]

    @property
    def drivers(self) -> DriverRows:
        """The columns that an agent reads and writes."""
        return DriverRows(
            history=self.history,
            network=self.network,
            base=self.unit_base,
            conditioning=self.conditioning,
            state=self.state,
            latent=self.latent,
            parameters=self.parameters,
            score=self.score,
            beyond=self.beyond,
        )

    def with_rows(self, more: VehicleTable) -> VehicleTable:
        """Returns these rows and then the others."""
        columns = {}
        for column in fields(self):
            both = [getattr(self, column.name), getattr(more, column.name)]
            columns[column.name] = torch.cat(both)
        return VehicleTable(**columns)


class KnownVehicles:
    """The vehicles of a live driver: a row of a table for each, and who is ahead of it.

    The row of a vehicle that leaves is used again.

    Attributes:
        table: of all rows, used or not; another one as more rows are needed.
        leaders: vehicle -> the one ahead of it at its last frame, where there was one.
    """

    def __init__(self, agent: Agent, model: DrivingModel) -> None:
        """Begins without vehicles.

        Args:
            agent: whose state is kept.
            model: whose memory is kept.
        """
        self._agent, self._model = agent, model
        self.table = VehicleTable.empty(agent, model, 0)
        self.leaders: dict[str, str] = {}
        self._row_of: dict[str, int] = {}
        self._unused: list[int] = []
        self._last: list[str] = []
        self._last_rows = torch.empty(0, dtype=torch.int64)

    @property
    def names(self) -> KeysView[str]:
        """The vehicles, in the order in which they were added."""
        return self._row_of.keys()

    def row(self, name: str) -> int | None:
        """Returns the row of a vehicle; None: it is not known."""
        return self._row_of.get(name)

    def rows(self, names: Iterable[str]) -> Tensor:
        """Returns the rows of vehicles that are known, `(D,)` int64."""
        return torch.tensor([self._row_of[name] for name in names], dtype=torch.int64)

    def add(self, names: Iterable[str]) -> Tensor:
        """Returns the rows of vehicles, `(D,)` int64; a new vehicle gets one."""
        names = list(names)
        for name in names:
            if name in self._row_of:
                continue
            if not self._unused:
                taken = len(self._row_of)
                more = VehicleTable.empty(self._agent, self._model, max(16, taken))
                self.table = self.table.with_rows(more)
                self._unused = list(range(taken, len(self.table.time)))
            self._row_of[name] = row = self._unused.pop()
            self.table.time[row] = torch.nan  # it has no frame yet
        return self.rows(names)

    def were_last(self, names: list[str]) -> bool:
        """Says whether `rows_again` was given these vehicles last, and none of them has gone."""
        return names == self._last

    def rows_again(self, names: list[str]) -> tuple[list[str], Tensor]:
        """Does what `add` does; mostly for the same vehicles, where nothing is looked up.

        Returns:
            The names and the rows: the same objects as last for the same vehicles.
        """
        if names != self._last:
            self._last_rows = self.add(names)
            self._last = names
        return self._last, self._last_rows

    def drop(self, name: str) -> None:
        """Drops a vehicle, if it is known."""
        self.leaders.pop(name, None)
        self._last, self._last_rows = [], torch.empty(0, dtype=torch.int64)
        row = self._row_of.pop(name, None)
        if row is not None:
            self._unused.append(row)


def _unknown(*shape: int) -> Tensor:
    return torch.full(shape, torch.nan, dtype=torch.float64)
