"""The contract of an objective, and what this one adds to it."""

import cfx
import pytest
import torch
from cfx_contracts import check_contract

from cfx_example.objective import GapMae


def test_contract():
    check_contract(GapMae())


def test_cfx_finds_it():
    found = cfx.get("objective", "gap_mae")
    assert found is GapMae, "install it first: pip install --editable ."


def test_a_constant_error_of_a_metre_is_a_loss_of_about_a_metre():
    gap = torch.full((5,), 20.0)
    frames = cfx.plugin.FrameValues(gap, gap + 1.0, gap, gap, 0.1)
    assert GapMae()(frames, torch.ones(5)).item() == pytest.approx(1.0, abs=0.1)
