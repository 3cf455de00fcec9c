"""Files that hold the state of live drivers, beside the state that SUMO saves of its simulation.

SUMO's `saveState` keeps no word of TraCI's: neither speeds that were set nor speed modes. The
drivers keep both with what they know of each vehicle. A file holds numbers and text, and no code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from cfx.errors import DataError, OutputError
from cfx.plugin import files

_KEY = "cfx_live_drivers"
"""Of the description in the file's metadata."""

_FORMAT = 1


class DriverRecord(NamedTuple):
    """All that one driver knows of its vehicles.

    Attributes:
        described: what is text or a number.
        rows: columns of `VehicleTable`, a row for each vehicle.
    """

    described: Mapping[str, Any]
    rows: Mapping[str, Tensor]


def write_state(
    path: Path, drivers: Sequence[DriverRecord], types: Mapping[str, str] | None = None
) -> None:
    """Writes the state of drivers; the file appears whole.

    Args:
        path: of the file.
        drivers: in an order that `read_state` keeps.
        types: of a fleet, vehicle -> vType.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {}
    for number, driver in enumerate(drivers):
        for name, column in driver.rows.items():
            tensors[f"{number}.{name}"] = column.contiguous()
    described = {
        "format": _FORMAT,
        "drivers": [dict(driver.described) for driver in drivers],
        "types": dict(types or {}),
    }
    content = safetensors.torch.save(tensors, {_KEY: json.dumps(described)})
    try:
        with files.atomic_write(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({error.strerror or error}); name another file"
        ) from error


def read_state(path: Path) -> tuple[list[DriverRecord], dict[str, str]]:
    """Reads what `write_state` wrote.

    Raises:
        DataError: the file is not there, or holds something else.
    """
    if not path.is_file():
        raise DataError(f"{path} is not there; name a file that save_state wrote")
    try:
        with safe_open(path, "pt") as file:
            described = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
        if described["format"] != _FORMAT:
            raise KeyError("format")
        records = []
        for number, driver in enumerate(described["drivers"]):
            prefix = f"{number}."
            rows = {}
            for name, column in tensors.items():
                if name.startswith(prefix):
                    rows[name.removeprefix(prefix)] = column
            records.append(DriverRecord(driver, rows))
        return records, dict(described["types"])
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} holds no state of live drivers of this version of cfx; name a file that"
            " save_state wrote"
        ) from error
