"""Inputs of policies that read further signals, from training to drivers elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from cfx.core import registry
from cfx.data.pairs import PairBatch
from cfx.data.signals import SIGNALS
from cfx.errors import ConfigError, DataError, PluginError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.platoon import measure_platoons
from cfx.models.idm import IDM
from cfx.policies.driver_step import DriverStep, Motion
from cfx.policies.history import History, history_of, measured_history
from cfx.policies.inputs import policy_inputs, require_no_further_signals
from cfx.policies.inputs.base import PolicyInput
from cfx.policies.inputs.motion import InverseTimeToCollision, TimeHeadway
from cfx.simulation.rollout import MemoryStepper
from tests.agents import adaptive
from tests.drives import wavy_pairs
from tests.further import RAIN, SECOND_GAP, known_inputs, with_surroundings

IDM_SETS = torch.tensor([[30.0, 1.2, 2.0, 1.5, 1.5], [25.0, 1.8, 3.0, 1.0, 2.0]]).double()
PAIRS = with_surroundings(wavy_pairs(IDM(), IDM_SETS, frames=80))
BATCH = PairBatch.of(PAIRS)
FURTHER = ("rain", "second_leader")


@pytest.fixture(autouse=True)
def _inputs() -> Iterator[None]:
    with known_inputs():
        yield


def test_measured_frames_have_the_further_signals_as_recorded() -> None:
    everything = history_of(BATCH)
    for signal, values in PAIRS[0].surroundings.items():
        torch.testing.assert_close(everything[signal.name][0], torch.as_tensor(values))
    rows, frame = torch.arange(2), torch.tensor([40, 50])
    recent = measured_history(BATCH, rows, frame, 5)
    for name, values in recent.items():
        torch.testing.assert_close(values[1], everything[name][1, 46:51])
    at_first = measured_history(BATCH, rows, torch.tensor([2, 0]), 5)
    for name, values in at_first.items():
        # The first frame stands for those before.
        torch.testing.assert_close(values[0], everything[name][0, [0, 0, 0, 1, 2]])
        torch.testing.assert_close(values[1], everything[name][1, [0, 0, 0, 0, 0]])


def test_what_has_a_pole_is_bounded_there() -> None:
    values = {"follower_speed": 0.0, "leader_speed": 2.0, "gap": 0.1}
    standing = {name: torch.tensor([value]).double() for name, value in values.items()}
    assert TimeHeadway().values(standing).item() == pytest.approx(0.1)
    assert InverseTimeToCollision().values(standing).item() == pytest.approx(-2.0)


def test_a_driver_elsewhere_is_given_further_signals_and_drives_as_in_evaluation() -> None:
    agent = adaptive({"name": "idm"}, further=FURTHER)
    zeros = torch.zeros(2, dtype=torch.int64)
    stepper = MemoryStepper(IDM(), 0.1, compile="never")
    expected = simulate_closed_loop(stepper, agent, Followers(BATCH, zeros), zeros).speed
    torch.testing.assert_close(driven(DriverStep(agent)), expected, rtol=0, atol=1e-11)
    surroundings = {
        signal: stored * (signal != RAIN) for signal, stored in BATCH.surroundings.items()
    }
    other = Followers(replace(BATCH, surroundings=surroundings), zeros)
    without_rain = simulate_closed_loop(stepper, agent, other, zeros).speed
    assert float((without_rain - expected).abs().max()) > 1e-3


def driven(step: DriverStep) -> Tensor:
    """Drives behind the leaders of BATCH from frame 0 on; speeds `(2, 80)`."""
    state = step.begin(2)
    position, speed = BATCH.follower_position[:, 0], BATCH.follower_speed[:, 0]
    acceleration = BATCH.follower_acceleration[:, 0]
    speeds = [speed]
    for frame in range(79):
        leader = Motion(BATCH.leader_speed[:, frame], BATCH.leader_acceleration[:, frame])
        gap = BATCH.leader_position[:, frame] - BATCH.leader_length - position
        surroundings = {}
        for signal, stored in BATCH.surroundings.items():
            surroundings[signal.name] = signal.seen_from(position, stored[:, frame])
        ego = Motion(speed, acceleration)
        after, state = step(state, ego, leader, gap, surroundings=surroundings)
        acceleration = (after - speed) / step.dt
        position = position + after * step.dt
        speed = after
        speeds.append(speed)
    return torch.stack(speeds, 1)


def test_what_a_driver_is_not_given_is_named() -> None:
    step = DriverStep(adaptive({"name": "idm"}, further=FURTHER))
    assert step.signals[5:] == ("rain", "second_leader_gap", "second_leader_speed")
    motion, gap = Motion(torch.ones(1).double(), torch.zeros(1).double()), torch.ones(1).double()
    with pytest.raises(DataError, match=r"reads the signal 'rain' .*surroundings=\{'rain'"):
        step(step.begin(1), motion, motion, gap)
    with pytest.raises(ConfigError, match=r"'rain' reads the signal 'rain' .*which SUMO does not"):
        require_no_further_signals(step.agent.core.inputs, "SUMO")


def test_a_recording_without_the_signal_is_named() -> None:
    agent = adaptive({"name": "idm"}, further=("rain",))
    zeros = torch.zeros(2, dtype=torch.int64)
    dry = replace(BATCH, surroundings={})
    with pytest.raises(DataError, match=r"reads the signal 'rain' .* a column rain_mmph"):
        agent.burn_in(dry, zeros + 20, agent.begin(zeros))


def test_no_platoon_is_made_up_for_a_policy_that_reads_further_signals() -> None:
    agent = adaptive({"name": "idm"}, further=("rain",))
    usual = adaptive({"name": "idm"})
    assert measure_platoons(IDM(), {"policy": (agent, ("all",))}) is None
    platoon = measure_platoons(
        IDM(), {"policy": (agent, ("all",)), "driver_specific": (usual, ("all",))}
    )
    assert platoon is not None
    assert set(platoon.measures["method"]) == {"driver_specific"}


class Unnamed(PolicyInput):
    """Says nothing of itself."""

    def values(self, history: History) -> Tensor:
        return history["gap"]


class Meaningless(Unnamed):
    """Says what it reads alone."""

    signals = (SIGNALS["gap"],)


class OtherRain(PolicyInput):
    """Means something else by the same name."""

    meaning = "rain in another unit"
    signals = (replace(RAIN, unit="m/s"), SIGNALS["gap"])

    def values(self, history: History) -> Tensor:
        return history["rain"]


def test_inputs_say_what_they_read() -> None:
    for says_too_little in (Unnamed, Meaningless):
        with pytest.raises(PluginError, match="does not say which signals it reads"):
            registry.add("input", "unnamed", says_too_little)
    registry.add("input", "other_rain", OtherRain)
    try:
        with pytest.raises(PluginError, match=r"the signal 'rain' .* is declared in two ways"):
            policy_inputs(("rain", "other_rain"))
    finally:
        registry._of_this_process.pop(("input", "other_rain"))
    assert SECOND_GAP in policy_inputs(("second_leader",))[0].further_signals()
