"""What is recorded of a job, and how two records are compared.

Every number of `metrics.json` and everything in `policy.json` is kept. Of a column of `pairs.csv`
and of a tensor there is a hash, and the mean, which says by how much one that changed did.
Where rows and tensors stand counts; the order of names does not.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import safetensors.numpy
import torch

FILE = Path(__file__).with_name("hashes.json")

TOLERANCE = 1e-3
"""Relative difference of metrics that another processor or another version of torch may make.

Networks learn in float32, and what counts paths within a range jumps.
"""

_OF_RANKS = ("/p_value", "/win_rate")
"""Metrics that jump where two methods are equal but for rounding."""

Record = dict[str, dict[str, Any]]
"""What was recorded of a job: by file, by name in it."""


def machine() -> dict[str, str]:
    """Returns what the last bits of floating-point numbers depend on."""
    return {
        "architecture": platform.machine(),
        "processor": _processor(),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__.partition("+")[0],
        "numpy": np.__version__,
    }


def _processor() -> str:
    """Returns family, model and stepping of the processor, where Linux tells them."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    known = dict(line.split(":", 1) for line in lines if ":" in line)
    named = {key.strip(): value.strip() for key, value in known.items()}
    return " ".join(named.get(key, "") for key in ("cpu family", "model", "stepping")).strip()


def record(folder: Path) -> Record:
    """Reads the results of a finished job."""
    pairs = pd.read_csv(folder / "pairs.csv", dtype=str, keep_default_na=False)
    tensors = safetensors.numpy.load_file(folder / "policy" / "policy.safetensors")
    policy = json.loads((folder / "policy" / "policy.json").read_text())
    del policy["format"]
    return {
        "metrics.json": json.loads((folder / "metrics.json").read_text()),
        "pairs.csv": {
            str(name): _summary(
                "\n".join(column).encode(), pd.to_numeric(column, errors="coerce").to_numpy(float)
            )
            for name, column in pairs.items()
        },
        "policy.safetensors": {
            name: _summary(f"{value.dtype}{value.shape}".encode() + value.tobytes(), value)
            for name, value in tensors.items()
        },
        "policy.json": dict(_leaves(policy)),
    }


def differences(before: Mapping[str, Record], after: Mapping[str, Record]) -> Iterator[str]:
    """Says, in a line each, what is not equal to the last bit."""
    for job, file, name, old, new in _all(before, after):
        if old != new:
            yield f"{job} {file} {name}: {_change(old, new)}"


def beyond_tolerance(before: Mapping[str, Record], after: Mapping[str, Record]) -> Iterator[str]:
    """Says, in a line each, which metrics differ by more than rounding does."""
    for job, file, name, old, new in _all(before, after):
        if file != "metrics.json" or name.endswith(_OF_RANKS):
            continue
        if old != new and not _is_close(old, new):
            yield f"{job} {file} {name}: {_change(old, new)}"


def write(records: Mapping[str, Record]) -> None:
    """Writes the records of all jobs; each file of a job is one line."""
    lines = [f'{{\n"machine": {json.dumps(machine())},\n"jobs": {{']
    jobs = []
    for job, files in sorted(records.items()):
        parts = [
            f'  "{file}": {json.dumps(values, sort_keys=True)}' for file, values in files.items()
        ]
        jobs.append(f'"{job}": {{\n' + ",\n".join(parts) + "\n}")
    FILE.write_text("\n".join([*lines, ",\n".join(jobs), "}}"]) + "\n")


def _summary(content: bytes, values: np.ndarray[Any, Any]) -> dict[str, Any]:
    finite = values[np.isfinite(values)]
    mean = float(finite.astype(float).mean()) if finite.size else None
    return {"sha256": hashlib.sha256(content).hexdigest()[:16], "mean": mean}


def _leaves(values: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(values, dict) and values:
        for key, value in values.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, values


def _all(
    before: Mapping[str, Record], after: Mapping[str, Record]
) -> Iterator[tuple[str, str, str, Any, Any]]:
    """Yields job, file, name and both values; "missing" stands for a value that is not there."""
    for job in sorted({*before, *after}):
        old_files, new_files = before.get(job, {}), after.get(job, {})
        for file in sorted({*old_files, *new_files}):
            old, new = old_files.get(file, {}), new_files.get(file, {})
            for name in sorted({*old, *new}):
                yield job, file, name, old.get(name, "missing"), new.get(name, "missing")


def _is_close(old: Any, new: Any) -> bool:
    numbers = isinstance(old, float) and isinstance(new, float)
    return numbers and math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=1e-6)


def _change(old: Any, new: Any) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        if old["mean"] == new["mean"]:
            return f"other values of the same mean, {old['mean']}"
        return "the mean " + _change(old["mean"], new["mean"])
    if isinstance(old, float) and isinstance(new, float):
        relative = (new - old) / max(abs(old), abs(new))
        return f"{old!r} became {new!r} ({relative:+.1e} of it)"
    return f"{_shown(old)} became {_shown(new)}"


def _shown(value: Any) -> str:
    return "a column or tensor" if isinstance(value, dict) else repr(value)
