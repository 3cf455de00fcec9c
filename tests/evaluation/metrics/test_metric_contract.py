"""Every registered metric keeps the contract."""

from __future__ import annotations

from typing import cast

import pytest

from cfx.contracts import MetricContract
from cfx.core import registry
from cfx.evaluation.metrics.base import Metric


class TestMetrics(MetricContract):
    @pytest.fixture(params=registry.names("metric"))
    def metric(self, request: pytest.FixtureRequest) -> Metric:
        return cast(Metric, registry.create("metric", {"name": request.param}))
