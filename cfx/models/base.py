"""The contract of a driving model.

A model is a pure function of (follower state, leader state, parameters, time step). It is batched
over any leading dimensions, differentiable almost everywhere, and runs on any device and dtype. It
never integrates: `cfx.simulation` does.

Shapes: `*batch` are the leading dimensions; leader tensors and parameters may have fewer of them
and broadcast.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor

from cfx.core.component import Component, Settings
from cfx.core.parameters import ParameterOverride, ParameterSpace
from cfx.errors import ConfigError
from cfx.models.limits import LimitSettings
from cfx.models.regimes import Temperature


class Follower(NamedTuple):
    """The simulated vehicle at one instant; all tensors `(*batch,)`.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        acceleration: the last *realised* one, `(v(t) - v(t - dt)) / dt`, m/s2.
        memory: `(*batch, m)`, what the model itself remembers; m = `DrivingModel.memory_size`.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
    memory: Tensor


class Leader(NamedTuple):
    """The vehicle ahead at the same instant; all tensors broadcast to `(*batch,)`.

    Attributes:
        position: front bumper, m.
        speed: m/s.
        acceleration: m/s2.
        length: m.
    """

    position: Tensor
    speed: Tensor
    acceleration: Tensor
    length: Tensor


class ModelSettings(Settings):
    """Settings that every model has."""

    parameters: dict[str, ParameterOverride] = Field(
        default_factory=dict,
        description="changes to the model's parameters: bounds, default, tuned or constant",
    )
    adaptation_bounds: dict[str, tuple[float, float] | None] | None = Field(
        None,
        description="what a policy of offsets (learner=rollout) may move, where that is not what"
        " calibration may: {NAME: [low, high]}, farther; {NAME: null}, not at all",
    )
    limits: LimitSettings | None = Field(
        LimitSettings(),
        description="what the vehicle can do, whatever the model wants (m/s2); null: no limits, as"
        " in the paper",
    )


class DrivingModel(Component):
    """Base of every driving model.

    Life cycle: constructed once per job. `next_speed` (and `next_memory`, if the model has a
    memory) is called once per time step for all rollouts at once, possibly inside `torch.compile`
    and under autograd.

    A subclass declares `parameters` and implements `next_speed`. That is all.

    Attributes:
        parameters: the full specification, constants included.
        memory_size: m, the width of the model's own memory; 0 for most. It may depend on settings.
        differentiable: `next_speed` has useful gradients with respect to states and parameters.
            Tested.
        collision_free: with its default parameters the model does not hit a leader that brakes as
            hard as the model expects of it. Tested.
        has_constant_baseline: with constant parameters the model reacts to its leader. A model
            without that has parameters that are the control itself. Constant ones are then no
            baseline, and reports do not compare with them. Tested.
        search_effort: how many times the usual evaluations a search for its parameters takes. Above
            1 for a model whose losses have narrow valleys or jumps, so that searches of the usual
            length end above the optimum (`python -m tests.benchmarks.optimum` says so).
        likelihood_power: power of the likelihood in posteriors. Below 1 for a model whose regimes
            jump: errors of the start and of each measured state decide which regime a driver is in,
            which no noise describes, and intervals would be too narrow (`calibration.posterior`).
        needs_simulator: name of the simulator that alone can drive the model; "" for a model with
            equations in Python, which every simulator that uses them can drive. Where it is given,
            `next_speed` raises a ConfigError.
        reference: where the equations come from.
        temperature: how gradually regimes switch; 0 is the exact model. It is 0 everywhere but in
            training through the simulation (`at_temperature`).
    """

    kind = "model"
    schema: ClassVar[type[Settings]] = ModelSettings
    settings: ModelSettings

    parameters: ClassVar[ParameterSpace]
    memory_size: int = 0
    differentiable: ClassVar[bool] = True
    collision_free: ClassVar[bool] = False
    has_constant_baseline: ClassVar[bool] = True
    search_effort: ClassVar[float] = 1.0
    likelihood_power: ClassVar[float] = 1.0
    needs_simulator: ClassVar[str] = ""
    reference: ClassVar[str] = ""
    temperature: Temperature = 0.0

    def __init__(self, settings: Settings | None = None, **options: object) -> None:
        super().__init__(settings, **options)
        declared = self.parameters.for_settings(self.settings)
        self.space = declared.override(self.settings.parameters)
        self._adaptation_bounds = self.settings.adaptation_bounds or {}
        self.space.for_adaptation(self._adaptation_bounds)  # says now what is wrong with them

    @classmethod
    def complaint(cls) -> str:
        space = getattr(cls, "parameters", None)
        if not isinstance(space, ParameterSpace):
            return (
                ": its attribute 'parameters' must be a cfx.plugin.ParameterSpace,"
                f" not {type(space).__name__}"
            )
        if not space.tuned and not space.open:
            return ": at least one of its parameters must be tuned"
        return ""

    def refuse_unused(self) -> None:
        """Refuses to tune or set parameters that the model does not use with its settings.

        A job asks for this. A saved policy that answers such a parameter still drives.

        Raises:
            ConfigError: a key of `model.parameters.NAME` of such a parameter says otherwise than
                the model declares.
        """
        for declared in self.parameters:
            if declared.is_used(self.settings):
                continue
            parameter = self.space[declared.name]
            changed = []
            for key in ("low", "high", "default"):
                if getattr(parameter, key) != getattr(declared, key):
                    changed.append(key)
            if parameter.tuned:
                changed.append("tuned")
            if not changed:
                continue
            assert declared.used_with is not None
            setting, value = declared.used_with
            chosen = getattr(self.settings, setting)
            written = f"{getattr(parameter, changed[0])}".lower()
            raise ConfigError(
                f"model.parameters.{parameter.name}.{changed[0]}={written}: the model does not use"
                f" {parameter.name} with model.{setting}={chosen}, so it does nothing; leave it"
                f" out, or set model.{setting}={value}"
            )

    def equations_key(self) -> str:
        """Returns what the equations depend on besides the class; parameters are inputs of them."""
        return self.settings.model_dump_json(exclude={"parameters"})

    @property
    def limits(self) -> LimitSettings | None:
        """The vehicle's limits, which every step keeps to; None: no limits."""
        return self.settings.limits

    @property
    def brakes_within_bounds(self) -> bool:
        """Whether nothing makes the vehicle brake harder than a vehicle can."""
        return self.limits is not None

    @property
    def adaptation_space(self) -> ParameterSpace:
        """The parameters in the bounds within which a policy of offsets moves them.

        They are those of `space`, or wider.
        """
        return self.space.for_adaptation(self._adaptation_bounds)

    def at_temperature(self, temperature: Temperature) -> Self:
        """Returns the model with its regime switches smoothed, for training by gradients.

        A model that chooses between cases reads `self.temperature` in `next_speed`. Where that is
        not 0, it mixes the cases near their thresholds (`cfx.models.regimes`). In all others
        nothing changes.

        Args:
            temperature: how gradual the switches are, in multiples of the model's own scales; 0 is
                the exact model.
        """
        model = copy.copy(self)
        model.temperature = temperature
        return model

    @abstractmethod
    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        """Returns the follower's speed one time step later.

        Args:
            follower: its state at time t.
            leader: its state at time t.
            p: one tensor per parameter, by name, each broadcasting to `(*batch,)`.
            dt: time step, s.

        Returns:
            `(*batch,)`, m/s, not negative, in the dtype of the states.
        """

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        """Returns the memory `(*batch, m)` one time step later.

        Args:
            speed: what `next_speed` returned, `(*batch,)`, m/s. The others as there.
        """
        return follower.memory

    def initial_memory(self, speed: Tensor) -> Tensor:
        """Returns the memory `(*batch, m)` at the start of a rollout.

        Args:
            speed: of the followers, `(*batch,)`, m/s.
        """
        return torch.zeros((*speed.shape, self.memory_size), dtype=speed.dtype, device=speed.device)


def bumper_gap(follower: Follower, leader: Leader) -> Tensor:
    """Returns the net gap `(*batch,)`, m: leader's rear bumper to follower's front bumper.

    It is negative after a collision.
    """
    return leader.position - leader.length - follower.position
