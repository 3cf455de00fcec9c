"""`cfx export --to onnx`: a policy with its driving model as one ONNX graph, and its card.

The graph is one step of D drivers (`cfx.policies.driver_step`): network, head, model step and
guard. What is remembered goes in and comes out as tensors, all zeros for a driver who begins.
"""

from __future__ import annotations

from pathlib import Path

import torch

from cfx.errors import ConfigError, DataError
from cfx.plugin import ANY_DRIVER, Agent, DriverStep, ExportFormat, files, folder_of, load_agent
from cfx_drivers.onnx.agreement import largest_difference
from cfx_drivers.onnx.card import card
from cfx_drivers.onnx.graph import graph_of

NAME = "driver.onnx"

MOST_DIFFERENCE = 1e-4
"""m/s, by which speeds after one step in ONNX Runtime may differ from cfx's. Networks are in single
precision, whose rounding moves a speed of IDM by 1e-7 and one of Wiedemann 99 by 2e-6 m/s."""


class OnnxExport(ExportFormat):
    """Writes a policy with its driving model as one ONNX graph, and a card beside it."""

    def write(self, run: str, output: Path | None) -> list[str]:
        source, _, network = run.partition("#")
        folder = folder_of(source)
        if output is None:
            output = (folder if Path(source).expanduser().is_dir() else Path()) / NAME
        step = DriverStep(_agent(run, folder, network))
        graph = graph_of(step, run)
        data = graph.SerializeToString()
        difference = largest_difference(step, data)
        if not difference <= MOST_DIFFERENCE:
            raise ConfigError(
                f"{run}: speeds of its ONNX graph differ from cfx's by {difference:.1g} m/s, so it"
                " was not written; export another policy, and report this one"
            )
        files.write_output(output, data, "the ONNX file")
        beside = output.with_suffix(".md")
        files.write_output(beside, card(graph, run, len(data), difference), "the card")
        return [
            f"{output}: {len(data) / 1000:.0f} kB; steps of {step.dt:g} s, after each of"
            f" which speeds differ from cfx's by {difference:.1g} m/s at most",
            f"{beside} says what goes in and out",
        ]


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
