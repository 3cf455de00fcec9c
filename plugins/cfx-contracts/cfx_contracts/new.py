"""`cfx plugins new`: a package for somebody's own component, complete and with tests that pass.

The templates are files in `template/`: `common/` for every kind, and a folder for each. Copier
renders them from there: no network, no git, no hooks.
"""

from __future__ import annotations

import argparse
import importlib.util
import keyword
import re
import shlex
import tempfile
from pathlib import Path
from typing import Any

from cfx.app.completion import add_kind
from cfx.core import registry
from cfx.core.command import Command
from cfx.core.component import API_VERSION
from cfx.core.distributions import OWN
from cfx.errors import ConfigError, OutputError, PluginError

_TEMPLATE = Path(__file__).parent / "template"


class NewCommand(Command):
    """Writes packages."""

    summary = "write a package for a component of your own, with tests that pass"

    def parser(self) -> argparse.ArgumentParser:
        made = argparse.ArgumentParser("cfx plugins new", description=self.summary)
        add_kind(made)
        made.add_argument("name", help="as in model=NAME: lower-case letters, digits and _")
        made.add_argument("--folder", type=Path, help="where to write it; default: cfx-NAME, here")
        return made

    def run(self, options: argparse.Namespace) -> int:
        create(options.kind, options.name, options.folder)
        return 0


def create(kind: str, name: str, folder: Path | None = None) -> Path:
    """Writes a package, whole or not at all, and says what to do with it; returns its folder.

    Raises:
        PluginError: there is no such kind or no template of it, or the name is taken.
        ConfigError: the name cannot be one.
        OutputError: the folder exists or cannot be written.
    """
    from copier import run_copy

    component_kind = registry.kind_of(kind)
    _check_template(component_kind)
    _check_name(component_kind, name)
    words = _words(component_kind, name)
    target = (folder or Path(words["distribution"])).expanduser()
    if target.exists():
        raise OutputError(
            f"{target} exists already; choose another folder with --folder, or remove it"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".cfx-new-") as temporary:
            draft = Path(temporary) / "package"
            for part in ("common", component_kind.name):
                template = str(_TEMPLATE / part)
                run_copy(template, draft, data=words, defaults=True, overwrite=True, quiet=True)
            draft.rename(target)
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written ({error.strerror or error});"
            " choose another folder with --folder"
        ) from error
    print(_next_steps(component_kind, name, target))
    return target


def _check_template(kind: registry.Kind) -> None:
    """Refuses a kind of which there is no template, such as one that another plugin adds."""
    kinds = sorted(folder.name for folder in _TEMPLATE.iterdir() if folder.name != "common")
    if kind.name not in kinds:
        raise PluginError(
            f"there is no template of the kind '{kind.name}'; there are templates of:"
            f" {', '.join(kinds)}. Write a class that extends {kind.base.replace(':', '.')} and an"
            f" entry point of the group {kind.entry_points}; plugins/cfx-example has one of each"
            " kind to copy"
        )


def _check_name(kind: registry.Kind, name: str) -> None:
    """Refuses a name that cannot be one, or is taken."""
    is_word = keyword.iskeyword(name) or name in {"null", "true", "false", "nan", "inf"}
    if is_word or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        advice = ""
        better = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_0123456789")
        if better and better != name and not keyword.iskeyword(better):
            advice = f", such as {better}"
        raise ConfigError(
            f"'{name}' cannot be a component's name: it must be an identifier in lower-case"
            f" letters, digits and _{advice}"
        )
    taken = [entry for entry in registry.entries(kind.name) if entry.name == name]
    if taken:
        raise PluginError(
            f"the name '{name}' is taken by {taken[0]}: a second {kind.name} of that name would be"
            " shadowed; choose another name"
        )
    package = f"cfx_{name}"
    if importlib.util.find_spec(package) is not None:
        raise PluginError(
            f"a package {package} is installed already, so '{name}' would take its place;"
            " choose another name"
        )


def _words(kind: registry.Kind, name: str) -> dict[str, Any]:
    """Returns what the templates call by name."""
    from packaging.version import InvalidVersion, Version

    import cfx

    try:
        major, minor = Version(cfx.__version__).release[:2]
        requires = f"{OWN}>={major}.{minor},<{major + 1}"  # the plugin API decides too
    except (InvalidVersion, ValueError):  # a checkout that nobody installed
        requires = OWN
    class_name = "".join(part.capitalize() for part in name.split("_"))
    return {
        "kind": kind.name,
        "group": kind.group,
        "usage": _usage(kind, name),
        "has_presets": any((_TEMPLATE / kind.name).rglob("*.yaml.jinja")),
        "has_contract": kind.name in registry.KINDS,
        "entry_points": kind.entry_points,
        "name": name,
        "class_name": class_name,
        "package": f"cfx_{name}",
        "distribution": f"cfx-{name.replace('_', '-')}".rstrip("-"),
        "api": API_VERSION,
        "requires": requires,
        "contracts": requires.replace(OWN, "cfx-contracts"),
        "report": requires.replace(OWN, "cfx-report"),  # whose benchmark has rivals
    }


def _usage(kind: registry.Kind, name: str) -> str:
    """Returns what a user types to see a component at work."""
    arguments = kind.call(name).removeprefix("cfx ")
    if kind.name in {"metric", "table", "figure"}:
        arguments = f"{kind.group}{'' if kind.name == 'metric' else 's'}=[own,{name}]"
    if kind.name == "input":
        arguments = f"policy.inputs=[situation,{name}]"
    if kind.name == "rival":
        arguments = f"benchmark --suite roads --quick rival={name} --data FOLDER"
    if kind.name == "dataset":
        arguments += " data.path=FILE.csv"
    if kind.name == "command":
        arguments += " --help"
    return f"python -m cfx {arguments}"


def _next_steps(kind: registry.Kind, name: str, target: Path) -> str:
    folder = shlex.quote(str(target))
    package = shlex.quote(f"{target}[test]")
    return (
        f"Wrote {target}, a package with the {kind.name} '{name}'. Next:\n"
        f"  pip install --editable {package}\n"
        f"  python -m pytest {folder}\n"
        f"  python -m cfx plugins check {kind.name} {name}\n"
        f"  {_usage(kind, name)}"
    )
