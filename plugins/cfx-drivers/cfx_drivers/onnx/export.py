"""`cfx export --to onnx`: a policy with its driving model as one ONNX graph, and its card.

The graph is one step of D drivers (`cfx.policies.driver_step`): network, head, model step and
guard. What is remembered goes in and comes out as tensors, all zeros for a driver who begins.
"""

from __future__ import annotations

from pathlib import Path

import torch

from cfx.errors import ConfigError, DataError
from cfx.plugin import ANY_DRIVER, Agent, DriverStep, ExportFormat, files, folder_of, load_agent
from cfx_drivers.onnx.agreement import in_onnx_runtime, largest_difference
from cfx_drivers.onnx.card import card
from cfx_drivers.onnx.graph import graph_of

NAME = "driver.onnx"

MOST_DIFFERENCE = 1e-4
"""m/s, by which speeds after one step in ONNX Runtime may differ from cfx's. Networks are in single
precision, whose rounding moves a speed of IDM by 1e-7 and one of Wiedemann 99 by 2e-6 m/s."""


class OnnxExport(ExportFormat):
    """Writes a policy with its driving model as one ONNX graph, and a card beside it."""

    def write(self, run: str, output: Path | None) -> list[str]:
        output = output or default_output(run, NAME)
        step = step_of(run)
        graph = graph_of(step, run)
        data = graph.SerializeToString()
        difference = largest_difference(step, in_onnx_runtime(data))
        check_difference(run, "ONNX graph", difference)
        files.write_output(output, data, "the ONNX file")
        beside = output.with_suffix(".md")
        files.write_output(beside, card(graph, run, len(data), difference), "the card")
        return [
            f"{output}: {len(data) / 1000:.0f} kB; steps of {step.dt:g} s, after each of"
            f" which speeds differ from cfx's by {difference:.1g} m/s at most",
            f"{beside} says what goes in and out",
        ]


def check_difference(run: str, what: str, difference: float) -> None:
    """Refuses to write a driver that drives otherwise than cfx's.

    Args:
        run: whose driver it is.
        what: was exported, in words.
        difference: of speeds after one step, m/s; NaN where one is not a number.

    Raises:
        ConfigError: the difference is too large.
    """
    if not difference <= MOST_DIFFERENCE:
        raise ConfigError(
            f"{run}: speeds of its {what} differ from cfx's by {difference:.1g} m/s, so it was not"
            " written; export another policy, and report this one"
        )


def default_output(run: str, name: str) -> Path:
    """Returns where a file of a run is written: into the job's folder, else here."""
    source = run.partition("#")[0]
    folder = folder_of(source)
    return (folder if Path(source).expanduser().is_dir() else Path()) / name


def step_of(run: str) -> DriverStep:
    """Returns the step of a run's drivers.

    Args:
        run: a job's folder or `cfx://NAME`, with `#NETWORK` behind it where it is not the one for
            unseen drivers.

    Raises:
        DataError: there is no policy, or it has no such network.
    """
    source, _, network = run.partition("#")
    return DriverStep(_agent(run, folder_of(source), network))


def _agent(run: str, folder: Path, network: str) -> Agent:
    """Reads the policy of a job's folder, with one network.

    Raises:
        DataError: there is no policy, or it has no such network.
    """
    if not (folder / "policy.json").is_file():
        folder = folder / "policy"
    agent = load_agent(folder)
    if not network or (network == ANY_DRIVER and ANY_DRIVER not in agent.names):
        return agent.for_unseen_drivers()
    if network not in agent.names:
        raise DataError(
            f"{run}: the policy has no network '{network}'; it has {', '.join(agent.names[:5])}"
        )
    return agent.only(torch.tensor([agent.names.index(network)]))
