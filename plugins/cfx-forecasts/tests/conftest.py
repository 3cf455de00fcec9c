"""What tests of forecasts share."""

from __future__ import annotations

import pytest


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the pages of a test quick, which are looked at for something else than figures."""
    from cfx_report import inline

    monkeypatch.setattr(inline, "inline_svg", lambda _: '<svg viewBox="0 0 1 1"></svg>')
