"""`cfx export --to osmp`: a driver as an OSI traffic participant, an FMU of FMI 2.0 with OSMP.

As `cfx_drivers.fmi.export`, in C alone, with messages of OSI instead of numbers: `scene.h` finds
what the driver sees, nanopb (`nanopb/`, zlib licence) reads and writes messages.
"""

from __future__ import annotations

import platform
import sys
from pathlib import Path

from cfx.errors import ConfigError
from cfx.plugin import ExportFormat
from cfx_drivers.fmi.unit import MAIN, built, write_unit
from cfx_drivers.onnx.export import default_output, step_of
from cfx_drivers.osmp.description import description_of

NAME = "driver.osmp.fmu"

_FOLDER = Path(__file__).parent
_SYSTEMS = {"Linux": "linux", "Darwin": "darwin", "Windows": "win"}
"""FMI 2.0's names of operating systems."""


class OsmpExport(ExportFormat):
    """Writes a policy with its driving model as an FMU that exchanges messages of OSI."""

    def write(self, run: str, output: Path | None) -> list[str]:
        output = output or default_output(run, NAME)
        step = step_of(run)
        if step.further_signals:
            names = ", ".join(signal.name for signal in step.further_signals)
            raise ConfigError(
                f"{run}: the policy reads {names}, which scenes of OSI do not have; export it with"
                " --to fmi, or train one without (policy.inputs=[situation])"
            )
        about = f"A driver that cfx trained, who decides every {step.dt:g} s: {run}"
        is_random = bool(step.noise_width)
        sources = [_FOLDER / MAIN, _FOLDER / "scene.h", *_FOLDER.glob("osi.*")]
        library = sorted(_FOLDER.glob("nanopb/*.[ch]"))
        with built(run, step, [*sorted(sources), *library], "osmp") as unit:
            contents = {
                "modelDescription.xml": description_of(step.dt, unit.token, about, is_random, MAIN),
                "documentation/licenses/nanopb.txt": (
                    _FOLDER / "nanopb" / "LICENSE.txt"
                ).read_bytes(),
            }
            return write_unit(output, unit, _machine(), contents)


def _machine() -> str:
    """Returns what FMI 2.0 calls this machine."""
    return f"{_SYSTEMS[platform.system()]}{64 if sys.maxsize > 2**32 else 32}"
