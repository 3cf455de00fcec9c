"""`cfx export --to fmi`: a driver as a co-simulation unit (FMU) of FMI 3.0.

The unit is C alone: the driver's ONNX graph, translated (`cfx_drivers.fmi.source`), and the
functions that FMI asks for (`unit.c`). It holds a library for this machine, and its sources, from
which importers make one for another.
"""

from __future__ import annotations

import ctypes
import hashlib
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from cfx.errors import NotInstalledError
from cfx.plugin import ExportFormat, files
from cfx_drivers.fmi import source
from cfx_drivers.fmi.description import IDENTIFIER, build_description, description_of
from cfx_drivers.onnx.agreement import Array, Run, largest_difference
from cfx_drivers.onnx.export import check_difference, default_output, step_of
from cfx_drivers.onnx.graph import graph_of, signals_of

NAME = "driver.fmu"

_LIBRARIES = {
    "Linux": ("linux", "so"),
    "Darwin": ("darwin", "dylib"),
    "Windows": ("windows", "dll"),
}
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""FMI's names of operating systems and machines."""

_COMPILERS = ("cc", "gcc", "clang")


class FmiExport(ExportFormat):
    """Writes a policy with its driving model as an FMU."""

    def write(self, run: str, output: Path | None) -> list[str]:
        output = output or default_output(run, NAME)
        compiler = _compiler()
        step = step_of(run)
        graph = graph_of(step, run, one_driver=True)
        signals = signals_of(step)
        code = source.step_of(graph)
        unit = Path(__file__).with_name("unit.c").read_text(encoding="utf-8")
        token = hashlib.sha256((code + unit).encode()).hexdigest()
        header = source.header_of(graph, list(signals), step.dt, token)
        sources = {"driver.c": code, "driver.h": header, "unit.c": unit}
        about = f"A driver that cfx trained, who decides every {step.dt:g} s: {run}"
        description = description_of(signals, step.dt, token, about, bool(step.noise_width))
        with tempfile.TemporaryDirectory(prefix="cfx-") as folder:
            library = _compiled(compiler, sources, Path(folder))
            difference = largest_difference(step, _in_c(library, graph))
            check_difference(run, "C code", difference)
            data = _packed(description, sources, library)
        files.write_output(output, data, "the FMU")
        place = library.parent.name
        return [
            f"{output}: {len(data) / 1e6:.1f} MB; steps of any length; the driver decides every"
            f" {step.dt:g} s, after which speeds differ from cfx's by {difference:.1g} m/s at most",
            f"It runs on {place} as it is, elsewhere from its sources (fmpy compile {output.name})",
        ]


def _compiler() -> str:
    """Returns the C compiler of this machine.

    Raises:
        NotInstalledError: there is none.
    """
    for name in _COMPILERS:
        path = shutil.which(name)
        if path is not None:
            return path
    raise NotInstalledError(
        f"cfx export --to fmi needs a C compiler ({', '.join(_COMPILERS)}), and there is none;"
        " install one (Debian: apt install gcc)"
    )


def _compiled(compiler: str, sources: Mapping[str, str], folder: Path) -> Path:
    """Compiles the unit for this machine.

    Args:
        compiler: its path.
        sources: by file name.
        folder: where.

    Returns:
        The library, in a folder called as FMI calls this machine.
    """
    system, ending = _LIBRARIES[platform.system()]
    machine = platform.machine().lower()
    target = folder / f"{_MACHINES.get(machine, machine)}-{system}" / f"{IDENTIFIER}.{ending}"
    target.parent.mkdir()
    for name, text in sources.items():
        (folder / name).write_text(text, encoding="utf-8")
    command = [compiler, "-std=gnu11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-w"]
    # Our own sources, no shell.
    subprocess.run(  # noqa: S603
        [*command, str(folder / "unit.c"), "-o", str(target), "-lm"], check=True
    )
    return target


def _in_c(library: Path, graph: onnx.ModelProto) -> Run:
    """Returns what runs a library's step for each of several drivers."""
    step = ctypes.CDLL(str(library)).cfx_step
    inputs = [(tensor.name, _type_of(tensor)) for tensor in graph.graph.input]
    shapes = [(source.shape_of(tensor), _type_of(tensor)) for tensor in graph.graph.output]

    def run(given: Mapping[str, Array]) -> Array:
        speeds = []
        for driver in range(len(given["gap"])):
            arguments = []
            for name, kind in inputs:
                arguments.append(np.ascontiguousarray(given[name][driver], dtype=kind))
            made = [np.empty(shape, kind) for shape, kind in shapes]
            step(_pointers(arguments), _pointers(made))
            speeds.append(float(made[0][0]))
        return np.array(speeds)

    return run


def _type_of(tensor: onnx.ValueInfoProto) -> np.dtype[Any]:
    return onnx.helper.tensor_dtype_to_np_dtype(tensor.type.tensor_type.elem_type)


def _pointers(arrays: Sequence[np.ndarray[Any, Any]]) -> ctypes.Array[ctypes.c_void_p]:
    return (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))


def _packed(description: bytes, sources: Mapping[str, str], library: Path) -> bytes:
    """Returns the FMU; the same unit has the same bytes."""
    contents: dict[str, bytes] = {"modelDescription.xml": description}
    contents[f"binaries/{library.parent.name}/{library.name}"] = library.read_bytes()
    contents["sources/buildDescription.xml"] = build_description()
    for name, text in sources.items():
        contents[f"sources/{name}"] = text.encode("utf-8")
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()
