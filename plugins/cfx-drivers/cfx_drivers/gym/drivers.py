"""What drives: the policy of a job, as one step of drivers."""

from __future__ import annotations

from pathlib import Path

from cfx.plugin import Agent, DriverStep, folder_of, load_agent, require_no_further_signals


def driver_step(driver: str | Path | Agent) -> DriverStep:
    """Returns the step of a driver.

    Args:
        driver: a job's folder, its URL, the id of its MLflow run, a ready-made policy
            (`cfx://NAME`), or an agent.

    Raises:
        DataError: there is no policy, or none for unseen drivers.
        ConfigError: its driving model has equations in a simulator only, or an input of the policy
            reads what these environments do not have.
    """
    agent = driver
    if not isinstance(agent, Agent):
        folder = folder_of(agent)
        if not (folder / "policy.json").is_file():
            folder = folder / "policy"
        agent = load_agent(folder)
    require_no_further_signals(agent.core.inputs, "this environment")
    return DriverStep(agent)
