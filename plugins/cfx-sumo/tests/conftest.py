"""Fixtures that cfx's own tests have too: real recordings, a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.register_assert_rewrite("tests.browser")

from tests.browser import browser  # noqa: E402 - pytest rewrites its assertions first
from tests.forks import Forks  # noqa: E402

__all__ = ["browser"]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; skips where it is absent."""
    folder = Path(__file__).resolve().parents[4] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here ({folder}); see CONTRIBUTING.md")
    return folder


@pytest.fixture(scope="session")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    """Starts processes in which libsumo can drive: they have no pyarrow."""
    imports = 'import sys; sys.modules["pyarrow"] = None; import cfx_sumo.drive.run'
    with Forks(imports, tmp_path_factory.mktemp("live")) as forks:
        yield forks
