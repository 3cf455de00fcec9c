"""The contract of a metric, as tests: subclass `MetricContract`, fill in its fixture `metric`."""

from __future__ import annotations

import pytest

from cfx.metrics.base import Metric
from cfx.testing.checks.metrics import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class MetricContract:
    """What every metric must hold: each statement of `cfx.testing.checks.metrics` is a test."""

    @pytest.fixture
    def metric(self) -> Metric:
        """Returns the metric under test."""
        raise NotImplementedError("the subclass of MetricContract must define the fixture `metric`")

    @statements(CONTRACT)
    def test_contract(self, check: Check, metric: Metric) -> None:
        hold(check, metric)
