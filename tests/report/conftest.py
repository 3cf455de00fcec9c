"""What tests of reports share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from cfx_report import inline


@contextmanager
def blank_drawings() -> Iterator[None]:
    """Makes pages quick that are looked at for something else than their figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inline, "inline_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')
        yield


@pytest.fixture
def blank_figures() -> Iterator[None]:
    """Makes the pages of a test quick."""
    with blank_drawings():
        yield
