"""Fixtures that cfx's own tests have too: real recordings, a browser."""

from tests.browser import browser
from tests.conftest import shared_data

__all__ = ["browser", "shared_data"]
