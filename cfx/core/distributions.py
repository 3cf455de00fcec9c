"""Which distribution brings an option, and the command that installs it.

`distributions.json` names the options of the distributions in this repository. `make conf` writes
it from their `pyproject.toml` files, so a plugin that gains a component changes no file of cfx.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from cfx.errors import nearest

__all__ = [
    "OWN",
    "install_line",
]
"""What plugins may use, as `cfx.plugin.distributions`."""


OWN = "cfx-driving"
"""cfx's own distribution: no other can replace its components."""

ALL_OWN = "own"
"""Stands for all metrics, or tables, of cfx itself where a job names some."""

FILE = Path(__file__).with_name("distributions.json")


@cache
def brought() -> Mapping[tuple[str, str], str]:
    """Returns what brings each option that is not cfx's own, by its group and name.

    It is a distribution, or an extra of one: `cfx-sumo`, `cfx-driving[joblib]`.
    """
    options = {}
    for distribution, groups in json.loads(FILE.read_text(encoding="utf-8")).items():
        for group, names in groups.items():
            for name in names:
                options[group, name] = distribution
    return options


def options_of_checkout(root: Path, groups: Mapping[str, str]) -> dict[str, dict[str, list[str]]]:
    """Returns what each distribution of a checkout brings: names of options by group.

    Components and sub-commands stand in the entry points, other options in the files of `conf/`.
    A launcher of Hydra is a module of the namespace `hydra_plugins`. Options that need an extra
    stand in the table `tool.cfx.extras` of `pyproject.toml`.

    Args:
        root: folder of the checkout.
        groups: the config group of each entry-point group whose names a user writes.
    """
    table: dict[str, dict[str, list[str]]] = {}
    for file in (root / "pyproject.toml", *sorted(root.glob("plugins/*/pyproject.toml"))):
        content = tomllib.loads(file.read_text(encoding="utf-8"))
        distribution = content["project"]["name"]
        options: dict[str, list[str]] = {}
        if distribution != OWN:
            options = _options_of_plugin(file.parent, content["project"], groups)
        extras = content.get("tool", {}).get("cfx", {}).get("extras", {})
        for extra, more in extras.items():
            table[f"{distribution}[{extra}]"] = more
            for group, names in more.items():
                options[group] = sorted(set(options.get(group, ())) - set(names))
        table[distribution] = options
    brings = {}
    for owner in sorted(table):
        groups_of_it = {}
        for group, names in sorted(table[owner].items()):
            if names:
                groups_of_it[group] = sorted(names)
        if groups_of_it:
            brings[owner] = groups_of_it
    return brings


def _options_of_plugin(
    folder: Path, project: Mapping[str, Any], groups: Mapping[str, str]
) -> dict[str, list[str]]:
    options: dict[str, list[str]] = {}
    for entry_points, names in project.get("entry-points", {}).items():
        if entry_points in groups:
            options.setdefault(groups[entry_points], []).extend(names)
    for preset in folder.glob("cfx_*/conf/*/*.yaml"):
        options.setdefault(preset.parent.name, []).append(preset.stem)
    for launcher in folder.glob("hydra_plugins/cfx_*_launcher.py"):
        name = launcher.stem.removeprefix("cfx_").removesuffix("_launcher")
        options.setdefault("hydra/launcher", []).append(name)
    return options


def advice(group: str, name: str, available: Sequence[str]) -> str:
    """Returns advice on a missing option: install it, or choose another.

    Args:
        group: such as `model`.
        name: what was asked for.
        available: the options that are installed.
    """
    options = brought()
    if (group, name) in options:
        distribution = options[group, name]
        return f" It comes with {distribution}: {install_line(distribution)}"
    candidates = list(available)
    for option_group, option in options:
        if option_group == group:
            candidates.append(option)
    text = nearest(name, candidates)
    if available:
        text += f" Known: {', '.join(available)}."
    return text


def install_line(distribution: str) -> str:
    """Returns the command that installs a distribution, or an extra of cfx's, for this Python.

    In a checkout it is the folder's: `pip install --editable plugins/cfx-community`.
    """
    name, bracket, extra = distribution.partition("[")
    checkout = Path(__file__).resolve().parents[2]
    if name != OWN:
        checkout = checkout / "plugins" / name
    source = shlex.quote(distribution)
    if bracket:
        source = f'"{distribution}"'
    if (checkout / "pyproject.toml").is_file():
        source = f"--editable {shlex.quote(_from_here(checkout) + bracket + extra)}"
    return f"{_pip()} install {source}"


def _pip() -> str:
    """Returns `pip`, or how to call this Python's where the shell has another."""
    program = shutil.which("pip")
    if program is not None and Path(program).parent == Path(sys.executable).parent:
        return "pip"
    return f"{shlex.quote(_from_here(Path(sys.executable)))} -m pip"


def _from_here(path: Path) -> str:
    """Returns a path from the working directory on, if it lies there, else the whole one."""
    inside = path.is_relative_to(Path.cwd())
    return os.path.relpath(path) if inside else str(path)
