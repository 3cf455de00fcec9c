"""An export: what another program reads of a job. This one is each driver's parameters as JSON.

`cfx export JOB --to driver_json` calls `write` once.
"""

from __future__ import annotations

import json
from pathlib import Path

from cfx.errors import DataError
from cfx.plugin import ExportFormat, files, folder_of, job_folder, stored_tables

FILE = "driver_json.json"
PREFIX = "parameter_"


class DriverJson(ExportFormat):
    """Writes `{"PAIR": {"PARAMETER": VALUE}}`, in SI units: what was calibrated to each driver."""

    def write(self, run: str, output: Path | None) -> list[str]:
        folder = folder_of(run)
        job_folder.examine(folder)  # the folder may be another person's
        pairs = stored_tables(folder).get("pairs")
        if pairs is None:
            raise DataError(f"{folder} holds no pairs.csv; give the output folder of a job")
        fixed = pairs[pairs["method"] == "driver_specific"].set_index("pair_id").filter(like=PREFIX)
        fixed = fixed.dropna(axis="columns", how="all").dropna()
        if fixed.empty:
            raise DataError(
                f"{folder}/pairs.csv holds no driver-specific parameters; give a"
                " job that calibrated some"
            )
        drivers = fixed.rename(columns=lambda name: name.removeprefix(PREFIX)).to_dict("index")
        # A job that is no folder here, such as one of a URL, has its file where the user is.
        home = folder if Path(run).expanduser().is_dir() else Path()
        path = output or home / FILE
        files.write_output(path, json.dumps(drivers, indent=1), "the list of parameters")
        return [f"parameters of {len(drivers)} drivers: {path}"]
