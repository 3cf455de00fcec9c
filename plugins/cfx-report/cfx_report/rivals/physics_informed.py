"""A network that is held to the IDM where nothing was recorded.

It says the acceleration from speed, relative speed and gap. It is fitted to recorded accelerations
and, at drawn states, to an IDM whose parameters are learned at the same time.

Shapes: N states. SI units.
"""

from __future__ import annotations

from typing import ClassVar, cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from cfx.plugin import (
    DrivingModel,
    Follower,
    Leader,
    PairBatch,
    PairSet,
    Settings,
    registry,
    threads,
)
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver

_HOLD_S = 0.5
_SCALE = torch.tensor([10.0, 3.0, 20.0], dtype=torch.float64)


class PhysicsInformedSettings(Settings):
    """Settings of a physics-informed network."""

    hidden_size: int = Field(32, ge=1, description="width of two hidden layers")
    steps: int = Field(3000, ge=1, description="steps of the optimizer")
    states: int = Field(512, ge=1, description="recorded states in a step, and as many drawn ones")
    physics: float = Field(0.3, ge=0, le=1, description="weight of the IDM beside the recording")
    learning_rate: float = Field(0.003, gt=0, description="of Adam; falls to 0 as a half cosine")


class PhysicsInformed(Rival):
    """A network fitted to accelerations, and to an IDM that is fitted with it."""

    reference = "Mo, Shi and Di (2021), Transp. Res. C 130, 103240"
    trains = True
    schema: ClassVar[type[Settings]] = PhysicsInformedSettings
    settings: PhysicsInformedSettings

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        s = self.settings
        states, actions, weights = _moments(pairs)
        model = cast(DrivingModel, registry.create("model", {"name": "idm"}))
        ranges = [[parameter.low, parameter.high] for parameter in model.space.tuned]
        bounds = torch.tensor(ranges).double().T
        with torch.random.fork_rng(devices=[]), threads.one_thread():
            torch.manual_seed(seed)
            module = nn.Sequential(
                nn.Linear(3, s.hidden_size),
                nn.Tanh(),
                nn.Linear(s.hidden_size, s.hidden_size),
                nn.Tanh(),
                nn.Linear(s.hidden_size, 1),
            ).double()
            share = (model.space.defaults().double() - bounds[0]) / (bounds[1] - bounds[0])
            unit = nn.Parameter(torch.logit(share.clamp(0.02, 0.98)))
            optimizer = torch.optim.Adam([*module.parameters(), unit], s.learning_rate)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, s.steps)
            low, high = states.amin(0), states.amax(0)
            for _ in range(s.steps):
                rows = torch.multinomial(weights, s.states, replacement=True)
                drawn = low + (high - low) * torch.rand(s.states, 3, dtype=torch.float64)
                parameters = bounds[0] + (bounds[1] - bounds[0]) * torch.sigmoid(unit)
                recorded = _answer(module, states[rows]) - actions[rows]
                physical = torch.cat([states[rows], drawn])
                wanted = _idm(model, parameters, physical).clamp(-8.0, 4.0)
                # The IDM is fitted to the recording too, or nothing would hold its parameters.
                idm_error = wanted[: s.states] - actions[rows]
                apart = _answer(module, physical) - wanted
                loss = (1.0 - s.physics) * recorded.square().mean()
                loss = loss + s.physics * (apart.square().mean() + idm_error.square().mean())
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]  # PyTorch declares no types for it
                optimizer.step()
                schedule.step()
        return PhysicsInformedDriver(module, round(_HOLD_S / pairs.dt))


class PhysicsInformedDriver(StepDriver):
    """Drives by the network alone."""

    def __init__(self, module: nn.Module, every: int) -> None:
        self._module = module
        self.every = every

    def accelerations(
        self, seen: Seen, memory: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        speed = seen.follower_speed[:, -1]
        state = torch.stack([speed, seen.leader_speed[:, -1] - speed, seen.gap[:, -1]], 1)
        return _answer(self._module, state).clamp(-8.0, 4.0), memory


def _answer(module: nn.Module, states: Tensor) -> Tensor:
    """Returns accelerations of speed, relative speed and gap `(N, 3)`."""
    near = torch.cat([states[:, :2], states[:, 2:].clamp(0.0, 150.0)], 1)
    answer: Tensor = module(near / _SCALE)
    return answer[:, 0]


def _idm(model: DrivingModel, parameters: Tensor, states: Tensor) -> Tensor:
    """Returns the IDM's accelerations over half a second."""
    speed, relative, gap = states.unbind(1)
    nothing = torch.zeros_like(speed)
    follower = Follower(nothing, speed, nothing, model.initial_memory(speed))
    leader = Leader(gap.clamp(min=1.0), speed + relative, nothing, torch.zeros(()).double())
    changed = model.next_speed(follower, leader, model.space.unpack(parameters), _HOLD_S)
    return (changed - speed) / _HOLD_S


def _moments(pairs: PairSet) -> tuple[Tensor, Tensor, Tensor]:
    """Returns states `(N, 3)` every half second, accelerations, and weights: sites count alike."""
    batch = PairBatch.of(pairs)
    every = round(_HOLD_S / batch.dt)
    speed, gap = batch.follower_speed[:, ::every], batch.gap[:, ::every]
    relative = batch.leader_speed[:, ::every] - speed
    states = torch.stack([speed, relative, gap], -1)[:, :-1]
    usable = batch.mask[:, ::every][:, 1:] & (gap[:, :-1] > 0.0)
    actions = speed.diff(dim=1) / _HOLD_S
    sites = np.unique(np.array([pair.site for pair in pairs]), return_inverse=True)[1]
    site = torch.as_tensor(sites)[:, None].expand_as(usable)[usable]
    weights = 1.0 / torch.bincount(site).double()
    return states[usable], actions[usable], weights[site]
