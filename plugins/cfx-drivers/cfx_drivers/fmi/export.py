"""`cfx export --to fmi`: a driver as a co-simulation unit (FMU) of FMI 3.0.

The unit holds the driver's ONNX graph (`cfx_drivers.onnx`) and runs it with ONNX Runtime;
PythonFMU3 brings the functions that FMI asks for, as libraries for Linux and Windows.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from pythonfmu3 import FmuBuilder

from cfx.plugin import ExportFormat, files, folder_of
from cfx_drivers.onnx.export import OnnxExport

NAME = "driver.fmu"


class FmiExport(ExportFormat):
    """Writes a policy with its driving model as an FMU."""

    def write(self, run: str, output: Path | None) -> list[str]:
        source = run.partition("#")[0]
        folder = folder_of(source)
        if output is None:
            output = (folder if Path(source).expanduser().is_dir() else Path()) / NAME
        with tempfile.TemporaryDirectory(prefix="cfx-") as name:
            graph, script = Path(name, "driver.onnx"), Path(name, "cfx_driver.py")
            said = OnnxExport().write(run, graph)[0]
            shutil.copy(Path(__file__).with_name("driver.py"), script)
            unit = FmuBuilder.build_FMU(
                script,
                dest=name,
                project_files=[graph],
                needsExecutionTool=True,
                canHandleVariableCommunicationStepSize=False,
            )
            data = unit.read_bytes()
        files.write_output(output, data, "the FMU")
        return [
            f"{output}: {len(data) / 1e6:.1f} MB; {said.partition('; ')[2]}",
            "It needs Python with numpy and onnxruntime where it is simulated",
        ]
