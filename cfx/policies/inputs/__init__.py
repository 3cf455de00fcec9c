"""Inputs of policies, and the sets of them that go by one name.

An input is a class and its entry point, of cfx or of another distribution:

    [project.entry-points."cfx.inputs"]
    rain = "my_package.rain:Rain"
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

from cfx.core import registry
from cfx.data.signals import Signal, further_signals
from cfx.errors import ConfigError
from cfx.policies.inputs.base import PolicyInput

SITUATION = (
    "leader_speed",
    "relative_speed",
    "gap",
    "time_headway",
    "follower_acceleration",
    "leader_acceleration",
)
"""The inputs with which closed-loop training works best."""

MOTION = (*SITUATION, "follower_jerk", "leader_jerk")
"""The situation and the jerks: for policies of smooth models that start from the driver's
acceleration. The follower's jerk misleads where a model's acceleration jumps, as Krauss's does."""

SPEEDS = ("leader_speed", "follower_speed")
"""The paper's inputs."""

INPUT_SETS: dict[str, tuple[str, ...]] = {
    "situation": SITUATION,
    "motion": MOTION,
    "speeds": SPEEDS,
}
"""Inputs that go by one name: `policy.inputs=situation`."""


def policy_inputs(names: Iterable[str]) -> tuple[PolicyInput, ...]:
    """Makes the inputs of a policy.

    Raises:
        PluginError: one is not installed, cannot be loaded, or declares a signal in another way
            than another one.
    """
    inputs = tuple(cast(PolicyInput, registry.create("input", {"name": name})) for name in names)
    signals_beyond_recordings(inputs)
    return inputs


def signals_beyond_recordings(inputs: Iterable[PolicyInput]) -> tuple[Signal, ...]:
    """Returns the further signals that some inputs read, each once.

    Raises:
        PluginError: two inputs declare a signal of one name or column in different ways.
    """
    signals: list[Signal] = []
    for policy_input in inputs:
        signals += policy_input.signals
    return further_signals(signals)


def require_no_further_signals(inputs: Iterable[PolicyInput], where: str) -> None:
    """Checks that some inputs read the signals of every recording alone.

    Args:
        inputs: of a policy.
        where: what gives no others, such as `SUMO`.

    Raises:
        ConfigError: an input reads another signal.
    """
    for policy_input in inputs:
        for signal in policy_input.further_signals():
            name = registry.name_of(policy_input)
            raise ConfigError(
                f"the policy's input '{name}' reads the signal '{signal.name}'"
                f" ({signal.meaning}), which {where} does not give; use a policy that was trained"
                " without this input"
            )
