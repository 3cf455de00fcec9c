"""Where things lie in the checkout that is tested, and its scripts."""

import importlib.metadata
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTIONS = sorted(path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml"))


def is_installed(distribution: str) -> bool:
    """Says whether a distribution is installed."""
    try:
        importlib.metadata.distribution(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def needs(*distributions: str) -> pytest.MarkDecorator:
    """Marks a test that is skipped where one of some distributions is not installed."""
    missing = [name for name in distributions if not is_installed(name)]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


def require_distributions() -> None:
    """Skips a module that looks at everything in `plugins/`, where some of it is not installed."""
    missing = [name for name in DISTRIBUTIONS if not is_installed(name)]
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
