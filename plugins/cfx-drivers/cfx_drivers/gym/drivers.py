"""What drives: the policy of a job, as one step of drivers."""

from __future__ import annotations

from pathlib import Path

from cfx.plugin import Agent, DriverStep, folder_of, load_agent


def driver_step(driver: str | Path | Agent) -> DriverStep:
    """Returns the step of a driver.

    Args:
        driver: a job's folder, its URL, the id of its MLflow run, a ready-made policy
            (`cfx://NAME`), or an agent.

    Raises:
        DataError: there is no policy, or none for unseen drivers.
        ConfigError: its driving model has equations in a simulator only.
    """
    if isinstance(driver, Agent):
        return DriverStep(driver)
    folder = folder_of(driver)
    if not (folder / "policy.json").is_file():
        folder = folder / "policy"
    return DriverStep(load_agent(folder))
