"""Classical estimators as policies: parameters of a driver, estimated while they are observed.

An estimator keeps a *belief* about a driver's parameters. Each window of measured driving updates
it. Once the policy drives, nothing measured comes any more, and the estimate is kept.

Shapes: N networks, B drivers of each, W windows, F frames of a window, n tuned parameters, k
parameter sets of each driver, w width of the belief; `*batch` any leading dimensions. The squashed
space is the logits of unit space.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import NamedTuple, Self

import torch
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import (
    OBSERVED,
    DrivingModel,
    Follower,
    History,
    Leader,
    Policy,
    PolicyNetwork,
    Summary,
    WindowSettings,
    advance_vehicle,
    squashed,
)

_LARGEST = 6.0
"""Squashed parameters are kept within this, 0.25 % of a range from either bound."""

_SEEN, _ACTED, _FLAGS = 0, 1, 2
"""Columns of the state before the belief: a window was seen; the last one was driven."""


class DrivenModel(NamedTuple):
    """The driving model that an estimator simulates.

    Attributes:
        model: the driving model.
        dt: time step, s.
        windows: how many frames a token holds, and how many are new in each.
    """

    model: DrivingModel
    dt: float
    windows: WindowSettings

    @property
    def frames(self) -> int:
        """F: the newest frames of a token, as far as no window before has used them."""
        return min(self.windows.length, self.windows.stride + 1)


class EstimatorPolicy(Policy):
    """Base of policies that estimate constant parameters from what was measured so far.

    Nothing is trained. The belief before the first window is centred at the networks' fixed
    parameters, which for unseen drivers are the pooled ones.
    """

    trainable = False
    driven: DrivenModel | None = None

    @property
    def inputs(self) -> tuple[str, ...]:
        return OBSERVED

    @property
    def summary(self) -> Summary:
        return "frames"

    def for_model(self, model: DrivingModel, dt: float, windows: WindowSettings) -> Self:
        if model.needs_simulator:
            raise ConfigError(
                "an estimator as policy simulates the driving model itself, and this model has"
                f" equations in {model.needs_simulator} only; choose one that cfx has, such as"
                " krauss or idm"
            )
        if windows.length < 2:
            raise ConfigError(
                "windows.length=1: an estimator compares frames within a window; give at least 2"
            )
        policy = copy.copy(self)
        policy.driven = DrivenModel(model, dt, windows)
        return policy

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        if self.driven is None:
            raise ConfigError("an estimator is built for a model: call `for_model` before `build`")
        return self.estimator(self.driven, fixed, generator)

    @abstractmethod
    def estimator(
        self, driven: DrivenModel, prior: Tensor, generator: torch.Generator
    ) -> EstimatorNetwork:
        """Makes the estimator.

        Args:
            driven: what it simulates.
            prior: each network's parameters before anything is seen, `(N, n)` in unit space.
            generator: for whatever is drawn, on the CPU.
        """


class EstimatorNetwork(PolicyNetwork):
    """Beliefs about drivers, passed in and returned as the state.

    `observe` updates beliefs with measured windows. `forward` drives: its first window after
    observed ones still ends with a measured frame, and is used; later windows hold what the policy
    itself has simulated, and change nothing. A driver of whom nothing was observed keeps the prior.
    """

    def __init__(self, driven: DrivenModel, prior: Tensor) -> None:
        """Takes the prior `(N, n)` in unit space."""
        super().__init__()
        self.driven = driven
        self.prior: Tensor
        self.register_buffer("prior", prior.clone())

    @abstractmethod
    def initial_belief(self, prior: Tensor) -> Tensor:
        """Returns the belief before anything is seen, `(*batch, w)`.

        Args:
            prior: squashed, `(*batch, n)`.
        """

    @abstractmethod
    def updated(self, history: History, belief: Tensor) -> Tensor:
        """Returns the belief after a window of measured driving, `(*batch, w)`.

        Args:
            history: F frames, `(*batch, F)` each, SI units.
            belief: before, `(*batch, w)`.
        """

    @abstractmethod
    def estimate(self, belief: Tensor) -> Tensor:
        """Returns the parameters that a belief stands for, `(*batch, n)`, squashed."""

    def concluded(self, belief: Tensor, due: Tensor) -> Tensor:
        """Returns the belief with which drivers start to be driven, `(*batch, w)`.

        Args:
            belief: `(*batch, w)`.
            due: which drivers start now, bool `(*batch,)`.
        """
        return belief

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        prior = squashed(self.prior)[:, None].expand(-1, drivers, -1)
        belief = self.initial_belief(prior)
        return torch.cat([belief.new_zeros((*belief.shape[:-1], _FLAGS)), belief], -1)

    @torch.no_grad()
    def observe(self, tokens: Tensor, state: Tensor) -> Tensor:
        for window in range(tokens.shape[2]):
            state = self._saw(tokens[:, :, window], state)
            state[..., _ACTED] = 0.0
        return state

    @torch.no_grad()
    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        answers = []
        for window in range(tokens.shape[2]):
            due = state[..., _ACTED] == 0
            if bool(due.any()):
                state = self._saw(tokens[:, :, window], state)
                belief = self.concluded(state[..., _FLAGS:], due)
                state = torch.cat([state[..., :_FLAGS], belief], -1)
                state[..., _ACTED] = 1.0
            answers.append(self.estimate(state[..., _FLAGS:]).sigmoid())
        return torch.stack(answers, 2), state

    def _saw(self, token: Tensor, state: Tensor) -> Tensor:
        """Returns the state `(N, B, w + 2)` after one more window, if it was measured."""
        belief = state[..., _FLAGS:]
        is_measured = (state[..., _SEEN] > 0) & (state[..., _ACTED] == 0)
        after = self.updated(self._history(token), belief)
        belief = torch.where(is_measured[..., None] & after.isfinite(), after, belief)
        state = torch.cat([state[..., :_FLAGS], belief], -1)
        state[..., _SEEN] = 1.0
        return state

    def _history(self, token: Tensor) -> History:
        """Returns the newest frames that a token `(*batch, f)` holds, `(*batch, F)` each."""
        length, frames = self.driven.windows.length, self.driven.frames
        signals = token[..., : length * len(OBSERVED)]
        signals = signals.reshape(*token.shape[:-1], -1, length)
        newest = signals[..., length - frames :].unbind(-2)
        return dict(zip(OBSERVED, newest, strict=True))

    def simulated_acceleration(self, history: History, sets: Tensor) -> Tensor:
        """Simulates a window from its first measured frame, behind the measured leader.

        Args:
            history: `(*batch, F)` each.
            sets: k parameter sets of each driver, `(*batch, k, n)`, squashed.

        Returns:
            The mean acceleration over the window, `(*batch, k)`, m/s2.
        """
        model, dt, _ = self.driven
        p = model.space.unpack(model.space.from_unit(sets.sigmoid()))
        moved = (history["follower_speed"][..., 1:] * dt).cumsum(-1)
        travelled = torch.cat([torch.zeros_like(moved[..., :1]), moved], -1)
        ahead = travelled + history["gap"]
        speed = history["follower_speed"][..., :1].expand(sets.shape[:-1])
        acceleration = history["follower_acceleration"][..., :1].expand(sets.shape[:-1])
        follower = Follower(
            torch.zeros_like(speed), speed, acceleration, model.initial_memory(speed)
        )
        for frame in range(ahead.shape[-1] - 1):
            leader = Leader(
                ahead[..., frame, None],
                history["leader_speed"][..., frame, None],
                history["leader_acceleration"][..., frame, None],
                torch.zeros_like(ahead[..., :1]),
            )
            follower = advance_vehicle(model, follower, leader, p, dt)
        return (follower.speed - speed) / (dt * (ahead.shape[-1] - 1))

    def measured_acceleration(self, history: History) -> Tensor:
        """Returns the mean acceleration over the window, `(*batch,)`, m/s2."""
        speed = history["follower_speed"]
        return (speed[..., -1] - speed[..., 0]) / (self.driven.dt * (speed.shape[-1] - 1))


def bounded(values: Tensor) -> Tensor:
    """Clamps squashed parameters, so that later updates can still move them."""
    return values.clamp(-_LARGEST, _LARGEST)
