"""Every built-in protocol holds the contract."""

from __future__ import annotations

import pytest

from cfx.contracts import ProtocolContract
from cfx.evaluation.protocols.across_drivers import AcrossDrivers
from cfx.evaluation.protocols.base import Protocol
from cfx.evaluation.protocols.forecast import Forecast
from cfx.evaluation.protocols.within_driver import WithinDriver

# Kept for all tests, which then share a run.
WITHIN = {networks: WithinDriver(networks=networks) for networks in ("pair", "all")}
ACROSS = AcrossDrivers(folds=3)
FORECAST = Forecast(folds=3, horizons=(0.5, 1.0), histories=())


class TestWithinDriver(ProtocolContract):
    @pytest.fixture(params=WITHIN)
    def protocol(self, request: pytest.FixtureRequest) -> Protocol:
        return WITHIN[request.param]


class TestAcrossDrivers(ProtocolContract):
    @pytest.fixture
    def protocol(self) -> Protocol:
        return ACROSS


@pytest.mark.slow  # calibration and training are those of across_drivers, which stands above
class TestForecast(ProtocolContract):
    @pytest.fixture
    def protocol(self) -> Protocol:
        return FORECAST
