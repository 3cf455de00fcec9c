"""Reports errors inside plugins' code in one sentence that names the distribution."""

from __future__ import annotations

import importlib.util
import traceback
from pathlib import Path

import cfx
from cfx.core import registry
from cfx.core.errors import PluginError

_OWN = Path(cfx.__file__).resolve().parent


def blame(
    error: BaseException, more: str = "the whole traceback is in the log"
) -> PluginError | None:
    """Returns a sentence if an error comes from a plugin's code; None if it is cfx's own.

    The innermost frame that is cfx's or a plugin's decides: what a library answers to a plugin's
    call is the plugin's.

    Args:
        more: where the traceback is.
    """
    packages = _packages()
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename).resolve()
        if file.is_relative_to(_OWN):
            return None
        for package, found in packages.items():
            if file.is_relative_to(package):
                where = f"{file.relative_to(package.parent)}, line {frame.lineno}"
                return PluginError(
                    f"{found} failed in {where}: {_in_words(error)}; {more};"
                    f" repair that distribution, or pip uninstall {found.distribution}"
                )
    return None


def _in_words(error: BaseException) -> str:
    if isinstance(error, SystemExit):
        return f"it called sys.exit({error.code!r})"
    if isinstance(error, MemoryError):
        return "memory ran out"
    return registry.in_words(error)


def _packages() -> dict[Path, registry.Entry]:
    """Returns the places of plugins' code: a package's folder, or a single module's file."""
    found: dict[Path, registry.Entry] = {}
    for kind in (*registry.KINDS, *registry.PARTS):
        for entry in registry.entries(kind):
            if entry.distribution in {registry.OWN, registry.THIS_PROCESS}:
                continue
            place = _package_path(entry.target.partition(":")[0].partition(".")[0])
            if place is not None:
                found.setdefault(place, entry)
    return found


def _package_path(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations))).resolve()
    if spec.origin is None:
        return None
    return Path(spec.origin).resolve()
