"""What tests of reports share."""

from __future__ import annotations

import pytest

from cfx.report.figures import write


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make pages quick that are looked at for something else than their figures."""
    monkeypatch.setattr(write, "inline_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')
