"""A gradient step of closed-loop training, beside the same step in plain eager PyTorch.

The case has I-80's size: six networks (five folds and one for everybody), or ensembles of four, of
57 drivers, two trajectories of 15 s for each after a burn-in of 20 s. All ways run in the same
process: a trajectory as compiled code, as cfx does; windows through `torch.compile`; eagerly, all
networks in one batch; and eagerly a network at a time, as a training loop without batched networks
would have to. `extra_info` holds the ratios of their times; nothing passes or fails by the clock.
"""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch

from cfx.core.threads import one_thread
from cfx.data.pairs import PairBatch
from cfx.learners.base import TrainingData, TrainingPairs
from cfx.learners.rollout import RolloutSettings
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.models.base import DrivingModel
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.gru import GruPolicy
from cfx.policies.heads.offset import NONE, OffsetHead
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, WindowSettings
from tests.drives import wavy_pairs
from tests.learners.made import module_with

NETWORKS, DRIVERS, FRAMES = 6, 57, 700
POLICY = GruPolicy(
    inputs=("leader_speed", "relative_speed", "gap", "follower_acceleration", "leader_acceleration")
)


def _training_data(model: DrivingModel, networks: int) -> TrainingData:
    driven = Krauss()
    unit = torch.rand((DRIVERS, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pairs = wavy_pairs(driven, driven.space.from_unit(0.1 + 0.2 * unit), frames=FRAMES)
    index = torch.arange(DRIVERS).repeat(networks)
    network = torch.arange(networks).repeat_interleave(DRIVERS)
    fixed = model.space.defaults().expand(len(index), -1)
    names, windows = tuple(f"fold {k}" for k in range(networks)), WindowSettings()
    batch, split = PairBatch.of(pairs), Split.none(pairs, windows)[index]
    return TrainingData(
        MemoryStepper(model, 0.1),
        batch,
        TrainingPairs(index, split, network, fixed, base=fixed),
        windows,
        names,
        seed=0,
    )


class Step:
    """What `RolloutModule.training_step` computes, without Lightning around it."""

    def __init__(
        self, model: DrivingModel, settings: RolloutSettings, networks: int = NETWORKS
    ) -> None:
        training_data = _training_data(model, networks)
        head, generator = OffsetHead.for_model(model), torch.Generator().manual_seed(0)
        dataset = RolloutDataset.of(training_data, POLICY, head, settings, generator)
        blank = torch.full((len(dataset.pair), len(model.space)), NONE)
        width = dataset.scaler.mean.shape[-1]
        network = POLICY.build(width, blank[0], blank, torch.Generator().manual_seed(0))
        self.module = module_with(network, dataset, training_data, settings, POLICY)
        self.optimizer = torch.optim.AdamW(self.module.network.parameters(), lr=1e-3)
        self.number = 0

    @one_thread()
    def __call__(self) -> None:
        self.optimizer.zero_grad()
        for loss in self.module.step_losses(self.number):
            loss.sum().backward()
        self.optimizer.step()
        self.number += 1


@pytest.mark.benchmark(group="training")
@pytest.mark.parametrize("model", [Krauss(), W99()], ids=["krauss", "w99"])
@pytest.mark.parametrize("ensemble_size", [1, 4])
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
def test_a_gradient_step(benchmark: Any, model: DrivingModel, ensemble_size: int) -> None:
    compiled, eager = (
        Step(model, RolloutSettings(compile=how, ensemble_size=ensemble_size))
        for how in ("always", "never")
    )
    windows = Step(model, RolloutSettings(compile="always", ensemble_size=ensemble_size))
    windows.module.compiled = {}
    windows.module.training_window.compile()
    alone = Step(model, RolloutSettings(compile="never", ensemble_size=1), networks=1)
    began = time.perf_counter()
    compiled()
    benchmark.extra_info["seconds to compile"] = time.perf_counter() - began
    began = time.perf_counter()
    windows()
    benchmark.extra_info["seconds for torch.compile"] = time.perf_counter() - began
    eager()
    alone()
    for step in (compiled, windows, eager, alone):
        step.number = 100
    benchmark.pedantic(compiled, rounds=5)
    took = benchmark.stats.stats.median
    benchmark.extra_info["times faster than windows of torch.compile"] = _seconds(windows) / took
    benchmark.extra_info["times faster than eager"] = _seconds(eager) / took
    benchmark.extra_info["times faster than eager, a network at a time"] = (
        NETWORKS * ensemble_size * _seconds(alone) / took
    )


def _seconds(step: Step) -> float:
    began = time.perf_counter()
    for _ in range(3):
        step()
    return (time.perf_counter() - began) / 3
