"""Policies for tests: untrained networks in double precision, so that two ways agree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from cfx.core import registry
from cfx.models.base import DrivingModel
from cfx.policies.agent import Agent
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler
from cfx.policies.gru import GruPolicy
from cfx.policies.heads.base import DirectHead, ParameterHead
from cfx.policies.heads.offset import OffsetHead
from cfx.policies.heads.residual import ResidualHead
from cfx.policies.heads.stochastic import StochasticHead
from cfx.simulation.windows import WindowSettings

INPUTS = ("leader_speed", "follower_speed", "gap", "follower_acceleration", "leader_acceleration")


def adaptive(
    node: Mapping[str, Any],
    names: tuple[str, ...] = ("all",),
    *,
    dt: float = 0.1,
    length: int = 5,
    offsets: bool = False,
    residual: bool = False,
    stochastic: bool = False,
    head: ParameterHead | None = None,
    driver_features: tuple[str, ...] = (),
    further: tuple[str, ...] = (),
) -> Agent:
    """Returns a GRU for each name; what it chooses depends on all it sees.

    With `offsets` it answers offsets, from the middle between the bounds for who brings no base;
    with `residual` also how the residual acceleration decays, and with
    `stochastic` how much it varies. `head` stands in for all of these. `further` are inputs that it
    reads beside the usual ones.
    """
    inputs = (*INPUTS, *further)
    model = registry.create("model", dict(node))
    assert isinstance(model, DrivingModel)
    policy = GruPolicy(inputs=inputs, driver_features=driver_features, start="middle")
    networks = len(names)
    if head is None and stochastic:
        head = StochasticHead.for_model(model)
    elif head is None and residual:
        head = ResidualHead.for_model(model)
    elif head is None and offsets:
        head = OffsetHead(model.space)
    elif head is None:
        head = DirectHead(model.space)
    features = length * len(inputs) + head.width + len(driver_features)
    unit = head.space.to_unit(head.space.defaults())
    network = (
        policy.build(features, unit, unit.expand(networks, -1), torch.Generator().manual_seed(3))
        .double()
        .eval()
    )
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.5)  # so that the chosen parameters vary enough to tell drivers apart
    scaler = Scaler(
        torch.full((networks, features), 6.0).double(),
        torch.full((networks, features), 4.0).double(),
    )
    base = None
    if head.needs_base:
        base = head.space.from_unit(torch.full((networks, len(head.space)), 0.5).double())
    return Agent(
        core=AgentCore(policy, network, scaler, head),
        model_node=dict(node),
        policy_node={
            "name": "gru",
            "inputs": list(inputs),
            "driver_features": list(driver_features),
            "start": "middle",
        },
        windows=WindowSettings(length=length, stride=5),
        dt=dt,
        names=names,
        base=base,
    )
