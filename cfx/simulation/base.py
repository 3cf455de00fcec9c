"""The contract of a simulator: it says which driving models it can drive, and takes their steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field
from torch import Tensor

from cfx.core import registry
from cfx.core.component import Component, Settings
from cfx.errors import ConfigError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.simulation.trajectory import Segments, Start, Terms


class Stepper(ABC):
    """Advances followers of one model at one time step.

    A simulator (`cfx.plugin.Simulator`) makes one for each job. Calibration, learning and
    evaluation call `begin` once for each rollout and `advance` as often as parameters change; the
    job calls `close` at its end.

    Shapes: `*batch` are the followers' leading dimensions, K is a number of steps.

    Args:
        model: the driving model whose steps are taken.
        dt: time step, s.

    Attributes:
        differentiable: gradients flow through `advance`. A learner that needs them asks here.
    """

    differentiable: ClassVar[bool] = False

    def __init__(self, model: DrivingModel, dt: float) -> None:
        self.model = model
        self.dt = dt

    def begin(self, start: Start) -> Follower:
        """Returns the follower at the start of a rollout."""
        return Follower(*start, self.model.initial_memory(start.speed))

    @abstractmethod
    def advance(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]
    ) -> tuple[Follower, Tensor, Tensor]:
        """Takes K steps with constant parameters.

        Args:
            follower: state at the first frame, `(*batch,)`. Either from `begin` or from the call
                before, so that a simulator may return a `Follower` that knows more.
            leader: frames 0 to K - 1, `(K, *batch)` each (the length without time), broadcasting to
                the follower's batch.
            p: one tensor per parameter, broadcasting to `(*batch,)`.

        Returns:
            The follower at frame K, and positions and speeds `(K, *batch)` of frames 1 to K.

        Raises:
            CfxError: an input wants gradients, and `differentiable` is False.
        """

    def accumulates(self, p: Mapping[str, Tensor], terms: Terms) -> bool:
        """Says whether `accumulate` sums up these terms, given enough work, without trajectories.

        Args:
            p: one tensor per parameter, as for `accumulate`; their number of candidates is nothing.
            terms: what a frame adds to each sum.
        """
        return False

    def accumulate(
        self,
        segments: Segments,
        p: Mapping[str, Tensor],
        terms: Terms,
        every: int | None = None,
        gain: Tensor | None = None,
    ) -> tuple[Tensor, ...] | None:
        """Simulates segments and sums up what their frames add, without keeping trajectories.

        Args:
            segments: P segments.
            p: one tensor per parameter, `()` or broadcasting to `(P, q)`.
            terms: what a frame adds to each sum.
            every: the terms of each so many-th frame, instead of sums.
            gain: by which share g of the way position and speed move to the measured ones after
                each of these frames in the end, `(P, q)`: g + (1 - g) / (t + 1) after the t-th, as
                the state at the start was measured once. Terms are of what is predicted from there.
                None: not at all.

        Returns:
            Each sum over the frames that count, `(P, q)`, or each term of frames `every`,
            `2 every` and so on, `(K // every, P, q)`, 0 where a frame does not count; None where
            trajectories have to be simulated by `advance`.
        """
        return None

    def for_work(self, steps: int) -> Stepper:
        """Returns what takes a number of vehicle steps that belong together.

        Args:
            steps: of all vehicles, however many calls of `advance` they are cut into.
        """
        return self

    def for_model(self, model: DrivingModel) -> Stepper:
        """Returns what takes the steps of a model that has this stepper's model inside.

        Raises:
            ConfigError: it can take those of its own model only.
        """
        raise ConfigError(
            f"{type(self).__name__} takes the steps of its own model only, so a policy with a"
            " residual acceleration cannot drive it; set simulator=memory"
        )

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Lets go of what takes the steps, such as processes; `advance` may start it again."""

    @abstractmethod
    def identity(self) -> str:
        """Returns what results depend on besides the model and the time step; caches carry it."""


class SimulatorSettings(Settings):
    """Settings that every simulator has."""

    memory_mb: int = Field(
        1024, ge=16, description="bound for what one shard of calibration problems takes, MB"
    )


class Simulator(Component):
    """Base of every simulator.

    Life cycle: constructed once per job, before any work. `require` is asked first, and a job whose
    driving model it refuses ends there; then `stepper` is called once, with the recordings' time
    step. Constructing and `require` start nothing.

    A subclass implements `stepper`. One that does not use the model's equations says in `require`
    which models it can drive.

    Attributes:
        differentiable: gradients flow through the steps. Tested.
    """

    kind = "simulator"
    schema: ClassVar[type[Settings]] = SimulatorSettings
    settings: SimulatorSettings

    differentiable: ClassVar[bool] = False

    def require(self, model: DrivingModel) -> None:
        """Checks that this simulator can drive a model; the base class asks for equations.

        Raises:
            ConfigError: it cannot; says what to choose.
            CfxError: another one where something is not installed that the simulator needs.
        """
        if model.needs_simulator:
            raise ConfigError(
                f"model={registry.name_of(model)} has no equations in Python; add"
                f" simulator={model.needs_simulator}, which alone drives it"
            )

    @abstractmethod
    def stepper(self, model: DrivingModel, dt: float) -> Stepper:
        """Returns what takes the steps of one model at one time step.

        Args:
            model: one that `require` lets through.
            dt: time step, s.

        Raises:
            ConfigError: the simulator cannot drive the model, or not at this time step.
        """
