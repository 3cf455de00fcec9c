"""One step of drivers: the closed loop of evaluation, and a graph without branches."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.core.registry import create
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError, DataError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.krauss import Krauss
from cfx.policies.agent import Agent
from cfx.policies.driver_step import DriverState, DriverStep, Motion
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.step import advance_vehicle
from tests.agents import adaptive
from tests.checkout import needs
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.5, 0.1], [2.5, 0.4], [2.0, 0.0]], dtype=torch.float64)
BATCH = PairBatch.of(wavy_pairs(Krauss(), TRUE, frames=80))
HEADS: dict[str, dict[str, Any]] = {
    "direct": {},
    "offset": {"offsets": True},
    "residual": {"residual": True},
    "stochastic": {"stochastic": True},
}


def drive(step: DriverStep, *, unbranched: bool = False, seed: int | None = None) -> Tensor:
    """Drives behind the leaders of BATCH from frame 0 on; speeds `(3, 80)`."""
    take = step.unbranched if unbranched else step.__call__
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    state = step.begin(3)
    position, speed = BATCH.follower_position[:, 0], BATCH.follower_speed[:, 0]
    acceleration = BATCH.follower_acceleration[:, 0]
    speeds = [speed]
    for frame in range(79):
        gap = BATCH.leader_position[:, frame] - BATCH.leader_length - position
        leader = Motion(BATCH.leader_speed[:, frame], BATCH.leader_acceleration[:, frame])
        noise = None
        if generator is not None and frame % 5 == 0:
            noise = torch.randn((3, step.noise_width), generator=generator, dtype=torch.float64)
        elif generator is not None:
            noise = torch.full((3, step.noise_width), 1e9, dtype=torch.float64)  # nobody draws
        with torch.no_grad():
            after, state = take(state, Motion(speed, acceleration), leader, gap, noise)
        acceleration = (after - speed) / step.dt
        position = position + after * step.dt
        speed = after
        speeds.append(speed)
    return torch.stack(speeds, 1)


def evaluated(agent: Agent, seed: int | None = None) -> Tensor:
    """What evaluation simulates of the same."""
    model = create("model", agent.model_node)
    assert isinstance(model, DrivingModel)
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    zeros = torch.zeros(3, dtype=torch.int64)
    stepper = MemoryStepper(model, 0.1, compile="never")
    return simulate_closed_loop(
        stepper, agent, Followers(BATCH, zeros), zeros, generator=generator
    ).speed


@pytest.mark.parametrize("node", [{"name": "krauss"}, {"name": "w99"}], ids=lambda n: n["name"])
@pytest.mark.parametrize("head", HEADS)
def test_it_drives_as_evaluation_does(head: str, node: dict[str, Any]) -> None:
    agent = adaptive(node, **HEADS[head])
    torch.testing.assert_close(drive(DriverStep(agent)), evaluated(agent), rtol=0, atol=1e-11)


def test_noise_counts_where_a_window_begins() -> None:
    agent = adaptive({"name": "krauss"}, stochastic=True)
    found = drive(DriverStep(agent), seed=4)
    wide = replace(agent, dispersion=torch.tensor([3.0]))
    assert torch.equal(drive(DriverStep(wide), seed=4), found), "forecasts alone are widened"
    torch.testing.assert_close(found, evaluated(agent, seed=4), rtol=0, atol=1e-11)
    assert (found - drive(DriverStep(agent))).abs().max() > 0.01


@pytest.mark.parametrize("head", HEADS)
def test_without_branches_it_drives_the_same(head: str) -> None:
    step = DriverStep(adaptive({"name": "idm"}, **HEADS[head]))
    torch.testing.assert_close(drive(step, unbranched=True), drive(step), rtol=0, atol=1e-11)


def test_the_step_exports_for_any_number_of_drivers() -> None:
    step = DriverStep(adaptive({"name": "w99"}, stochastic=True))

    class Module(torch.nn.Module):
        def forward(self, signals: Tensor, noise: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            v, a, v_l, a_l, gap = signals.unbind(0)
            ego, leader = Motion(v, a), Motion(v_l, a_l)
            speed, after = step.unbranched(DriverState(*state), ego, leader, gap, noise)
            return speed, *after

    drivers = torch.export.Dim("drivers")
    state = step.begin(3)
    noise = torch.zeros((3, step.noise_width), dtype=torch.float64)
    signals = torch.rand((5, 3), dtype=torch.float64) + 1.0
    exported = torch.export.export(
        Module(),
        (signals, noise, *state),
        dynamic_shapes=({1: drivers}, {0: drivers}, ({0: drivers},) * len(state)),
    )
    others = torch.rand((5, 7), dtype=torch.float64) * 20.0
    drawn = torch.randn((7, step.noise_width), dtype=torch.float64)
    found = exported.module()(others, drawn, *step.begin(7))
    v, a, v_l, a_l, gap = others.unbind(0)
    expected, after = step(step.begin(7), Motion(v, a), Motion(v_l, a_l), gap, drawn)
    for one, other in zip(found, (expected, *after), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_a_driver_begins_anew_with_zeros() -> None:
    step = DriverStep(adaptive({"name": "krauss"}, residual=True))
    motion, gap = (
        Motion(torch.full((2,), 9.0).double(), torch.ones(2).double()),
        torch.full((2,), 15.0).double(),
    )
    first, state = step(step.begin(2), motion, motion, gap)
    _, state = step(state, motion, motion, gap + 5.0)
    state = state.with_drivers(torch.tensor([1]), step.begin(1))
    again, _ = step(state, motion, motion, gap)
    assert again[1] == first[1]
    assert again[0] != first[0]


def on_roads(step: DriverStep, gaps: list[float], *, unbranched: bool = False) -> list[float]:
    """Returns the speeds of one driver, in m/s, behind a leader at these gaps, in m."""
    take = step.unbranched if unbranched else step.__call__
    speed, state = torch.tensor([10.0]).double(), step.begin(1)
    speeds = []
    for gap in gaps:
        # What is said of a leader who is not there does not count.
        leader = torch.tensor([12.0 if gap < math.inf else math.nan]).double()
        with torch.no_grad():
            after, state = take(
                state,
                Motion(speed, torch.zeros(1).double()),
                Motion(leader, leader - leader),
                torch.tensor([gap]).double(),
            )
        speeds.append(float(after))
        speed = after
    return speeds


@pytest.mark.parametrize("unbranched", [False, True])
@pytest.mark.parametrize("head", HEADS)
def test_without_a_leader_the_road_is_free_and_a_new_one_begins_anew(
    head: str, unbranched: bool
) -> None:
    agent = adaptive({"name": "idm"}, **HEADS[head])
    step = DriverStep(agent)
    free = on_roads(step, [math.inf] * 4 + [20.0] * 7, unbranched=unbranched)
    far = on_roads(step, [1e7] * 4, unbranched=unbranched)
    assert free[:4] == far
    parameters = agent.free_road_parameters(torch.zeros(1, dtype=torch.int64), agent.base)
    model = step.model
    still = torch.zeros(1).double()
    alone = advance_vehicle(
        model,
        Follower(still, still + 10.0, still, model.initial_memory(torch.tensor([10.0]).double())),
        Leader(still + 1e6, still + 10.0, still, still),
        agent.space.unpack(parameters),
        0.1,
    )
    assert free[0] == pytest.approx(float(alone.speed), abs=1e-12)
    state, speed = step.begin(1), torch.tensor([free[3]], dtype=torch.float64)
    anew, _ = step(state, Motion(speed, still), Motion(still + 12.0, still), still + 20.0)
    assert free[4] == pytest.approx(float(anew), abs=1e-12)
    assert on_roads(step, [20.0] * 3 + [math.inf], unbranched=unbranched)[3] > 0


@pytest.mark.parametrize("signal", range(5))
def test_what_is_no_number_is_refused_and_remembers_nothing(signal: int) -> None:
    step = DriverStep(adaptive({"name": "idm"}))
    values = [torch.full((3,), value).double() for value in (10.0, 0.0, 10.0, 0.0, 20.0)]
    values[signal][1] = math.nan
    v, a, v_l, a_l, gap = values
    with pytest.raises(DataError, match=r"of driver 1 is nan; give a number for each signal"):
        step(step.begin(3), Motion(v, a), Motion(v_l, a_l), gap)
    speed, _ = step.unbranched(step.begin(3), Motion(v, a), Motion(v_l, a_l), gap)
    assert speed.isnan().tolist() == [False, True, False]
    v, a, v_l, a_l = (torch.full((3,), math.inf).double() for _ in range(4))
    with pytest.raises(DataError, match="is inf"):
        step(step.begin(3), Motion(v, a), Motion(v_l, a_l), torch.full((3,), 20.0).double())


def test_networks_of_single_drivers_are_refused() -> None:
    with pytest.raises(DataError, match="2 networks"):
        DriverStep(adaptive({"name": "krauss"}, ("one", "two")))


@needs("cfx-sumo")
def test_equations_of_a_simulator_are_refused() -> None:
    agent = adaptive(
        {
            "name": "sumo_vtype",
            "car_follow_model": "IDM",
            "parameters": {"tau": {"low": 0.5, "high": 3.0, "default": 1.0}},
        }
    )
    with pytest.raises(ConfigError, match="equations in sumo only"):
        DriverStep(agent)
