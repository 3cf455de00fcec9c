"""A driver's step as C: the ONNX graph of one driver, translated, and how `unit.c` calls it."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import onnx
import onnx.inliner
import onnxruntime

from cfx.errors import ConfigError

_C_TYPES = {
    onnx.TensorProto.DOUBLE: "double",
    onnx.TensorProto.FLOAT: "float",
    onnx.TensorProto.INT64: "int64_t",
}

_FOLDED = 2
"""How often constants are folded: what functions hold is seen once these are part of the graph."""

NOISE = "noise"


def step_of(graph: onnx.ModelProto) -> str:
    """Translates the graph of one driver's step to C: a function `driver`.

    emmtrix's generator wants a graph whose shapes are all known, which ONNX Runtime makes by
    folding constants.

    Args:
        graph: of one driver.

    Raises:
        ConfigError: the graph computes with what the generator does not know.
    """
    with tempfile.TemporaryDirectory(prefix="cfx-") as name:
        file, source = Path(name, "driver.onnx"), Path(name, "driver.c")
        onnx.save(onnx.inliner.inline_local_functions(graph), file)
        for _ in range(_FOLDED):
            options = onnxruntime.SessionOptions()
            options.log_severity_level = 3  # what cannot be folded is no news
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
            options.optimized_model_filepath = str(file.with_suffix(".folded"))
            onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
            file.with_suffix(".folded").replace(file)
        command = [sys.executable, "-m", "emx_onnx_cgen", "compile", str(file), str(source)]
        # Weights are numbers in the source, and nothing is shared between instances.
        command += ["--large-weight-threshold", "0", "--large-temp-threshold", "0"]
        command += ["--model-name", "driver", "--color", "never"]
        # The generator's own command, no shell.
        done = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603
        if done.returncode:
            raise ConfigError(
                "the driver cannot be written in C, for"
                f" {(done.stdout + done.stderr).strip().splitlines()[-1]}; export it with --to onnx"
            )
        return source.read_text(encoding="utf-8")


def header_of(graph: onnx.ModelProto, signals: list[str], dt: float, token: str) -> str:
    """Returns `driver.h`: what a driver remembers, and its step with as many arguments as any.

    Args:
        graph: of one driver.
        signals: inputs in the order of the unit's; the graph has those that the driver reads.
        dt: of the driver's step, s.
        token: the unit's instantiation token.
    """
    inputs, outputs = list(graph.graph.input), list(graph.graph.output)
    given, remembered, noise = [], [], 0
    for tensor in inputs:
        if tensor.name in signals:
            given.append(f"&signal[{signals.index(tensor.name)}]")
        elif tensor.name == NOISE:
            given.append("noise")
            noise = _size(tensor)
        else:
            given.append(f"before->{tensor.name}")
    given.append("speed")
    for tensor in outputs[1:]:
        name = tensor.name.removeprefix("next_")
        given.append(f"after->{name}")
        remembered.append(
            f"    {_C_TYPES[tensor.type.tensor_type.elem_type]} {name}[{_size(tensor)}];"
        )
    pointers = [f"(void *)({argument})" for argument in given]
    places = [f"(void *)given[{number}]" for number in range(len(inputs))]
    places += [f"made[{number}]" for number in range(len(outputs))]
    return f"""#include "driver.c"

#define TOKEN "{token}"
#define DT {dt!r}
#define SIGNALS {len(signals)}
#define NOISE {noise}

struct remembered {{
{chr(10).join(remembered)}
}};

static void driver_step(const double *signal, const struct remembered *before,
                        const double *noise, double *speed, struct remembered *after) {{
    driver({", ".join(pointers)});
}}

/* The step alone, by which it is compared with cfx's: tensors in the order of the ONNX graph. */
EXPORT void cfx_step(const void *const *given, void *const *made) {{
    driver({", ".join(places)});
}}
"""


def shape_of(tensor: onnx.ValueInfoProto) -> tuple[int, ...]:
    """Returns a tensor's shape, all of which is known."""
    return tuple(dimension.dim_value for dimension in tensor.type.tensor_type.shape.dim)


def _size(tensor: onnx.ValueInfoProto) -> int:
    return math.prod(shape_of(tensor))
