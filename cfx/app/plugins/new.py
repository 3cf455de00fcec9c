"""`cfx plugins new`: a package for somebody's own component, complete and with tests that pass.

The templates are files in `template/`: `common/` for every kind, and a folder for each. Copier
renders them from there: no network, no git, no hooks.
"""

from __future__ import annotations

import importlib.util
import keyword
import re
import shlex
import tempfile
from pathlib import Path
from typing import Any

from cfx.core import registry
from cfx.core.component import API_VERSION
from cfx.core.errors import ConfigError, OutputError, PluginError

_TEMPLATE = Path(__file__).parent / "template"

_RESERVED = {"null", "true", "false", "nan", "inf"}
"""What Hydra does not read as a name."""


def create(kind: str, name: str, folder: Path | None = None) -> Path:
    """Writes a package and says what to do with it.

    Args:
        kind: what the component is.
        name: its name, as in `model=NAME`.
        folder: where; `cfx-NAME` in the working directory unless given.

    Returns:
        The folder, which appears whole or not at all.

    Raises:
        PluginError: there is no such kind, or the name is taken.
        ConfigError: the name cannot be one.
        OutputError: the folder exists or cannot be written.
    """
    found = registry.kind_of(kind)
    _check_name(name)
    _check_free(found, name)
    words = _words(found, name)
    target = (folder or Path(words["distribution"])).expanduser()
    if target.exists():
        raise OutputError(
            f"{target} exists already; choose another folder with --folder, or remove it"
        )
    try:
        _write(found, words, target)
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written ({error.strerror or error});"
            " choose another folder with --folder"
        ) from error
    print(_next_steps(found, name, target))
    return target


def _check_name(name: str) -> None:
    is_taken = keyword.iskeyword(name) or name in _RESERVED
    if re.fullmatch(r"[a-z][a-z0-9_]*", name) and not is_taken:
        return
    advice = ""
    better = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_0123456789")
    if better and better != name and not keyword.iskeyword(better):
        advice = f", such as {better}"
    raise ConfigError(
        f"'{name}' cannot be a component's name: it must be an identifier in lower-case letters,"
        f" digits and _{advice}"
    )


def _check_free(kind: registry.Kind, name: str) -> None:
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
    class_name = "".join(part.capitalize() for part in name.split("_"))
    return {
        "kind": kind.name,
        "group": kind.group,
        "entry_points": kind.entry_points,
        "name": name,
        "class_name": class_name,
        "package": f"cfx_{name}",
        "distribution": f"cfx-{name.replace('_', '-')}".rstrip("-"),
        "api": API_VERSION,
        "requires": _requires(),
    }


def _requires() -> str:
    """Returns a range of cfx's versions from this one on.

    Which of them fit is also the plugin API's to say.
    """
    from packaging.version import InvalidVersion, Version

    import cfx

    try:
        major, minor = Version(cfx.__version__).release[:2]
    except (InvalidVersion, ValueError):  # a checkout that nobody installed
        return registry.OWN
    return f"{registry.OWN}>={major}.{minor},<{major + 1}"


def _write(kind: registry.Kind, words: dict[str, Any], target: Path) -> None:
    from copier import run_copy

    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".cfx-new-") as temporary:
        draft = Path(temporary) / "package"
        for part in ("common", kind.name):
            run_copy(
                str(_TEMPLATE / part), draft, data=words, defaults=True, overwrite=True, quiet=True
            )
        draft.rename(target)


def _next_steps(kind: registry.Kind, name: str, target: Path) -> str:
    job = kind.call(name).removeprefix("cfx ")
    if kind.name == "dataset":
        job += " data.path=FILE.csv"
    if kind.name == "metric":
        job = "  # every job measures it"
    folder = shlex.quote(str(target))
    package = shlex.quote(f"{target}[test]")
    return (
        f"Wrote {target}, a package with the {kind.name} '{name}'. Next:\n"
        f"  pip install --editable {package}\n"
        f"  python -m pytest {folder}\n"
        f"  python -m cfx plugins check {kind.name} {name}\n"
        f"  python -m cfx {job}"
    )
