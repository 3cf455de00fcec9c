"""Noise on the acceleration of constant parameters, as measured on recordings.

Shapes: P test pairs, n tuned parameters.
"""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import (
    NOISE_SCALE,
    Agent,
    AgentCore,
    ConstantNetwork,
    FixedPolicy,
    HeldOut,
    ProtocolContext,
    Scaler,
    Stepper,
    StochasticHead,
    composed,
    features_read,
)
from cfx_forecasts.residuals import measure_residuals

log = logging.getLogger(__name__)


def residual_noise(test: HeldOut, parameters: Tensor, *, of_driver: bool) -> tuple[Tensor, Tensor]:
    """Returns the AR(1) process of each driver's residual: time, s, and scale, m/s2, `(P,)` each.

    Args:
        test: the drivers, of whom what was measured before the first origin is read.
        parameters: `(P, n)`.
        of_driver: True: measured on each driver. False: the mean over the drivers of the other
            folds; over all test drivers where there are no folds.
    """
    model, windows = test.context.stepper.model, test.context.windows
    lag = windows.stride * test.batch.dt
    residuals = measure_residuals(model, test.batch, parameters, test.first, lag)
    usual = residuals.time.nanmean().nan_to_num(composed.RELAXATION_TIME.default)
    time = torch.where(residuals.time.isnan(), usual, residuals.time)
    if of_driver:
        return time, residuals.scale
    others = (test.network[:, None] != test.network[None, :]).to(time)
    if not bool(others.any()):
        others = torch.ones_like(others)
    share = others / others.sum(1, keepdim=True)
    return share @ time, (share @ residuals.scale.square()).sqrt()


def constant_with_noise(
    context: ProtocolContext, parameters: Tensor, time: Tensor, scale: Tensor
) -> Agent:
    """Returns an agent with constant parameters and auto-regressive noise on the acceleration.

    Args:
        context: what the protocol composes.
        parameters: `(N, n)`, SI units; one network for each row.
        time: time constant with which the noise forgets, `(N,)`, s.
        scale: standard deviation of the noise, `(N,)`, m/s2.

    Raises:
        ConfigError: the model has equations in a simulator only.
    """
    model, device = context.stepper.model, parameters.device
    head = StochasticHead.for_model(model, device).of_acceleration()
    complete = head.completed(parameters).clone()
    for parameter, values in ((composed.RELAXATION_TIME, time), (NOISE_SCALE, scale)):
        column = head.space.names.index(parameter.name)
        complete[:, column] = values.clamp(parameter.low, parameter.high)
    policy = FixedPolicy()
    width = features_read(policy, head, context.windows.length)
    blank = complete.new_zeros((len(complete), width))
    network = ConstantNetwork(head.untrained_answer(complete))
    return Agent(
        core=AgentCore(policy, network, Scaler(blank, blank + 1.0), head),
        model_node=context.model_node,
        policy_node={"name": "fixed"},
        windows=context.windows,
        dt=context.stepper.dt,
        names=tuple(str(number) for number in range(len(complete))),
        base=complete,
    )


def can_drive(stepper: Stepper, agent: Agent) -> bool:
    """Says whether a simulator takes the steps of the model that an agent drives."""
    try:
        agent.stepper(stepper)
    except ConfigError as error:
        log.info("Left out: %s", error)
        return False
    return True
