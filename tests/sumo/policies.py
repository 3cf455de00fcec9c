"""Policies for tests: untrained networks in double precision, so that two ways agree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from cfx import registry
from cfx.agents.agent import Agent
from cfx.agents.core import AgentCore
from cfx.agents.heads.direct import DirectHead
from cfx.agents.heads.offset import OffsetHead
from cfx.agents.scaler import Scaler
from cfx.calibration.windows import WindowSettings
from cfx.models.base import DrivingModel
from cfx.policies.gru import GruPolicy

INPUTS = ("leader_speed", "follower_speed", "gap", "follower_acceleration", "leader_acceleration")


def adaptive(
    node: Mapping[str, Any],
    names: tuple[str, ...] = ("all",),
    *,
    dt: float = 0.1,
    length: int = 5,
    offsets: bool = False,
    driver_features: tuple[str, ...] = (),
) -> Agent:
    """Returns a GRU for each name; what it chooses depends on all it sees.

    With `offsets` it answers offsets, from the middle between the bounds for who brings no base.
    """
    model = registry.create("model", dict(node))
    assert isinstance(model, DrivingModel)
    policy = GruPolicy(inputs=INPUTS, driver_features=driver_features, start="middle")
    networks = len(names)
    features = length * len(INPUTS) + (len(model.space) if offsets else 0) + len(driver_features)
    unit = model.space.to_unit(model.space.defaults())
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
    head = OffsetHead(model.space) if offsets else DirectHead(model.space)
    return Agent(
        core=AgentCore(policy, network, scaler, head),
        model_node=dict(node),
        policy_node={
            "name": "gru",
            "inputs": list(INPUTS),
            "driver_features": list(driver_features),
            "start": "middle",
        },
        windows=WindowSettings(length=length, stride=5),
        dt=dt,
        names=names,
        base=model.space.from_unit(torch.full((networks, len(model.space)), 0.5).double())
        if offsets
        else None,
    )
