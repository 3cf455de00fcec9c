"""The agent, which drives in evaluation, platoons and SUMO, and is saved as a policy.

Each class says one thing. `AgentCore` is the policy itself: networks with their scaler, their
inputs and their head, as pure functions, which training uses too. `AgentState` is what is
remembered of drivers between two windows. `Agent` drives many of them, window by window;
`cfx.policies.driver_step.DriverStep` drives step by step, for other programs. What an agent is told
of drivers beforehand is a `DriverContext`, which `cfx.policies.known_drivers` measures.

Life cycle for D drivers: `begin` once; `observe` (or `burn_in` over measured history) any number of
times; then `act` once per window.

Shapes: N networks, D drivers in any order, B drivers of the network that has most, L frames of a
token, n tuned parameters, c features of conditioning, s width of the networks' state, q numbers
that a stochastic head keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.parameters import ParameterSpace
from cfx.data.pairs import PairBatch
from cfx.errors import DataError, PluginError
from cfx.policies.context import UNSEEN, ContextRule, DriverContext, ExpectedError
from cfx.policies.core import ANY_DRIVER, AgentCore, driver_places
from cfx.policies.heads.offset import blended
from cfx.policies.history import History, measured_history
from cfx.policies.population import DriverPopulation
from cfx.policies.valid_range import RANGE_SIGNALS, ValidRange, situation_of, weight_of_answer
from cfx.simulation.base import Stepper
from cfx.simulation.windows import WindowSettings

_OF_DRIVERS = ("conditioning", "score", "beyond", "latent")


class AgentState(NamedTuple):
    """State of D drivers between two windows.

    Attributes:
        network: which network drives each, `(D,)` int64.
        place: its place among that network's drivers, `(D,)` int64.
        state: of the networks, `(N, B, s)`.
        base: `(D, n)` in unit space; None where the head needs none.
        conditioning: what networks read of each driver in every window, `(D, c)`.
        score: how far the last window's situation was outside of those learned from, `(D,)`: up to
            1 is inside. 0 if the policy has no `valid_range`.
        beyond: which of f signals were, each by itself, outside of what was learned from, bool
            `(D, 2 f)`: below it in the first f columns, above it in the others.
        latent: what a stochastic head keeps from one window to the next, since its noise is
            correlated in time, `(D, q)`; 0 at the start.
    """

    network: Tensor
    place: Tensor
    state: Tensor
    base: Tensor | None
    conditioning: Tensor
    score: Tensor
    beyond: Tensor
    latent: Tensor

    def of(self, drivers: Tensor) -> AgentState:
        """Returns the state of some of the drivers, each as often as it is named.

        Args:
            drivers: their indices, `(E,)`.
        """
        network = self.network[drivers]
        place = driver_places(network)
        shape = (self.state.shape[0], int(place.max()) + 1, *self.state.shape[2:])
        state = self.state.new_zeros(shape)
        state[network, place] = self.state[network, self.place[drivers]]
        of_drivers = {name: getattr(self, name)[drivers] for name in _OF_DRIVERS}
        base = self.base
        if base is not None:
            base = base[drivers]
        return AgentState(network=network, place=place, state=state, base=base, **of_drivers)


@dataclass(frozen=True)
class TrainedOn:
    """Training data of a policy, and how it did on drivers left out of them, as far as known.

    Attributes:
        pairs: those that were learned from or calibrated on: `Pair.likeness` and the driver's name.
        quantiles: 5, 50 and 95 % of speed (m/s), acceleration (m/s2) and time gap (s) of the
            drivers; empty if they are not known.
        expected_error: how large errors were on left-out drivers; None if that was not measured.
        drivers: driver features of those learned from. A simulated fleet draws its drivers from
            them. None for a policy that reads no driver features.
    """

    pairs: Mapping[str, str] = field(default_factory=dict)
    quantiles: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    expected_error: ExpectedError | None = None
    drivers: DriverPopulation | None = None


@dataclass(frozen=True)
class Agent:
    """N networks that are ready to drive.

    Attributes:
        core: the networks with their scaler, inputs and head.
        model_node, policy_node: config nodes of the driving model and of the policy.
        windows: how often parameters change, and how many frames a token holds.
        dt: time step, s.
        names: what each network was trained for (a pair's id, a fold, or `ALL`), N of them.
        base: parameters that answers refer to for drivers without a base of their own, `(N, n)`, SI
            units; None where the head needs none.
        context_rule: how a driver's context is made.
        pooled: pooled parameters calibrated on the drivers that each network learned from,
            `(N, n)`, SI units; None if there are none.
        trained_on: what it learned from.
        valid_range: the situations that each network learned from; None if they are not known.
            Outside, answers fade towards the base, or towards the pooled parameters where the head
            has no base.
        dispersion: factor on the noise of each network, `(N,)`, with which sampled forecasts of
            drivers kept for validation are wide enough; None: 1.
    """

    core: AgentCore
    model_node: Mapping[str, Any]
    policy_node: Mapping[str, Any]
    windows: WindowSettings
    dt: float
    names: tuple[str, ...]
    base: Tensor | None = None
    context_rule: ContextRule = field(default_factory=ContextRule)
    pooled: Tensor | None = None
    trained_on: TrainedOn = field(default_factory=TrainedOn)
    valid_range: ValidRange | None = None
    dispersion: Tensor | None = None

    @property
    def space(self) -> ParameterSpace:
        """The parameters that the agent chooses, with their bounds."""
        return self.core.head.space

    def stepper(self, stepper: Stepper) -> Stepper:
        """Returns what takes the steps of the model that this agent drives.

        Args:
            stepper: takes those of the job's driving model.

        Raises:
            ConfigError: the head needs a model around it, which this simulator does not have.
        """
        model = self.core.head.driven_model(stepper.model)
        if model is stepper.model:
            return stepper
        return stepper.for_model(model)

    def begin(self, network: Tensor, context: DriverContext = UNSEEN) -> AgentState:
        """Returns the state of D drivers before their first window.

        Args:
            network: which network drives each, `(D,)`.
            context: what is known of them.
        """
        place = driver_places(network)
        base = self._unit_base(network, context)
        read_of_base = base
        if read_of_base is None:
            # Zero columns: a head without a base has nothing of it among the networks' inputs.
            read_of_base = self.core.scaler.mean.new_zeros((len(network), 0)).double()
        features = self._known_features(network, context)
        state = self.core.network.initial_state(len(self.names), int(place.max()) + 1)
        conditioning = self.core.condition(read_of_base, features)
        score = torch.zeros(len(network), dtype=torch.float64, device=network.device)
        unusual = (len(network), 2 * len(RANGE_SIGNALS))
        beyond = torch.zeros(unusual, dtype=torch.bool, device=network.device)
        latent = score.new_zeros((len(network), self.core.head.latent_width))
        return AgentState(network, place, state, base, conditioning, score, beyond, latent)

    def observe(self, history: History, state: AgentState, present: Tensor) -> AgentState:
        """Lets networks see one window of D drivers without acting.

        Args:
            history: the last `windows.length` frames, `(D, L)` each, SI units.
            state: where the drivers stand.
            present: which of them have this window; the others keep their state, bool `(D,)`.
        """
        grid = self._features(history, state)
        observes = torch.zeros(grid.shape[:2], dtype=torch.bool, device=grid.device)
        observes[state.network, state.place] = present
        with torch.no_grad():
            return state._replace(state=self.core.observe(grid, state.state, observes))

    @torch.no_grad()
    def act(
        self,
        history: History,
        state: AgentState,
        generator: torch.Generator | None = None,
        *,
        noise: Tensor | None = None,
    ) -> tuple[Tensor, AgentState]:
        """Chooses the parameters of the next window.

        Outside the situations that were learned from, the answer fades towards the base.

        Args:
            history: the last `windows.length` frames of D drivers, `(D, L)` each, SI units.
            state: where they stand.
            generator: draws, on the CPU, what a stochastic head leaves to chance; None: nothing is
                drawn.
            noise: what was drawn already, as for `choose`.

        Returns:
            Parameters `(D, n)` in SI units, in the dtype of the history, and the state afterwards.

        Raises:
            PluginError: the networks answer numbers that are not finite.
        """
        answer, after = self._answer(history, state)
        self.require_finite(answer)
        if generator is not None and self.core.head.is_stochastic:
            shape = (len(answer), self.core.head.noise_width)
            noise = torch.randn(shape, generator=generator, dtype=torch.float64)
        return self.apply(answer, history, after, noise)

    def require_finite(self, answer: Tensor) -> None:
        """Checks answers of the networks.

        Raises:
            PluginError: they are not finite.
        """
        if not bool(answer.isfinite().all()):
            raise PluginError(
                f"{registry.origin(self.core.policy)}: its networks answer numbers that are not"
                " finite; train with a smaller learner.learning_rate, or repair that policy"
            )

    def choose(
        self, history: History, state: AgentState, noise: Tensor | None = None
    ) -> tuple[Tensor, AgentState]:
        """As `act`, without branches that depend on values, so that it can be exported (ONNX).

        Args:
            history: the last `windows.length` frames of D drivers, `(D, L)` each, SI units.
            state: where they stand.
            noise: standard normal, `(D, k)`, for what a stochastic head leaves to chance; None:
                nothing is drawn.

        Returns:
            As `act`. Answers of the networks that are not finite make parameters that are not.
        """
        answer, after = self._answer(history, state)
        return self.apply(answer, history, after, noise)

    def free_road_parameters(self, network: Tensor, base: Tensor | None) -> Tensor:
        """Returns the parameters of D drivers whom nobody is ahead of, `(D, n)`, SI units.

        Networks learn from followers alone, so they are not asked. These are the parameters that
        answers fade to outside the situations learned from: the base, else the pooled parameters,
        else the model's defaults.

        Args:
            network: which network drives each, `(D,)`.
            base: of each driver, `(D, n)`, SI units; None where the head needs none.
        """
        if base is not None:
            return base
        if self.pooled is not None:
            return self.core.head.completed(self.pooled[network].double())
        return self.space.defaults().double().expand(len(network), -1)

    def burn_in(
        self, batch: PairBatch, until: Tensor, state: AgentState, since: Tensor | None = None
    ) -> AgentState:
        """Lets networks observe the measured history of D drivers.

        Args:
            batch: their D pairs.
            until: `(D,)`, the frame at which each starts to drive; windows that start before it are
                observed.
            state: where the drivers stand.
            since: `(D,)`, the frame from which on; None: the first.
        """
        if state.state.shape[-1] == 0:
            return state  # networks without memory, as of constants: there is nothing to observe
        if since is None:
            since = torch.zeros_like(until)
        stride = self.windows.stride
        pairs = torch.arange(len(batch), device=until.device)
        for first in range(int(since.min()) // stride * stride, int(until.max()), stride):
            frame = torch.full_like(until, first)
            history = measured_history(batch, pairs, frame, self.windows.length)
            state = self.observe(history, state, (frame < until) & (frame >= since))
        return state

    def for_unseen_drivers(self) -> Agent:
        """Returns the agent with one network for any driver: the only one, or the one named `all`.

        Raises:
            DataError: each network is for a pair of its own.
        """
        if len(self.names) == 1:
            return self
        if ANY_DRIVER not in self.names:
            raise DataError(
                f"the policy has {len(self.names)} networks, one for each of its own pairs, and"
                " none for others; train one with protocol.networks=all or protocol=across_drivers"
            )
        return self.only(torch.tensor([self.names.index(ANY_DRIVER)]))

    def for_live_driving(self) -> Agent:
        """Returns the agent as it drives vehicles live: with the noise that was learned alone.

        The factor `dispersion` makes forecasts wide enough. For a driver of whom nothing is known
        it stands for not knowing who drives, too; a vehicle that varied so much from one second to
        the next would be no driver. Platoons then amplify each dip, and rings jam (docs/tried.md).
        """
        return replace(self, dispersion=None)

    def only(self, numbers: Tensor) -> Agent:
        """Returns the agent with some of its networks, `(M,)` int64, which are numbered anew."""
        names = tuple([self.names[number] for number in numbers.tolist()])
        core = self.core.only(numbers)
        chosen = self._each(lambda values: values[numbers.to(values.device)])
        return replace(chosen, core=core, names=names)

    def to(self, device: torch.device) -> Agent:
        """Moves everything to a device."""
        moved = self._each(lambda values: values.to(device))
        return replace(moved, core=self.core.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Agent:
        """Returns the agent with each tensor of its networks, `(N, ...)`, changed alike."""
        changed: dict[str, Any] = {}
        for name in ("base", "pooled", "dispersion"):
            value = getattr(self, name)
            if value is not None:
                changed[name] = change(value)
        if self.valid_range is not None:
            changed["valid_range"] = ValidRange(*map(change, self.valid_range))
        return replace(self, **changed)

    def _answer(self, history: History, state: AgentState) -> tuple[Tensor, AgentState]:
        """Returns the networks' answers `(D, n)`, in the history's dtype, and their state."""
        answers, after = self.core.answer(self._features(history, state), state.state)
        answer = answers[state.network, state.place].to(history["follower_speed"].dtype)
        return answer, state._replace(state=after)

    def apply(
        self, answer: Tensor, history: History, state: AgentState, noise: Tensor | None
    ) -> tuple[Tensor, AgentState]:
        """Turns the networks' answers into parameters `(D, n)`, SI units; returns the state too.

        Args:
            answer: of the networks, `(D, n)`.
            history: as for `act`.
            state: where the drivers stand; of the networks' own state nothing is read.
            noise: as for `choose`.
        """
        if self.valid_range is not None:
            situation = situation_of(history)
            learned = ValidRange(*(self._of(values, state.network) for values in self.valid_range))
            score, beyond = learned.score(situation), learned.beyond(situation)
            state = state._replace(score=score, beyond=beyond)
        unit = self._faded(answer.double(), state).to(answer.dtype)
        chosen = self.core.head.measured(self.space.from_unit(unit), history, self.dt)
        if noise is None:
            return chosen, state
        noise = noise.to(chosen)
        if self.dispersion is not None:
            noise = noise * self._of(self.dispersion, state.network)[:, None].to(noise)
        window_s = self.windows.stride * self.dt
        drawn, latent = self.core.head.sampled(chosen, noise, state.latent.to(chosen), window_s)
        return drawn, state._replace(latent=latent.to(state.latent))

    def _faded(self, answer: Tensor, state: AgentState) -> Tensor:
        """Returns parameters `(D, n)`, unit space: answers, faded in unusual situations."""
        unit = self.core.head.unit_parameters(answer, state.base)
        fallback = state.base
        if fallback is None:
            if self.pooled is None:
                return unit
            pooled = self._of(self.pooled, state.network).double()
            fallback = self.space.to_unit(self.core.head.completed(pooled))
        weight = weight_of_answer(state.score)[:, None]
        return torch.where(weight < 1.0, blended(fallback, unit, weight), unit)

    def _of(self, values: Tensor, network: Tensor) -> Tensor:
        """Returns what each driver's network has of values `(N, *batch)`, `(D, *batch)`."""
        if len(self.names) == 1:
            return values.expand(network.shape[0], *values.shape[1:])
        return values[network]

    def _unit_base(self, network: Tensor, context: DriverContext) -> Tensor | None:
        """Returns the drivers' base in unit space, `(D, n)`, in double precision."""
        if not self.core.head.needs_base:
            return None
        base = context.base
        if base is None:
            if self.base is None:
                name = self.core.head.name
                raise ValueError(f"the {name} head needs a base, and this agent has none")
            base = self.base[network]
        return self.space.to_unit(self.core.head.completed(base.double()))

    def _known_features(self, network: Tensor, context: DriverContext) -> Tensor | None:
        """Returns driver features `(D, k)`, the training drivers' mean where they are unknown."""
        count = len(self.core.driver_features)
        if count == 0:
            return None
        usual = self.core.scaler.mean[network, -count:].double()
        features = context.driver_features
        if features is None:
            return usual
        return torch.where(features.isnan(), usual, features.to(usual))

    def _features(self, history: History, state: AgentState) -> Tensor:
        """Returns what the networks read, `(N, B, f + c)`, not normalised; 0 at empty places.

        Raises:
            DataError: the history lacks a signal that an input of the policy reads.
        """
        for signal in self.core.further_signals:
            if signal.name not in history:
                raise DataError(
                    f"an input of the policy reads the signal '{signal.name}' ({signal.meaning}),"
                    f" which is not there; give a recording with a column {signal.column}, read by"
                    " data=tidy data.inputs=[...]"
                )
        situation = self.core.encode(history)
        features = torch.cat([situation, state.conditioning.to(situation.dtype)], -1)
        networks, drivers, _ = state.state.shape
        grid = self.core.scaler.mean.new_zeros((networks, drivers, features.shape[-1]))
        grid[state.network, state.place] = features.to(grid.dtype)
        return grid
