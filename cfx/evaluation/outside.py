"""What is said of a policy that drove outside what it has learned from."""

from __future__ import annotations

from collections.abc import Mapping

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.policies.agent import Agent
from cfx.policies.valid_range import share_in_words


def outside_in_words(agent: Agent, loop: ClosedLoop) -> str:
    """Returns "37 % of steps outside what the policy has learned (speed above 18 m/s)".

    It is "" where no step was, or where nobody knows.
    """
    if agent.valid_range is None or loop.outside is None or loop.beyond is None:
        return ""
    steps = int(loop.counted.sum())
    outside = int((loop.outside & loop.counted).sum())
    return share_in_words(agent.valid_range, outside, steps, loop.beyond)


def outside_of_scopes(
    agent: Agent, scopes: Mapping[str, Mapping[str, ClosedLoop]]
) -> dict[str, str]:
    """Returns `Evaluation.outside`: `outside_in_words` of each scope where something was outside.

    Args:
        agent: what drove as `policy`.
        scopes: by scope and method the closed loops.
    """
    found = {}
    for scope, loops in scopes.items():
        words = ""
        if "policy" in loops:
            words = outside_in_words(agent, loops["policy"])
        if words:
            found[scope] = words
    return found
