"""Errors of the user: one sentence with what is wrong, where, and what to write instead."""

from __future__ import annotations

import difflib
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

OWN = "cfx-driving"
"""cfx's own distribution: no other can replace its components."""


class CfxError(Exception):
    """A user's mistake.

    The command line prints its text alone, on stderr, and exits with `exit_code`.
    """

    exit_code = 2

    def __str__(self) -> str:
        """Returns the text without passwords, and without what a terminal would obey."""
        return printable(without_passwords(super().__str__()))


def printable(text: str) -> str:
    r"""Returns a text in which control characters other than new lines are written as `\x1b`.

    Names in recordings may hold sequences that change a terminal's title or clear it.
    """
    found = []
    for character in text:
        if character.isprintable() or character in "\n\t":
            found.append(character)
        else:
            found.append(character.encode("unicode_escape").decode())
    return "".join(found)


def without_passwords(text: str) -> str:
    """Returns a text in which the passwords of URIs are written as `***`."""
    return re.sub(r"(://[^/\s:@]*):[^/\s@]+@", r"\1:***@", text)


class Terminated(BaseException):
    """SIGTERM arrived."""


class ConfigError(CfxError):
    """A value or a key of the configuration is wrong."""


class DataError(CfxError):
    """A data file is missing, cannot be read, or holds what no recording can hold."""


class PluginError(CfxError):
    """A component cannot be found, cannot be imported, or breaks its contract."""


class ParameterError(CfxError):
    """A model parameter lies outside its bounds or its specification is contradictory."""


class TrackingError(CfxError):
    """The MLflow store cannot be reached or is not one of ours."""


class OutputError(CfxError):
    """A result cannot be written."""


class NotInstalledError(CfxError):
    """A package that nothing else needs is not installed; says what installs it."""


class JobFailedError(CfxError):
    """A job of a multirun failed; its folder says why."""


class EngineError(CfxError):
    """The workers of an engine cannot be reached, or were lost for good."""


class SumoError(CfxError):
    """SUMO is missing, or does not do what is asked of it."""


def nearest(name: str, choices: Iterable[str]) -> str:
    """Returns " Did you mean 'x'?" for the nearest of `choices`, or "" if none is near."""
    close = difflib.get_close_matches(name, list(choices), n=1, cutoff=0.5)
    if not close:
        return ""
    return f" Did you mean '{close[0]}'?"


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's text; its type's name where it has none."""
    lines = (line.strip() for line in str(error).splitlines())
    return next((line for line in lines if line), type(error).__name__)


def in_words(error: BaseException) -> str:
    """Returns an error's type and the first line of its text."""
    first = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {first}".rstrip(": ")


def listed(values: Iterable[object], limit: int = 12) -> str:
    """Returns the values separated by commas, cut off after `limit` of them."""
    texts = [str(value) for value in values]
    text = ", ".join(texts[:limit])
    if len(texts) > limit:
        text += f", ... ({len(texts)} in all)"
    return text


_BROUGHT: dict[str, dict[str, tuple[str, ...]]] = {
    "cfx-benchmark": {"command": ("benchmark", "policies.make")},
    "cfx-botorch": {"optimizer": ("botorch",)},
    "cfx-classics": {"model": ("fvdm", "gipps", "gipps_delay", "newell", "ovm", "ovm_city", "w74")},
    "cfx-cma": {"optimizer": ("cma",)},
    "cfx-contracts": {"command": ("plugins.check", "plugins.new")},
    "cfx-dask": {"engine": ("dask",), "hydra/launcher": ("dask",)},
    f"{OWN}[joblib]": {"hydra/launcher": ("joblib",)},
    f"{OWN}[submitit]": {"hydra/launcher": ("submitit_local", "submitit_slurm")},
    "cfx-estimators": {"policy": ("particle_filter", "recalibrate", "ukf")},
    "cfx-fmi": {"export": ("fmi",)},
    "cfx-forecasts": {
        "experiment": ("forecast", "stochastic"),
        "protocol": ("forecast",),
        "table": ("distributions", "forecasts"),
    },
    "cfx-idm": {"model": ("idm_city", "iidm")},
    "cfx-mlflow": {"command": ("ui",), "tracking.name": ("mlflow",)},
    "cfx-onnx": {"export": ("onnx",)},
    "cfx-posteriors": {
        "calibration.posterior": ("hierarchical", "laplace", "nuts"),
        "export": ("netcdf",),
        "table": ("fan", "population", "posterior", "prior"),
    },
    "cfx-posteriors[sbi]": {"calibration.posterior": ("sbi",)},
    "cfx-recordings": {
        "command": ("data.fetch",),
        "data": (
            "followernet",
            "follownet",
            "highd",
            "lyft_pairs",
            "ngsim",
            "openacc",
            "waymo_pairs",
        ),
    },
    "cfx-report": {"command": ("figures", "report")},
    "cfx-scipy": {"optimizer": ("differential_evolution",)},
    "cfx-sumo": {
        "command": ("drive",),
        "data": ("sumo_fcd",),
        "demo": ("sumo",),
        "experiment": ("sumo_demo",),
        "export": ("sumo",),
        "model": ("eidm", "idm_sumo", "krauss_sumo", "sumo_vtype"),
        "simulator": ("sumo",),
    },
    "cfx-tcn": {"policy": ("tcn",)},
    "cfx-traffic": {
        "experiment": ("traffic",),
        "protocol": ("traffic",),
        "table": ("traffic", "traffic_growth", "traffic_paths", "traffic_strips"),
    },
}
"""Options that come with another distribution or an extra, by group."""

EXTRAS = {
    (group, name): wanted
    for wanted, groups in _BROUGHT.items()
    for group, options in groups.items()
    for name in options
}
"""What brings an option, by its group and name."""


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
    checkout = Path(__file__).resolve().parents[2]
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
