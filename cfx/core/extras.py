"""Commands that install what is missing: cfx's extras, and the plugins beside it."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import cfx
from cfx.core.errors import nearest

OWN = "cfx-driving"

EXTRAS: dict[tuple[str, str], str] = {
    ("data", "followernet"): "cfx-recordings",
    ("data", "follownet"): "cfx-recordings",
    ("data", "highd"): "cfx-recordings",
    ("data", "lyft_pairs"): "cfx-recordings",
    ("data", "ngsim"): "cfx-recordings",
    ("data", "openacc"): "cfx-recordings",
    ("data", "sumo_fcd"): "cfx-sumo",
    ("data", "waymo_pairs"): "cfx-recordings",
    ("command", "benchmark"): "cfx-benchmark",
    ("command", "data.fetch"): "cfx-recordings",
    ("command", "drive"): "cfx-sumo",
    ("command", "figures"): "cfx-report",
    ("command", "policies.make"): "cfx-benchmark",
    ("command", "report"): "cfx-report",
    ("command", "ui"): "cfx-mlflow",
    ("demo", "sumo"): "cfx-sumo",
    ("engine", "dask"): "cfx-dask",
    ("export", "fmi"): "cfx-fmi",
    ("export", "netcdf"): "cfx-posteriors",
    ("export", "onnx"): "cfx-onnx",
    ("export", "sumo"): "cfx-sumo",
    ("experiment", "forecast"): "cfx-forecasts",
    ("experiment", "stochastic"): "cfx-forecasts",
    ("experiment", "sumo_demo"): "cfx-sumo",
    ("experiment", "traffic"): "cfx-traffic",
    ("hydra/launcher", "dask"): "cfx-dask",
    ("hydra/launcher", "joblib"): f"{OWN}[joblib]",
    ("hydra/launcher", "submitit_local"): f"{OWN}[submitit]",
    ("hydra/launcher", "submitit_slurm"): f"{OWN}[submitit]",
    ("model", "eidm"): "cfx-sumo",
    ("model", "fvdm"): "cfx-classics",
    ("model", "gipps"): "cfx-classics",
    ("model", "gipps_delay"): "cfx-classics",
    ("model", "idm_city"): "cfx-idm",
    ("model", "iidm"): "cfx-idm",
    ("model", "newell"): "cfx-classics",
    ("model", "ovm"): "cfx-classics",
    ("model", "ovm_city"): "cfx-classics",
    ("model", "sumo_vtype"): "cfx-sumo",
    ("optimizer", "botorch"): "cfx-botorch",
    ("optimizer", "cma"): "cfx-cma",
    ("optimizer", "differential_evolution"): "cfx-scipy",
    ("policy", "particle_filter"): "cfx-estimators",
    ("policy", "recalibrate"): "cfx-estimators",
    ("policy", "tcn"): "cfx-tcn",
    ("policy", "ukf"): "cfx-estimators",
    ("calibration.posterior", "hierarchical"): "cfx-posteriors",
    ("calibration.posterior", "laplace"): "cfx-posteriors",
    ("calibration.posterior", "nuts"): "cfx-posteriors",
    ("calibration.posterior", "sbi"): "cfx-posteriors[sbi]",
    ("protocol", "forecast"): "cfx-forecasts",
    ("protocol", "traffic"): "cfx-traffic",
    ("simulator", "sumo"): "cfx-sumo",
    ("tracking.name", "mlflow"): "cfx-mlflow",
    ("table", "distributions"): "cfx-forecasts",
    ("table", "fan"): "cfx-posteriors",
    ("table", "forecasts"): "cfx-forecasts",
    ("table", "population"): "cfx-posteriors",
    ("table", "posterior"): "cfx-posteriors",
    ("table", "prior"): "cfx-posteriors",
    ("table", "traffic"): "cfx-traffic",
    ("table", "traffic_growth"): "cfx-traffic",
    ("table", "traffic_paths"): "cfx-traffic",
    ("table", "traffic_strips"): "cfx-traffic",
}
"""Options that come with another distribution or an extra, by group and name."""


def advice(group: str, name: str, known: Sequence[str]) -> str:
    """Returns advice on a missing option: install it, or choose another.

    Args:
        group: such as `model`.
        name: what was asked for.
        known: the options that are installed.
    """
    if (group, name) in EXTRAS:
        wanted = EXTRAS[group, name]
        return f" It comes with {wanted}: {install_line(wanted)}"
    others = [option for where, option in EXTRAS if where == group]
    text = nearest(name, [*known, *others])
    if known:
        text += f" Known: {', '.join(known)}."
    return text


def install_line(wanted: str) -> str:
    """Returns the command that installs a distribution, or an extra of cfx's, for this Python.

    In a checkout it is the folder's: `pip install --editable plugins/cfx-classics`.
    """
    name, bracket, extra = wanted.partition("[")
    checkout = Path(cfx.__file__).resolve().parent.parent
    if name != OWN:
        checkout = checkout / "plugins" / name
    source = shlex.quote(wanted)
    if bracket:
        source = f'"{wanted}"'
    if (checkout / "pyproject.toml").is_file():
        source = f"--editable {shlex.quote(_from_here(checkout) + bracket + extra)}"
    return f"{_pip()} install {source}"


def _pip() -> str:
    """Returns `pip`, or how to call this Python's where the shell has another."""
    found = shutil.which("pip")
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return "pip"
    return f"{shlex.quote(_from_here(Path(sys.executable)))} -m pip"


def _from_here(path: Path) -> str:
    """Returns a path from the working directory on, if it lies there, else the whole one."""
    inside = path.is_relative_to(Path.cwd())
    return os.path.relpath(path) if inside else str(path)
