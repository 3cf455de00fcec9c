"""`gipps_delay`: the contract, the paper's equation at every instant, a loop in plain Python."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

import cfx
from cfx.errors import ConfigError
from cfx.plugin import DrivingModel, Follower, Leader, Start
from cfx.simulation.rollout import simulate_follower
from cfx_community.models.gipps import Gipps
from cfx_community.models.gipps_delay import GippsDelay
from cfx_contracts.models import keeps_its_equilibrium

from .steps import LENGTH, number

A, B, B_HAT, V, S0 = 1.7, 3.4, 3.2, 20.0, 2.0
TAU = 2 / 3
START_SPEED, START_GAP = 11.0, 25.0


def test_it_keeps_its_equilibrium_below_its_desired_speed() -> None:
    def gap(speed: Tensor, p: Mapping[str, Tensor]) -> Tensor:
        return p["s0"] + 1.5 * speed * p["tau"] + speed**2 * (1 / p["b"] - 1 / p["b_hat"]) / 2

    keeps_its_equilibrium(GippsDelay(parameters={"V": {"low": 21.0, "default": 25.0}}), gap)


def leader_of(dt: float, frames: int) -> Leader:
    """Drives at 10 m/s with swings, and stops for a while after 20 s."""
    t = torch.arange(frames, dtype=torch.float64) * dt
    swinging = 10.0 + 4.0 * torch.sin(0.4 * t)
    braking = (swinging - 2.5 * (t - 20.0).clamp(min=0.0)).clamp(min=0.0)
    speed = torch.where(t < 35.0, braking, (1.2 * (t - 35.0)).clamp(max=12.0))
    position = torch.cat([torch.zeros(1).double(), torch.cumsum(speed[1:] * dt, dim=0)])
    return Leader(position[None], speed[None], torch.zeros_like(speed)[None], number(LENGTH)[None])


def start() -> Start:
    return Start(number(-LENGTH - START_GAP)[None], number(START_SPEED)[None], number(0.0)[None])


def chosen(gap: float, v: float, v_l: float, tau: float) -> float:
    """Gipps (1981), equation 12, with positive decelerations; without a gap: -B tau."""
    free = v + 2.5 * A * tau * (1 - v / V) * math.sqrt(0.025 + v / V)
    radicand = B * B * tau * tau + B * (2 * (gap - S0) - v * tau + v_l * v_l / B_HAT)
    return min(free, math.sqrt(max(0.0, radicand)) - B * tau)


def loop_in_plain_python(leader: Leader, dt: float, tau: float) -> list[float]:
    """The same driver, step by step, with the past in a deque, the latest frame last."""
    x_l, v_l = leader.position[0].tolist(), leader.speed[0].tolist()
    x, v = -LENGTH - START_GAP, START_SPEED
    past: deque[tuple[float, float, float]] = deque(maxlen=1000)
    speeds = [v]
    for k in range(len(x_l) - 1):
        past.append((x_l[k] - LENGTH - x, v, v_l[k]))
        wanted = (k + 1) * dt - tau  # the time that the driver acts on
        if wanted <= 0.0:
            seen = past[0]
            remaining = max(dt, tau - k * dt)
        elif tau <= dt:
            seen = past[-1]
            remaining = dt
        else:
            before = min(int(wanted / dt), k - 1)
            share = wanted / dt - before
            seen = tuple(
                early + (late - early) * share
                for early, late in zip(past[before], past[before + 1], strict=True)
            )
            remaining = dt
        v = max(0.0, v + (chosen(*seen, tau) - v) * dt / remaining)
        x += v * dt
        speeds.append(v)
    return speeds


@pytest.mark.parametrize("tau", [0.3, 0.45, TAU, 1.0, 1.37, 2.0])
def test_it_drives_as_a_loop_in_plain_python_does(tau: float) -> None:
    leader = leader_of(0.1, 600)
    out = simulate_follower(GippsDelay(), {"tau": tau}, leader, start(), 0.1)
    wanted = torch.tensor(loop_in_plain_python(leader, 0.1, tau), dtype=torch.float64)
    torch.testing.assert_close(out.speed[0], wanted, rtol=0, atol=1e-9)


def test_a_reaction_time_of_a_step_or_less_is_no_delay() -> None:
    for dt, tau in ((TAU, TAU), (0.8, 0.8), (0.8, 0.3)):
        leader = leader_of(dt, 80)
        without = simulate_follower(Gipps(), {"tau": tau}, leader, start(), dt)
        delayed = simulate_follower(GippsDelay(), {"tau": tau}, leader, start(), dt)
        torch.testing.assert_close(delayed.speed, without.speed)


def test_speeds_that_lie_a_reaction_time_apart_obey_the_papers_equation() -> None:
    parts = 5
    out = simulate_follower(
        GippsDelay(shortest_step_s=TAU / parts),
        None,
        leader_of(TAU / parts, 300),
        start(),
        TAU / parts,
    )
    gap, speed = out.gap[0].tolist(), out.speed[0].tolist()
    leader_speed = leader_of(TAU / parts, 300).speed[0].tolist()
    for k in range(300 - parts):
        papers = max(0.0, chosen(gap[k], speed[k], leader_speed[k], TAU))
        assert speed[k + parts] == pytest.approx(papers, abs=1e-9)


@pytest.mark.parametrize(("model", "frames"), [(Gipps(), 1), (GippsDelay(), 10)])
def test_it_answers_a_braking_leader_after_the_reaction_time(
    model: DrivingModel, frames: int
) -> None:
    """Without the delay the first step after the leader's frame is the first that differs."""
    calm = leader_of(0.1, 200)
    braked = calm._replace(speed=calm.speed.clone())
    braked.speed[0, 100] = 0.0
    speeds = [
        simulate_follower(model, {"tau": 1.0}, one, start(), 0.1).speed[0] for one in (calm, braked)
    ]
    differs = (speeds[0] - speeds[1]).abs() > 1e-9
    assert int(differs.nonzero()[0]) == 100 + frames


@pytest.mark.slow
def test_compiled_steps_carry_the_memory_as_eager_ones_do() -> None:
    leader = leader_of(0.1, 53)
    taus = torch.linspace(0.3, 2.0, 7, dtype=torch.float64)[:, None]
    at = GippsDelay().space.defaults().expand(7, -1).clone()
    at[:, :1] = taus
    eager, compiled = (
        simulate_follower(GippsDelay(), at, leader, start(), 0.1, compile=mode)
        for mode in ("never", "always")
    )
    torch.testing.assert_close(compiled.speed, eager.speed)


def test_gradients_reach_what_was_seen_before() -> None:
    """The delay itself has a gradient, as have frames that lie in the memory."""
    model = GippsDelay(max_delay_s=1.0, parameters={"tau": {"high": 1.0}})
    space = model.space
    p = {one.name: number(one.default)[None] for one in space} | {"tau": number(0.66)[None]}
    leader = Leader(number(0.0)[None], number(9.0)[None], number(0.0)[None], number(LENGTH)[None])

    def last_speed(tau: Tensor, first_gap: Tensor) -> Tensor:
        speed = number(10.0)[None]
        follower = Follower(-LENGTH - first_gap, speed, 0 * speed, model.initial_memory(speed))
        for _ in range(12):
            values = p | {"tau": tau}
            next_speed = model.next_speed(follower, leader, values, 0.1)
            memory = model.next_memory(follower, leader, values, 0.1, next_speed)
            follower = Follower(follower.position + next_speed * 0.1, next_speed, 0 * speed, memory)
        return next_speed

    inputs = (p["tau"].clone().requires_grad_(), number(14.0)[None].requires_grad_())
    assert torch.autograd.gradcheck(last_speed, inputs, eps=1e-7, atol=1e-4)


def test_a_delay_beyond_the_memory_is_refused_with_what_to_write() -> None:
    with pytest.raises(ConfigError, match=r"write model\.max_delay_s=3, or lower"):
        GippsDelay(parameters={"tau": {"high": 3.0}})
    assert GippsDelay(max_delay_s=3.0, parameters={"tau": {"high": 3.0}}).memory_size == 91
    with pytest.raises(ConfigError, match=r"write model\.shortest_step_s=0\.04"):
        simulate_follower(GippsDelay(), None, leader_of(0.04, 10), start(), 0.04)


@pytest.mark.slow
def test_a_policy_learns_by_rollout_through_the_delay(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = cfx.run(
        [
            "model=gipps_delay",
            "policy=gru",
            "learner=rollout",
            "learner.epochs=2",
            "learner.steps=3",
            "learner.ensemble_size=1",
            "protocol=across_drivers",
            "protocol.folds=2",
            "data.pairs=4",
            "data.platoon_size=1",
            "data.frames=200",
            "optimizer=random",
            "optimizer.samples=32",
            "tracking.enabled=false",
            "figures=none",
        ]
    )
    assert math.isfinite(result.metrics["rmse_speed/policy"])
