"""The contract of a parameter head, which turns what networks answer into parameters; the simplest.

Shapes: `*batch` any leading dimensions, N networks, n tuned parameters, c features of conditioning,
L frames of a token.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Self

import torch
from torch import Tensor

from cfx.core.parameters import ParameterSpace
from cfx.models.base import DrivingModel
from cfx.policies.history import History


class ParameterHead(ABC):
    """Base of every parameter head.

    A head is a pure function of tensors, elementwise over leading dimensions: training and
    evaluation use the same. A saved policy names its head; an entry point of
    the group `cfx.heads` makes it known by that name.

    Attributes:
        name: in saved policies, and of its entry point.
        learners: names of the learners that train it, as `learner.head=NAME` asks for.
        needs_base: whether parameters depend on each driver's base parameters.
        noise_width: how many random numbers a window of a driver takes, k; 0: nothing is drawn.
        latent_width: how many of a driver's random numbers are kept from window to window, q.
        space: the parameters that it answers, with their bounds.
    """

    name: ClassVar[str]
    learners: ClassVar[tuple[str, ...]] = ()
    needs_base: ClassVar[bool] = False
    noise_width: int = 0
    latent_width: int = 0

    def __init__(self, space: ParameterSpace, device: torch.device | str | None = None) -> None:
        self.space = space

    @classmethod
    @abstractmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        """Returns the head for a driving model's parameters: it chooses the parameter space."""

    @property
    def is_stochastic(self) -> bool:
        """Whether it draws random numbers."""
        return self.noise_width > 0

    def to(self, device: torch.device | str) -> Self:
        """Returns the same head for tensors of a device."""
        return type(self)(self.space, device)

    def driven_model(self, model: DrivingModel) -> DrivingModel:
        """Returns the model whose steps these parameters drive: the job's, or one around it."""
        return model

    @property
    def model_space(self) -> ParameterSpace:
        """The driving model's parameters, which stand first in `space`."""
        return self.space

    def measured(self, parameters: Tensor, history: History, dt: float) -> Tensor:
        """Fills in what is measured of a driver and no network answers.

        Args:
            parameters: `(*batch, n)`, SI units.
            history: the last L frames, `(*batch, L)` each.
            dt: time step, s.

        Returns:
            `(*batch, n)`, SI units.
        """
        return parameters

    def sampled(
        self, parameters: Tensor, noise: Tensor, latent: Tensor, window_s: float
    ) -> tuple[Tensor, Tensor]:
        """Draws the parameters of a window.

        Args:
            parameters: what the head says of their distribution, `(*batch, n)`, SI units.
            noise: standard normal, `(*batch, k)`.
            latent: what was kept of the last window, `(*batch, q)`; 0 before the first.
            window_s: how long they hold, s.

        Returns:
            Parameters `(*batch, n)`, SI units, and what is kept of this window, `(*batch, q)`.
        """
        return parameters, latent

    def completed(self, parameters: Tensor) -> Tensor:
        """Returns the driving model's parameters with defaults for all else that the head answers.

        Args:
            parameters: of the driving model, or already complete; `(*batch, m)`, SI units.

        Returns:
            `(*batch, n)`, SI units.
        """
        return parameters

    @property
    def answers(self) -> int:
        """The number of outputs of a network; n, unless the head fills in some itself."""
        return len(self.space)

    @property
    def width(self) -> int:
        """The number of features by which networks learn of the base, c."""
        return 0

    def condition(self, base: Tensor) -> Tensor:
        """Returns what networks read of the base.

        Args:
            base: `(*batch, n)` in unit space.

        Returns:
            `(*batch, c)`, not normalised.
        """
        return base[..., :0]

    @abstractmethod
    def untrained_answer(self, fixed: Tensor) -> Tensor:
        """Returns the answers with which untrained networks start.

        Args:
            fixed: each network's base parameters in unit space, `(N, n)`.

        Returns:
            `(N, n)` in [0, 1], what `Policy.build` takes as `fixed`.
        """

    @abstractmethod
    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        """Returns the parameters that an answer means.

        Args:
            answer: of the networks, `(*batch, n)` in [0, 1].
            base: `(*batch, n)` in unit space; None for heads without a base.

        Returns:
            `(*batch, n)` in unit space, in the dtype of the answer.
        """


class DirectHead(ParameterHead):
    """Answers are parameters in unit space, within the bounds of calibration."""

    name: ClassVar[str] = "direct"
    learners: ClassVar[tuple[str, ...]] = ("imitation",)

    @classmethod
    def for_model(cls, model: DrivingModel, device: torch.device | str | None = None) -> Self:
        return cls(model.space, device)

    def untrained_answer(self, fixed: Tensor) -> Tensor:
        return fixed

    def unit_parameters(self, answer: Tensor, base: Tensor | None) -> Tensor:
        return answer
