"""A driver's unit in C: made from the driver's graph, compiled, compared with cfx, packed.

Units of different interfaces (FMI 3.0, OSMP) share the driver, `driving.h`, and what is here.
"""

from __future__ import annotations

import ctypes
import hashlib
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from cfx.errors import NotInstalledError
from cfx.plugin import DriverStep, files
from cfx_drivers.fmi import source
from cfx_drivers.fmi.description import IDENTIFIER
from cfx_drivers.onnx.agreement import Array, Run, largest_difference
from cfx_drivers.onnx.export import check_difference
from cfx_drivers.onnx.graph import graph_of, signals_of

DRIVING = Path(__file__).with_name("driving.h")
"""What units of all interfaces share."""

MAIN = "unit.c"
"""The source file that is compiled; it includes the others."""

_LIBRARIES = {"Linux": "so", "Darwin": "dylib", "Windows": "dll"}
"""Endings of libraries by operating system."""

_COMPILERS = ("cc", "gcc", "clang")


@dataclass(frozen=True)
class Unit:
    """A driver's unit, compiled for this machine.

    Attributes:
        step: cfx's own step of the driver.
        signals: unit and meaning of each input, in order.
        token: that belongs to this unit alone.
        sources: texts by file name.
        library: the compiled unit.
        difference: of speeds from cfx's after one step, m/s at most.
    """

    step: DriverStep
    signals: Mapping[str, tuple[str, str]]
    token: str
    sources: Mapping[str, str]
    library: Path
    difference: float


@contextmanager
def built(run: str, step: DriverStep, paths: Iterable[Path], to: str) -> Iterator[Unit]:
    """Makes a run's unit, whose library is there as long as the context is.

    Args:
        run: as the user names it.
        step: of its drivers.
        paths: of the C files that the interface needs, `MAIN` among them.
        to: the export format, for messages.

    Raises:
        NotInstalledError: there is no C compiler.
        ConfigError: the driver cannot be written in C, or drives otherwise than cfx's.
    """
    compiler = _compiler(to)
    graph = graph_of(step, run, one_driver=True)
    signals = signals_of(step)
    sources = {"driver.c": source.step_of(graph)}
    for path in (DRIVING, *paths):
        sources[path.name] = path.read_text(encoding="utf-8")
    token = hashlib.sha256("".join(sources.values()).encode()).hexdigest()
    sources["driver.h"] = source.header_of(graph, list(signals), step.dt, token)
    with tempfile.TemporaryDirectory(prefix="cfx-") as folder:
        library = _compiled(compiler, sources, Path(folder))
        difference = largest_difference(step, _in_c(library, graph))
        check_difference(run, "C code", difference)
        yield Unit(step, signals, token, sources, library, difference)


def write_unit(output: Path, unit: Unit, place: str, contents: Mapping[str, bytes]) -> list[str]:
    """Writes an FMU; the same unit has the same bytes.

    Args:
        output: the file.
        unit: whose library and sources go into it.
        place: what FMI calls this machine.
        contents: of further files in it, by path.

    Returns:
        Sentences for the user.
    """
    everything = dict(contents)
    everything[f"binaries/{place}/{unit.library.name}"] = unit.library.read_bytes()
    for name, text in unit.sources.items():
        everything[f"sources/{name}"] = text.encode("utf-8")
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in everything.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    data = buffer.getvalue()
    files.write_output(output, data, "the FMU")
    return [
        f"{output}: {len(data) / 1e6:.1f} MB; steps of any length; the driver decides every"
        f" {unit.step.dt:g} s, after which speeds differ from cfx's by {unit.difference:.1g} m/s"
        " at most",
        f"It runs on {place} as it is, elsewhere from its sources (fmpy compile {output.name})",
    ]


def _compiler(to: str) -> str:
    """Returns the C compiler of this machine.

    Raises:
        NotInstalledError: there is none.
    """
    for name in _COMPILERS:
        path = shutil.which(name)
        if path is not None:
            return path
    raise NotInstalledError(
        f"cfx export --to {to} needs a C compiler ({', '.join(_COMPILERS)}), and there is none;"
        " install one (Debian: apt install gcc)"
    )


def _compiled(compiler: str, sources: Mapping[str, str], folder: Path) -> Path:
    """Compiles the unit for this machine.

    Args:
        compiler: its path.
        sources: by file name.
        folder: where.

    Returns:
        The library.
    """
    target = folder / f"{IDENTIFIER}.{_LIBRARIES[platform.system()]}"
    for name, text in sources.items():
        (folder / name).write_text(text, encoding="utf-8")
    command = [compiler, "-std=gnu11", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-w"]
    # Our own sources, no shell.
    subprocess.run(  # noqa: S603
        [*command, str(folder / MAIN), "-o", str(target), "-lm"], check=True
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
