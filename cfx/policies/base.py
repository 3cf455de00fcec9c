"""The contract of a policy: recent states in, parameters for the next window out.

Shapes: N independent networks, B drivers of each, W windows, f features of a token, n tuned
parameters, s width of the state. N networks are trained and used as one batched network: 94 pairs
with a network each cost about as much as one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import torch
from pydantic import BeforeValidator, Field
from torch import Tensor, nn

from cfx.core import registry
from cfx.core.component import Component, Settings
from cfx.policies.driver_features import DRIVER_FEATURE_SETS, DRIVER_FEATURES
from cfx.policies.features import Summary, named
from cfx.policies.inputs import INPUT_SETS, SITUATION

if TYPE_CHECKING:
    from cfx.models.base import DrivingModel
    from cfx.simulation.settings import WindowSettings


class PolicyNetwork(nn.Module, ABC):
    """N independent networks in one module; state is passed in and returned, never kept on self.

    Every parameter and buffer has N as its first dimension, and network i reads only slice i of
    everything: so the sum of N losses trains N networks independently.
    """

    @abstractmethod
    def initial_state(self, networks: int, drivers: int) -> Tensor:
        """Returns the state `(N, B, s)` before the first window; s may be 0."""

    def observe(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Updates the state with windows of measured driving.

        Args:
            tokens: `(N, B, W, f)`, normalised.
            state: `(N, B, s)`.

        Returns:
            The state after the last window.
        """
        return self(tokens, state)[1]  # type: ignore[no-any-return]  # torch's modules are untyped

    @abstractmethod
    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Reads windows in order, and chooses the parameters of each.

        Args:
            tokens: `(N, B, W, f)`, normalised.
            state: `(N, B, s)`.

        Returns:
            Parameters in unit space `(N, B, W, n)`, within [0, 1], and the state after the last
            window. Reading W windows at once or one by one gives the same.
        """

    def act_once(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Chooses the parameters of one window, to the bits those of `forward`.

        It is for drivers who act now, of whom no gradient is asked: a network may compute in place.

        Args:
            tokens: `(N, B, f)`, normalised.
            state: `(N, B, s)`.

        Returns:
            Parameters in unit space `(N, B, n)`, and the state afterwards.
        """
        answers, after = self(tokens[:, :, None], state)
        return answers[:, :, 0], after


_NAMED_INPUTS = named(INPUT_SETS, partial(registry.names, "input"), "input")
_NAMED_FEATURES = named(DRIVER_FEATURE_SETS, DRIVER_FEATURES.keys, "driver feature")


class PolicySettings(Settings):
    """Settings of policies that read states."""

    inputs: Annotated[tuple[str, ...], BeforeValidator(_NAMED_INPUTS)] = Field(
        SITUATION,
        description="signals that the policy sees, of leader_speed, follower_speed, gap,"
        " relative_speed, time_headway, leader_acceleration, follower_acceleration,"
        " inverse_time_to_collision, leader_jerk and follower_jerk; or the name of a set, also in a"
        " list, as in [situation, leader_jerk]: speeds, the paper's two; situation, the default;"
        " motion, the situation and both jerks, for smooth models",
    )
    summary: Summary = Field(
        "frames",
        description="how a window's frames become features: frames (all), last, mean, mean_std",
    )
    driver_features: Annotated[tuple[str, ...], BeforeValidator(_NAMED_FEATURES)] = Field(
        (),
        description="features of a driver, measured from their history, that condition the policy"
        " (learner=rollout): time_headway, time_gap, standstill_gap, speed_difference,"
        " acceleration, response_time; or all. Unseen drivers have none.",
    )


class ResidualSettings(Settings):
    """Settings of policies that are not trained, beside parameters."""

    residual: bool = Field(
        False,
        description="start with the acceleration and the jerk that the driver has, from which the"
        " model takes over within seconds",
    )


class Policy(Component):
    """Base of every policy.

    Life cycle: a job calls `for_model` once it knows the model and the time step. A protocol calls
    `build` once for N networks; if `trainable`, a learner then trains them; afterwards they choose
    parameters in closed loop, one window at a time. A subclass implements `build`.

    Attributes:
        trainable: whether a learner must train what `build` returns.
        adapts: whether the parameters may change while a vehicle drives. Jobs whose policy does not
            adapt are calibrations: nothing is compared with itself.
    """

    kind = "policy"
    schema: ClassVar[type[Settings]] = PolicySettings
    settings: Settings
    trainable: ClassVar[bool] = True
    adapts: ClassVar[bool] = True

    @property
    def untrained_head(self) -> str | None:
        """The head of networks that are used as built; None: the direct one."""
        if isinstance(self.settings, ResidualSettings) and self.settings.residual:
            return "direct_residual"
        return None

    @property
    def inputs(self) -> tuple[str, ...]:
        """The signals that the policy sees."""
        if isinstance(self.settings, PolicySettings):
            return self.settings.inputs
        return ("follower_speed",)

    @property
    def driver_features(self) -> tuple[str, ...]:
        """The features of drivers that condition the policy (`cfx.policies.driver_features`)."""
        if isinstance(self.settings, PolicySettings):
            return self.settings.driver_features
        return ()

    @property
    def summary(self) -> Summary:
        """How a window's frames become features."""
        if isinstance(self.settings, PolicySettings):
            return self.settings.summary
        return "last"

    def for_model(self, model: DrivingModel, dt: float, windows: WindowSettings) -> Self:
        """Returns this policy for a driving model; most do not depend on it.

        Args:
            model: whose parameters are chosen.
            dt: time step, s.
            windows: how often parameters change, and how many frames a token holds.

        Raises:
            ConfigError: it cannot choose for this model, or in such windows.
        """
        return self

    @abstractmethod
    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        """Makes N networks.

        Args:
            features: f.
            default: the model's default parameters in unit space, `(n,)`.
            fixed: what each untrained network answers in unit space, `(N, n)`; N is read from it.
            generator: for the initial weights, on the CPU.
        """


class ConstantNetwork(PolicyNetwork):
    """Answers the same parameters whatever it sees."""

    def __init__(self, unit: Tensor) -> None:
        """Takes `(N, n)` in unit space."""
        super().__init__()
        self.unit: Tensor
        self.register_buffer("unit", unit.clone())

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self.unit.new_zeros((networks, drivers, 0))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        networks, drivers, windows, _ = tokens.shape
        return self.unit[:, None, None, :].expand(networks, drivers, windows, -1), state
