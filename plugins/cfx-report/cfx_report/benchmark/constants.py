"""A model whose parameters are constant, as a driver of the benchmark.

Shapes: P pairs, T frames, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import pandas as pd
import torch
from torch import Tensor

import cfx
from cfx.plugin import (
    DrivingModel,
    Leader,
    PairBatch,
    PairSet,
    Start,
    registry,
    simulate_follower,
)
from cfx_report.benchmark.rival import Driver, on_frames

_OF_CALIBRATION = frozenset(
    {"model", "objective", "optimizer", "calibration", "cores", "threads", "engine"}
)
"""Groups of overrides that calibration takes."""


def calibration_settings(overrides: Sequence[str]) -> dict[str, Any]:
    """Returns the overrides that calibration takes, as keywords of `cfx.calibrate`."""
    settings: dict[str, Any] = {}
    for override in overrides:
        key, _, value = override.partition("=")
        if key.split(".")[0] in _OF_CALIBRATION:
            settings[key] = value
    return settings


def are_constant(overrides: Sequence[str]) -> bool:
    """Says whether overrides enter constant parameters, with settings of calibration alone."""
    others = [override for override in overrides if override != "policy=fixed"]
    return len(others) < len(overrides) and len(calibration_settings(others)) == len(others)


class ConstantDriver(Driver):
    """A model whose parameters are constant.

    Args:
        settings: of calibration, as `cfx.calibrate` takes them.
        parameters: a row of each driver, or one of all, SI units.
    """

    def __init__(self, settings: Mapping[str, Any], parameters: pd.DataFrame) -> None:
        self._settings = settings
        self._names = list(parameters.columns)
        self._parameters = torch.tensor(parameters.to_numpy(dtype="float64"))
        node = cfx.config(**settings).config.model
        self._model = cast(DrivingModel, registry.create("model", node))

    def drive(self, batch: PairBatch, first: Tensor, seed: int | None) -> Tensor:
        columns = torch.arange(int((batch.lengths - first).max()))
        index = (first[:, None] + columns).clamp(max=batch.mask.shape[1] - 1)
        start = []
        for name in ("position", "speed", "acceleration"):
            start.append(getattr(batch, f"follower_{name}").gather(1, first[:, None])[:, 0])
        leader = Leader(
            batch.leader_position.gather(1, index),
            batch.leader_speed.gather(1, index),
            batch.leader_acceleration.gather(1, index),
            batch.leader_length,
        )
        parameters = self._parameters.expand(len(first), -1)
        driven = simulate_follower(self._model, parameters, leader, Start(*start), batch.dt)
        return on_frames(driven.speed, batch, first)

    @property
    def chooses_strength(self) -> bool:
        """Whether the strength of the prior is left to the benchmark."""
        return "calibration.prior" not in self._settings

    def drawn_back(self, past: PairSet, seed: int, strength: float) -> Driver:
        """Calibrates driver-specific parameters on a past, drawn towards those of this driver.

        Args:
            past: the recorded pairs up to the last measured frame.
            seed: of the optimizer.
            strength: weight of the prior around the parameters, which are the same for all.
        """
        settings = dict(self._settings)
        (center,) = self._parameters.tolist()
        for name, value in zip(self._names, center, strict=True):
            settings[f"model.parameters.{name}.default"] = value
        settings["calibration.prior"] = strength
        fit = cfx.calibrate(past, split=1.0, seed=seed, **settings)
        return ConstantDriver(self._settings, fit.parameters)

    def adapted(self, past: PairSet, seed: int) -> Driver:
        """Calibrates driver-specific parameters on their past."""
        fit = cfx.calibrate(past, split=1.0, seed=seed, **self._settings)
        return ConstantDriver(self._settings, fit.parameters)
