"""Where things lie in the checkout that is tested, and its scripts."""

import importlib.metadata
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTIONS = sorted(path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml"))


def require_distributions() -> None:
    """Skips a module that looks at everything in `plugins/`, where some of it is not installed."""
    missing = []
    for name in DISTRIBUTIONS:
        try:
            importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}", allow_module_level=True)


def module_of(script: Path) -> ModuleType:
    """Returns a script that is in no package, imported."""
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
