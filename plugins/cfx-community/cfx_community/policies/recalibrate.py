"""Calibration on a sliding window of the driver's latest history (`policy=recalibrate`).

Shapes: N networks, B drivers of each, D drivers, F frames of a token, T frames kept, q candidates,
n tuned parameters; `*batch` any leading dimensions.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, cast

import torch
from pydantic import Field
from torch import Tensor

from cfx.plugin import (
    OBSERVED,
    History,
    MemoryStepper,
    Objective,
    Optimizer,
    Prior,
    ResidualSettings,
    SegmentLosses,
    Segments,
    Settings,
    registry,
    squashed,
)
from cfx_community.policies.estimator import DrivenModel, EstimatorNetwork, EstimatorPolicy

_SIGNALS = len(OBSERVED)

_MEMORY_BYTES = 1 << 28
"""Bound for what one search takes at once."""

_SEED = 0
"""Of the optimizer's points: the same for every driver and moment."""


class RecalibrateSettings(ResidualSettings):
    """Settings of `recalibrate`."""

    window_s: float = Field(
        10.0, gt=0, description="s of the latest measured history that is calibrated on"
    )
    prior: float = Field(
        1.0,
        ge=0,
        description="weight of the pooled parameters: what a parameter that is one unit of the"
        " squashed space away from them costs, as a share of their loss over the number of"
        " parameters; 0: the latest history alone",
    )
    optimizer: dict[str, Any] = Field(
        {"name": "gradient", "samples": 512},
        description="what calibrates: an optimizer's node, {name: ..., settings}",
    )
    objective: dict[str, Any] = Field(
        {"name": "speed_rmse"},
        description="what it minimises: an objective's node, {name: ..., settings}",
    )


class RecalibratePolicy(EstimatorPolicy):
    """Calibrates a driver anew on their latest history whenever the policy takes over.

    The last `window_s` of measured history are simulated in one closed loop from their first frame,
    as driver-specific calibration does with the first part of a trajectory. Any optimizer searches
    for the parameters, for all drivers at once. Once the policy drives, they are kept; a driver of
    whom less than a second was measured has the pooled ones.

    A window of ten seconds determines few parameters. So the loss has a penalty for leaving the
    pooled parameters (`prior`), the same as that of `calibration.prior` around the model's default.

    Differences from the paper: its labels are calibrated on half a second, afterwards.
    """

    schema: ClassVar[type[Settings]] = RecalibrateSettings
    settings: RecalibrateSettings

    def __init__(self, settings: Settings | None = None, **options: object) -> None:
        super().__init__(settings, **options)
        self._optimizer = cast(Optimizer, registry.create("optimizer", self.settings.optimizer))
        self._objective = cast(Objective, registry.create("objective", self.settings.objective))

    def estimator(
        self, driven: DrivenModel, prior: Tensor, generator: torch.Generator
    ) -> EstimatorNetwork:
        return RecalibrateNetwork(driven, prior, self.settings, self._optimizer, self._objective)


class RecalibrateNetwork(EstimatorNetwork):
    """Beliefs are the estimate, the number of frames that are known, and T frames of 5 signals."""

    def __init__(
        self,
        driven: DrivenModel,
        prior: Tensor,
        settings: RecalibrateSettings,
        optimizer: Optimizer,
        objective: Objective,
    ) -> None:
        super().__init__(driven, prior)
        self._weight = settings.prior
        self._kept = max(2, round(settings.window_s / driven.dt) + 1)
        self._least = min(self._kept - 1, max(2, round(1.0 / driven.dt)))
        self._optimizer = optimizer
        self._objective = objective
        self._stepper = MemoryStepper(driven.model, driven.dt)

    def initial_belief(self, prior: Tensor) -> Tensor:
        frames = prior.new_zeros((*prior.shape[:-1], 1 + _SIGNALS * self._kept))
        return torch.cat([prior, frames], -1)

    def updated(self, history: History, belief: Tensor) -> Tensor:
        """Appends the frames of a window that are new; the estimate waits until it is asked for."""
        estimate, recorded, frames = self._parts(belief)
        token = torch.stack([history[name] for name in OBSERVED], -2)
        new = torch.where(recorded > 0, _new_frames(frames[..., -1], token), token.shape[-1])
        index = torch.arange(self._kept, device=belief.device) + new[..., None]
        both = torch.cat([frames, token], -1)
        # Of the token only the new frames are appended: the last ones.
        skip = (token.shape[-1] - new)[..., None]
        index = torch.where(index >= self._kept, index + skip, index)
        index = index[..., None, :].expand(*frames.shape[:-1], self._kept)
        recorded = (recorded + new).clamp(max=self._kept)
        frames = both.gather(-1, index)
        return torch.cat([estimate, recorded[..., None], frames.flatten(-2)], -1)

    def concluded(self, belief: Tensor, due: Tensor) -> Tensor:
        _, recorded, frames = self._parts(belief)
        wanted = due & (recorded > self._least)
        if not bool(wanted.any()):
            return belief
        prior = squashed(self.prior)[:, None].expand(*belief.shape[:-1], -1)
        estimates = self._calibrated(frames[wanted], recorded[wanted].long(), prior[wanted])
        belief = belief.clone()
        belief[wanted, : estimates.shape[-1]] = estimates
        return belief

    def estimate(self, belief: Tensor) -> Tensor:
        return belief[..., : self.prior.shape[-1]]

    def _parts(self, belief: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the estimate, how many frames are known, and the frames `(*batch, 5, T)`."""
        n = self.prior.shape[-1]
        frames = belief[..., n + 1 :].reshape(*belief.shape[:-1], _SIGNALS, self._kept)
        return belief[..., :n], belief[..., n], frames

    def _calibrated(self, frames: Tensor, recorded: Tensor, prior: Tensor) -> Tensor:
        """Calibrates D drivers; `(D, 5, T)`, `(D,)` and `(D, n)` to squashed `(D, n)`."""
        losses = self._losses(frames, recorded)
        unit = prior.double().sigmoid()[:, None]
        wanted = replace(losses, prior=Prior.of(losses, unit, prior[:, None], self._weight))
        solution = self._optimizer.minimize(
            wanted.for_work(self._optimizer.evaluations(unit.shape[-1])),
            unit,
            seed=_SEED,
            objective_bytes=losses.bytes_per_candidate,
            memory=_MEMORY_BYTES,
        )
        return squashed(solution.best).to(prior)

    def _losses(self, frames: Tensor, recorded: Tensor) -> SegmentLosses:
        """Returns the losses of D drivers over the frames that are known of them."""
        index = torch.arange(self._kept, device=frames.device) + (self._kept - recorded)[:, None]
        index = index.clamp(max=self._kept - 1)
        known_frames = frames.gather(-1, index[:, None].expand_as(frames))
        signals = dict(zip(OBSERVED, known_frames.unbind(-2), strict=True))
        moved = (signals["follower_speed"][:, 1:] * self.driven.dt).cumsum(-1)
        travelled = torch.cat([torch.zeros_like(moved[:, :1]), moved], -1)
        ahead = travelled + signals["gap"]
        steps = torch.arange(self._kept - 1, device=frames.device)[:, None]
        start = torch.zeros_like(ahead[:, 0])
        segments = Segments(
            leader_position=ahead[:, :-1].T,
            leader_speed=signals["leader_speed"][:, :-1].T,
            leader_acceleration=signals["leader_acceleration"][:, :-1].T,
            leader_rear=ahead[:, 1:].T,
            measured_speed=signals["follower_speed"][:, 1:].T,
            measured_gap=signals["gap"][:, 1:].T,
            counted=(steps < recorded - 1).to(frames.dtype),
            leader_length=start,
            position=start,
            speed=signals["follower_speed"][:, 0],
            acceleration=signals["follower_acceleration"][:, 0],
        )
        return SegmentLosses(self._stepper, self._objective, segments)


def _new_frames(last: Tensor, token: Tensor) -> Tensor:
    """Returns how many frames of a token come after the last frame that is known, `(*batch,)`.

    Tokens follow one another or overlap: the known frame is sought in the token. Where a vehicle
    stands, all its frames are the same, and so is whatever is made of them.

    Args:
        last: `(*batch, 5)`.
        token: `(*batch, 5, F)`.
    """
    length = token.shape[-1]
    same = (token == last[..., None]).all(-2)
    first = same.to(torch.uint8).argmax(-1)
    return torch.where(same.any(-1), length - 1 - first, length)
