"""Fixtures that cfx's own tests have too: real recordings, a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.register_assert_rewrite("tests.browser")

from tests.browser import browser  # noqa: E402 - pytest rewrites its assertions first

__all__ = ["browser"]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; skips where it is absent."""
    folder = Path(__file__).resolve().parents[4] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here ({folder}); see CONTRIBUTING.md")
    return folder
