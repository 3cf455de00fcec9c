"""An epoch of imitation: one network per pair as one batch, beside `torch.nn.GRU`s one by one."""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch
from torch import nn

from cfx.calibration.calibrator import WindowLabels
from cfx.core.threads import one_thread
from cfx.data.pairs import PairBatch
from cfx.learners.base import TrainingData, TrainingPairs
from cfx.learners.imitation import ImitationLearner
from cfx.models.krauss import Krauss
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, Windows, WindowSettings
from tests.drives import straight_pairs

PAIRS, FRAMES, EPOCHS, BATCH = 94, 700, 5, 16


def _training_data() -> TrainingData:
    model, settings = Krauss(), WindowSettings()
    pairs = straight_pairs([FRAMES] * PAIRS)
    split = Split.of(pairs, settings, 0.8)
    windows = Windows.of(split.windows, settings)
    unit = torch.rand(
        (len(windows), 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    even = torch.ones(len(windows), dtype=torch.float64)
    labels = WindowLabels(
        windows,
        model.space.from_unit(unit),
        even,
        even,
        torch.zeros(len(windows), dtype=torch.int64),
    )
    fixed = model.space.defaults().expand(PAIRS, 2)
    names = tuple(f"p{i}" for i in range(PAIRS))
    return TrainingData(
        MemoryStepper(model, 0.1),
        PairBatch.of(pairs),
        TrainingPairs(torch.arange(PAIRS), split, torch.arange(PAIRS), fixed, labels=labels),
        settings,
        names,
        seed=0,
    )


@one_thread()
def _one_by_one(networks: int) -> float:
    """Seconds that an epoch of `networks` separate GRUs takes in plain PyTorch."""
    windows = WindowSettings().count(FRAMES) * 8 // 10
    tokens, labels = torch.randn(1, windows, 10), torch.rand(1, windows, 2)
    began = time.perf_counter()
    for _ in range(networks):
        recurrent, head = nn.GRU(10, 32, batch_first=True), nn.Linear(32, 2)
        optimizer = torch.optim.AdamW([*recurrent.parameters(), *head.parameters()], lr=3e-3)
        state = None
        for first in range(0, windows, BATCH):
            out, state = recurrent(tokens[:, first : first + BATCH], state)
            loss = (head(out).sigmoid() - labels[:, first : first + BATCH]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            state = state.detach()
    return time.perf_counter() - began


@pytest.mark.benchmark(group="training")
def test_epoch_of_94_networks(benchmark: Any) -> None:
    training_data = _training_data()
    learner = ImitationLearner(epochs=EPOCHS, batch_size=BATCH, patience=None)
    learner.fit(GruPolicy(), training_data)  # imports and first-call costs
    benchmark.pedantic(learner.fit, args=(GruPolicy(), training_data), rounds=3)
    per_epoch = benchmark.stats.stats.min / EPOCHS
    benchmark.extra_info["milliseconds per epoch"] = 1e3 * per_epoch
    benchmark.extra_info["times faster than one network after the other"] = (
        _one_by_one(PAIRS) / per_epoch
    )
