"""What an agent is told of drivers of whom trajectories are known, before it drives.

Shapes: D drivers, n parameters that the agent chooses, m of them the driving model's, k driver
features.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.policies.agent import Agent
from cfx.policies.driver_features import measure
from cfx.policies.heads.offset import shrunk


def base_of(agent: Agent, parameters: Tensor) -> Tensor:
    """Returns the base of drivers with these calibrated parameters, `(D, n)`, SI units.

    Args:
        agent: whose base it is.
        parameters: of the driving model, `(D, m)`, SI units.
    """
    complete = agent.core.head.completed(parameters)
    return shrunk(agent.space, complete, agent.context_rule.shrinkage)


def driver_features_of(
    agent: Agent, batch: PairBatch, until: Tensor, since: Tensor | None = None
) -> Tensor | None:
    """Measures the driver features of D drivers.

    Args:
        agent: whose policy reads them.
        batch: their D pairs.
        until: `(D,)`, the frame before which each is measured.
        since: `(D,)`, the frame from which on; None: the first.

    Returns:
        `(D, k)`, NaN for drivers of whom too little was measured; None if the policy reads
        none.
    """
    if not agent.core.driver_features:
        return None
    if since is None:
        since = torch.zeros_like(until)
    return measure(batch, agent.core.driver_features, agent.dt, since, until)


def unlikeness(agent: Agent, features: Tensor, network: Tensor) -> Tensor:
    """Returns how far driver features are from those of the drivers that were learned from.

    Args:
        agent: that has learned from drivers.
        features: `(D, k)`, as `driver_features_of` returns them.
        network: which network's drivers each is compared with, `(D,)`.

    Returns:
        `(D, k)`, in standard deviations from their mean; NaN where a feature is unknown.
    """
    scaler, count = agent.core.scaler, features.shape[1]
    # Driver features stand last in what the networks read.
    mean, scale = scaler.mean[network, -count:], scaler.scale[network, -count:]
    return (features - mean.to(features)) / scale.to(features)
