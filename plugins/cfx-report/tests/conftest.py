"""What tests of reports share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .rendered import blank_drawings


@pytest.fixture
def blank_figures() -> Iterator[None]:
    """Makes the pages of a test quick."""
    with blank_drawings():
        yield
