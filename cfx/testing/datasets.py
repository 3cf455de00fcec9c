"""The contract of a dataset, as tests.

Subclass `DatasetContract` and fill in the fixture `dataset`; pytest does the rest.
"""

from __future__ import annotations

import pytest

from cfx.datasets.base import Dataset
from cfx.testing.checks.datasets import CONTRACT
from cfx.testing.contract import Check
from cfx.testing.suite import hold, statements


class DatasetContract:
    """What every dataset must hold: each statement of `cfx.testing.checks.datasets` is a test."""

    @pytest.fixture
    def dataset(self) -> Dataset:
        """Returns the dataset under test, with settings that find at least two pairs."""
        raise NotImplementedError(
            "the subclass of DatasetContract must define the fixture `dataset`"
        )

    @statements(CONTRACT)
    def test_contract(self, check: Check, dataset: Dataset) -> None:
        hold(check, dataset)
