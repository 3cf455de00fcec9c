"""`cfx export --to fmi`: a driver as a co-simulation unit (FMU) of FMI 3.0.

The unit is C alone: the driver's ONNX graph, translated (`cfx_drivers.fmi.source`), and the
functions that FMI asks for (`unit.c`). It holds a library for this machine, and its sources, from
which importers make one for another.
"""

from __future__ import annotations

import platform
from pathlib import Path

from cfx.plugin import ExportFormat
from cfx_drivers.fmi.description import build_description, description_of
from cfx_drivers.fmi.unit import MAIN, built, write_unit
from cfx_drivers.onnx.export import default_output, step_of

NAME = "driver.fmu"

_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""FMI's names of machines that Python calls otherwise."""


class FmiExport(ExportFormat):
    """Writes a policy with its driving model as an FMU."""

    def write(self, run: str, output: Path | None) -> list[str]:
        output = output or default_output(run, NAME)
        step = step_of(run)
        about = f"A driver that cfx trained, who decides every {step.dt:g} s: {run}"
        is_random = bool(step.noise_width)
        with built(run, step, [Path(__file__).with_name(MAIN)], "fmi") as unit:
            contents = {
                "modelDescription.xml": description_of(
                    unit.signals, step.dt, unit.token, about, is_random
                ),
                "sources/buildDescription.xml": build_description(),
            }
            return write_unit(output, unit, _machine(), contents)


def _machine() -> str:
    """Returns what FMI 3.0 calls this machine."""
    machine = platform.machine().lower()
    return f"{_MACHINES.get(machine, machine)}-{platform.system().lower()}"
