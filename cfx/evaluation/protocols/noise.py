"""Noise on the acceleration of constant parameters, as measured on recordings.

Shapes: P test pairs, n tuned parameters.
"""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from cfx.calibration.residuals import measure_residuals
from cfx.core.errors import ConfigError
from cfx.evaluation.protocols.held_out import HeldOut
from cfx.models.residual import TIME
from cfx.policies.agent import Agent
from cfx.simulation.base import Stepper

log = logging.getLogger(__name__)


def residual_noise(test: HeldOut, parameters: Tensor, *, own: bool) -> tuple[Tensor, Tensor]:
    """Returns the AR(1) process of each driver's residual: time, s, and scale, m/s2, `(P,)` each.

    Args:
        test: the drivers, of whom what was measured before the first origin is read.
        parameters: `(P, n)`.
        own: measured on each driver; otherwise the mean over those of the other folds, or over all
            test drivers where there are no folds.
    """
    model, windows = test.context.simulator.model, test.context.windows
    lag = windows.stride * test.batch.dt
    found = measure_residuals(model, test.batch, parameters, test.first, lag)
    usual = found.time.nanmean().nan_to_num(TIME.default)
    time = torch.where(found.time.isnan(), usual, found.time)
    if own:
        return time, found.scale
    others = (test.network[:, None] != test.network[None, :]).to(time)
    if not bool(others.any()):
        others = torch.ones_like(others)
    share = others / others.sum(1, keepdim=True)
    return share @ time, (share @ found.scale.square()).sqrt()


def can_drive(simulator: Stepper, agent: Agent) -> bool:
    """Says whether a simulator takes the steps of the model that an agent drives."""
    try:
        agent.stepper(simulator)
    except ConfigError as error:
        log.info("Left out: %s", error)
        return False
    return True
