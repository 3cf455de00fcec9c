"""What learning curves say of networks that learned nothing."""

from __future__ import annotations

import pandas as pd
import pytest

from cfx.learners.base import CURVE_COLUMNS
from cfx.learners.curves import first_sampled_epoch, networks_without_loss


def test_networks_without_any_finite_loss_are_named() -> None:
    nan, inf = float("nan"), float("inf")
    losses = {"a": (nan, 0.5), "b": (nan, nan), "c": (inf, nan), "d": (0.3, 0.2)}
    rows = []
    for network, values in losses.items():
        for epoch, loss in enumerate(values):
            rows.append((network, epoch, loss, 0.7))
    curves = pd.DataFrame(rows, columns=["network", "epoch", "train_loss", "validation_loss"])
    assert networks_without_loss(curves) == ["b", "c"]


def test_without_curves_there_is_nothing_to_say() -> None:
    assert networks_without_loss(pd.DataFrame(columns=CURVE_COLUMNS)) == []


@pytest.mark.parametrize(
    ("sampled", "first"), [([0, 0, 2, 2], 2.0), ([2, 2, 2, 2], None), ([0, 0, 0, 0], None)]
)
def test_a_loss_that_changes_its_meaning_says_where(
    sampled: list[int], first: float | None
) -> None:
    curves = pd.DataFrame({"network": "a", "epoch": range(4), "train_loss": 1.0})
    assert first_sampled_epoch(curves) is None
    assert first_sampled_epoch(curves.assign(sampled_paths=sampled)) == first
