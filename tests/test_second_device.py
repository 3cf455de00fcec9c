"""What runs on a GPU, without one: the same numbers on a second device, and nothing across.

On a second device nothing is compiled by cfx's own kernel, as on a GPU.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import cfx
from cfx.app.job import steps
from cfx.learners.base import TrainingData
from tests.elsewhere import DEVICE, second_device
from tests.learners.made import module_of, training_data

_SMALL = [
    "data=synthetic",
    "data.pairs=4",
    "data.platoon_size=1",
    "data.frames=80",
    "policy=fixed",
    "optimizer.samples=16",
    "calibration.prior=weak",
    "figures=none",
    "tracking.enabled=false",
    "cache.enabled=false",
]


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(["optimizer=random", "protocol.folds=2"], marks=pytest.mark.slow),
        ["optimizer=gradient", "protocol=within_driver", "model=krauss", "dtype=float32"],
    ],
    ids=["pooled, float64", "driver-specific, float32"],
)
def test_calibration_and_evaluation(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    expected = cfx.run([*_SMALL, *overrides]).metrics
    monkeypatch.setattr(steps, "choose_device", lambda _name: DEVICE)
    with second_device():
        found = cfx.run([*_SMALL, *overrides]).metrics
    assert found == pytest.approx(expected, rel=1e-6, nan_ok=True)


def test_a_gradient_step() -> None:
    here = _gradient(training_data(networks=2), torch.device("cpu"))
    with second_device():
        there = _gradient(_moved(training_data(networks=2)), DEVICE)
    assert torch.equal(here[0], there[0])
    torch.testing.assert_close(here[1], there[1])


def test_tensors_on_two_devices_do_not_meet() -> None:
    with second_device():
        there = torch.ones(3).to(DEVICE)
        assert float(there.sum()) == 3.0
        with pytest.raises(RuntimeError, match="two devices"):
            there + torch.ones(3)


def _gradient(data: TrainingData, device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns the losses of one step and the slopes of a weight, on the CPU."""
    module = module_of(data)
    losses = torch.cat([loss[None] for loss in module.step_losses(0)])
    losses.sum().backward()
    slope = module.network.get_parameter("w_out").grad
    assert slope is not None
    assert slope.device.type == device.type
    return losses.detach().cpu(), slope.cpu()


def _moved(data: TrainingData) -> TrainingData:
    """Returns the training data on the second device."""
    recorded = {}
    for field in fields(data.recorded):
        value = getattr(data.recorded, field.name)
        if isinstance(value, Tensor):
            recorded[field.name] = value.to(DEVICE)
    pairs = replace(
        data.pairs,
        index=data.pairs.index.to(DEVICE),
        start=data.pairs.start.to(DEVICE),
        network=data.pairs.network.to(DEVICE),
    )
    return replace(data, recorded=replace(data.recorded, **recorded), pairs=pairs)
