"""One step of drivers: what a policy drives with in any simulator, as a pure function of tensors.

The policy, its head, the driving model and the guard are one function from what a driver sees and
what is remembered of them to their next speed. It knows no simulator: live drivers in other
programs, environments for reinforcement learning and exported networks are made of it.

Shapes: D drivers, L frames of a token, n tuned parameters, m width of the model's memory, s width
of the network's state, q numbers that a stochastic head keeps, k random numbers of a window, g
signals: those of `OBSERVED`, then further ones that inputs of the policy read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.core.registry import create
from cfx.data.signals import OBSERVED
from cfx.errors import ConfigError, DataError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.policies.agent import Agent, AgentState
from cfx.policies.context import UNSEEN, DriverContext
from cfx.simulation.step import advance_vehicle

FREE_ROAD_M = 1e6
"""m: a vehicle this far ahead is none, and the road is free; so is a gap of infinity."""

_FOLLOWER_SPEED, _GAP = OBSERVED.index("follower_speed"), OBSERVED.index("gap")
"""Columns of a frame."""


class Motion(NamedTuple):
    """Motion of D vehicles at one instant.

    Attributes:
        speed: `(D,)`, m/s.
        acceleration: the last realised one, `(v(t) - v(t - dt)) / dt`, `(D,)`, m/s2.
    """

    speed: Tensor
    acceleration: Tensor


class DriverState(NamedTuple):
    """What is remembered of D drivers between two steps; all 0 for a driver who begins.

    Attributes:
        steps: since the driver began, `(D,)` int64.
        history: the signals of `DriverStep.signals` at the last L frames, `(D, g, L)`, SI units.
        parameters: those that hold in this window, `(D, n)`, SI units.
        memory: of the model, `(D, m)`.
        network: of the policy's network, `(D, s)`, in its precision.
        latent: what a stochastic head keeps of its random numbers, `(D, q)`.
        score: how far outside what was learned each was when the window began, `(D,)`; up to 1 is
            inside.
    """

    steps: Tensor
    history: Tensor
    parameters: Tensor
    memory: Tensor
    network: Tensor
    latent: Tensor
    score: Tensor

    def of(self, drivers: Tensor) -> DriverState:
        """Returns the state of some of the drivers, by their indices or a bool for each."""
        return DriverState(*(value[drivers] for value in self))

    def with_drivers(self, drivers: Tensor, other: DriverState) -> DriverState:
        """Returns the state with another of some of the drivers, by their indices."""
        columns = []
        for value, new in zip(self, other, strict=True):
            columns.append(value.index_copy(0, drivers, new))
        return DriverState(*columns)


class DriverStep:
    """Advances drivers of one network by one time step after the other.

    State is passed in and returned, never kept. It is the closed loop in which cfx evaluates a
    policy, to the last bits; with noise, that of one driver (`Agent.for_live_driving`).

    On a free road, where the gap is infinity, the policy's own model drives with
    `Agent.free_road_parameters`, and what is said of a leader does not count. Behind the next
    leader a driver begins anew, as live drivers in SUMO do.

    Args:
        agent: chooses parameters; one network of it drives all.
        context: of the drivers, one for all: a base `(1, n)` and driver features `(1, k)`.

    Raises:
        DataError: the agent has a network for each of its own drivers, and none for others.
        ConfigError: the equations of its driving model are in a simulator only.

    Attributes:
        agent: the agent with that one network.
        model: what it drives: its driving model, or one around it.
        dt: the time step, s.
        noise_width: k; 0: nothing is left to chance.
        further_signals: what inputs of the policy read beyond the motion of both vehicles and the
            gap; each step is given them too.
        signals: names of all g signals, in the order of `DriverState.history`.
    """

    def __init__(self, agent: Agent, context: DriverContext = UNSEEN) -> None:
        self.agent = agent.for_unseen_drivers().for_live_driving()
        model = create("model", agent.model_node)
        assert isinstance(model, DrivingModel)
        if model.needs_simulator:
            raise ConfigError(
                f"model={agent.model_node['name']} has equations in {model.needs_simulator} only,"
                " so that nothing else can drive it; give a policy of a model that cfx has, such as"
                " krauss or idm"
            )
        self.model = self.agent.core.head.driven_model(model)
        self.dt = self.agent.dt
        self.noise_width = self.agent.core.head.noise_width
        self.further_signals = self.agent.core.further_signals
        self.signals = (*OBSERVED, *(signal.name for signal in self.further_signals))
        self._begun = self.agent.begin(torch.zeros(1, dtype=torch.int64), context)
        base = self._begun.base
        if base is not None:
            base = self.agent.space.from_unit(base)
        self._free_parameters = self.agent.free_road_parameters(self._begun.network, base)

    def begin(self, drivers: int) -> DriverState:
        """Returns the state of D drivers before their first step: zeros."""
        begun = self._begun
        signals, length = len(self.signals), self.agent.windows.length
        return DriverState(
            torch.zeros(drivers, dtype=torch.int64),
            torch.zeros((drivers, signals, length), dtype=torch.float64),
            torch.zeros((drivers, len(self.agent.space)), dtype=torch.float64),
            torch.zeros((drivers, self.model.memory_size), dtype=torch.float64),
            begun.state.new_zeros((drivers, begun.state.shape[-1])),
            torch.zeros((drivers, begun.latent.shape[-1]), dtype=torch.float64),
            torch.zeros(drivers, dtype=torch.float64),
        )

    @torch.no_grad()
    def __call__(
        self,
        state: DriverState,
        ego: Motion,
        leader: Motion,
        gap: Tensor,
        noise: Tensor | None = None,
        surroundings: Mapping[str, Tensor] | None = None,
    ) -> tuple[Tensor, DriverState]:
        """Returns the next speeds of D drivers.

        Args:
            state: what is remembered of them.
            ego: their vehicles.
            leader: the vehicles ahead.
            gap: bumper to bumper, `(D,)`, m; infinity: nobody is ahead.
            noise: standard normal, `(D, k)`, of which a driver whose window begins draws; None:
                nothing is drawn.
            surroundings: the policy's further signals, by name, `(D,)` each; None where it has
                none.

        Returns:
            Speeds one time step later, `(D,)`, m/s, and the state then.

        Raises:
            DataError: a signal is missing or not a number, or infinite where it is not the gap of a
                free road.
        """
        leader, gap = _as_known(ego, leader, gap)
        frame = self._frame(ego, leader, gap, surroundings)
        if not bool(frame.isfinite().all()):
            raise DataError(self._not_finite(frame))
        state = self._remembered(state, frame)
        due = self._is_due(state).nonzero().flatten()
        if len(due):
            drawn = noise
            if drawn is not None:
                drawn = drawn[due]
            state = state.with_drivers(due, self._chosen(state.of(due), drawn))
        return self._advanced(state, ego, leader, gap)

    def unbranched(
        self,
        state: DriverState,
        ego: Motion,
        leader: Motion,
        gap: Tensor,
        noise: Tensor | None = None,
        surroundings: Mapping[str, Tensor] | None = None,
    ) -> tuple[Tensor, DriverState]:
        """As a call, but no value branches, so that the step exports to other runtimes.

        The network answers for every driver in every step, and the answer counts where a window
        begins. Signals that a call refuses make the speed of their driver NaN.
        """
        leader, gap = _as_known(ego, leader, gap)
        frame = self._frame(ego, leader, gap, surroundings)
        state = self._remembered(state, frame)
        due = self._is_due(state)
        columns = []
        for new, old in zip(self._chosen(state, noise), state, strict=True):
            columns.append(torch.where(_as_wide(due, old), new, old))
        speed, after = self._advanced(DriverState(*columns), ego, leader, gap)
        # Bounds of a model may turn NaN into a number.
        return torch.where(frame.isfinite().all(1), speed, torch.nan), after

    def _remembered(self, state: DriverState, frame: Tensor) -> DriverState:
        """Returns the state with this instant; a first frame stands for those before it.

        A driver begins anew where a leader appears, and where there is none any more.

        Args:
            state: before it.
            frame: `(D, g)`.
        """
        is_free = frame[:, _GAP] >= FREE_ROAD_M
        begins = (state.steps == 0) | (is_free != _on_free_road(state))
        signals = frame[..., None]
        going = torch.cat([state.history[..., 1:], signals], -1)
        initial = self.model.initial_memory(frame[:, _FOLLOWER_SPEED])
        chosen = torch.where(is_free[:, None], self._free_parameters, state.parameters)
        return state._replace(
            steps=torch.where(begins, 0, state.steps),
            history=torch.where(_as_wide(begins, going), signals, going),
            parameters=torch.where(begins[:, None], chosen, state.parameters),
            memory=torch.where(_as_wide(begins, initial), initial, state.memory),
            network=torch.where(begins[:, None], self._begun.state[0], state.network),
            latent=torch.where(begins[:, None], 0.0, state.latent),
            score=torch.where(begins, 0.0, state.score),
        )

    def _is_due(self, state: DriverState) -> Tensor:
        """Says for which drivers a window of the policy begins, bool `(D,)`."""
        return (state.steps % self.agent.windows.stride == 0) & ~_on_free_road(state)

    def _chosen(self, state: DriverState, noise: Tensor | None) -> DriverState:
        """Returns the state of drivers whose window begins with their new parameters."""
        begun, count = self._begun, state.steps.shape[0]  # `len` would export it as a constant
        base = begun.base
        if base is not None:
            base = base.expand(count, -1)
        before = AgentState(
            begun.network.expand(count),
            torch.arange(count, device=begun.network.device),
            state.network[None],
            base,
            begun.conditioning.expand(count, -1),
            state.score,
            begun.beyond.expand(count, -1),
            state.latent,
        )
        history = dict(zip(self.signals, state.history.unbind(1), strict=True))
        chosen, after = self.agent.choose(history, before, noise)
        return state._replace(
            parameters=chosen, network=after.state[0], latent=after.latent, score=after.score
        )

    def _frame(
        self,
        ego: Motion,
        leader: Motion,
        gap: Tensor,
        surroundings: Mapping[str, Tensor] | None,
    ) -> Tensor:
        """Returns the signals at one instant, `(D, g)`.

        Raises:
            DataError: a further signal is missing.
        """
        signals = [leader.speed, leader.acceleration, ego.speed, ego.acceleration, gap]
        for signal in self.further_signals:
            if surroundings is None or signal.name not in surroundings:
                raise DataError(
                    f"an input of the policy reads the signal '{signal.name}' ({signal.meaning},"
                    f" {signal.unit or 'without a unit'}), which is not given; pass it in each step"
                    f" as surroundings={{'{signal.name}': ...}}"
                )
            signals.append(surroundings[signal.name])
        return torch.stack(signals, -1)

    def _not_finite(self, frame: Tensor) -> str:
        """Says which signal of a frame `(D, g)` is not finite, in words."""
        driver, signal = (~frame.isfinite()).nonzero()[0].tolist()
        return (
            f"{self.signals[signal]} of driver {driver} is {float(frame[driver, signal]):g}; give a"
            " number for each signal (m/s, m/s2, m), and gap=inf where nobody is ahead"
        )

    def _advanced(
        self, state: DriverState, ego: Motion, leader: Motion, gap: Tensor
    ) -> tuple[Tensor, DriverState]:
        """Takes the model's step within the limits of the vehicle."""
        zero = torch.zeros_like(gap)
        after = advance_vehicle(
            self.model,
            Follower(zero, ego.speed, ego.acceleration, state.memory),
            Leader(gap, leader.speed, leader.acceleration, zero),
            self.agent.space.unpack(state.parameters),
            self.dt,
        )
        return after.speed, state._replace(steps=state.steps + 1, memory=after.memory)


def _as_known(ego: Motion, leader: Motion, gap: Tensor) -> tuple[Motion, Tensor]:
    """Returns leaders and gaps; on a free road a leader who drives as the ego does, far ahead."""
    is_free = gap >= FREE_ROAD_M
    speed = torch.where(is_free, ego.speed, leader.speed)
    acceleration = torch.where(is_free, 0.0, leader.acceleration)
    return Motion(speed, acceleration), torch.where(is_free, FREE_ROAD_M, gap)


def _on_free_road(state: DriverState) -> Tensor:
    """Says who had nobody ahead at the last frame, bool `(D,)`."""
    return state.history[:, _GAP, -1] >= FREE_ROAD_M


def _as_wide(drivers: Tensor, columns: Tensor) -> Tensor:
    """Returns a bool for each driver, `(D,)`, in as many dimensions as a tensor `(D, ...)`."""
    return drivers.view(-1, *[1] * (columns.dim() - 1))
