from __future__ import annotations

import math

import pytest
import torch

from cfx.agents.placement import group_by
from cfx.calibration.calibrator import Labels
from cfx.calibration.windows import Split, Windows, WindowSettings
from cfx.errors import DataError
from cfx.learners.base import TrainingData, TrainingResult
from cfx.learners.imitation import ImitationLearner
from cfx.models.krauss import Krauss
from cfx.pairs import PairBatch
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

SETTINGS = WindowSettings()
QUICK = {"epochs": 30, "learning_rate": 0.02}


def training_data(
    pairs: int = 3, *, scope: str = "pair", frames: int = 200, sensitivity: float = 1.0
) -> TrainingData:
    """Labels that follow the leader's speed, so that there is something to learn."""
    model = Krauss()
    drives = wavy_pairs(
        model,
        torch.tensor([[1.5, 0.1], [2.0, 0.3], [2.5, 0.5], [1.0, 0.0]]).double()[:pairs],
        frames=frames,
    )
    batch = PairBatch.of(drives)
    split = Split.of(drives, SETTINGS, 0.8)
    windows = Windows.of(split.windows, SETTINGS)
    speed = batch.leader_speed[windows.pair, windows.first]
    unit = torch.stack([speed / 20, 1 - speed / 20], dim=-1).clamp(0.05, 0.95)
    even = torch.full((len(windows),), sensitivity).double()
    labels = Labels(
        windows,
        model.space.from_unit(unit),
        even,
        even,
        torch.zeros(len(windows), dtype=torch.int64),
    )
    names = ["all"] * pairs if scope == "all" else [f"p{i}" for i in range(pairs)]
    network, groups = group_by(names)
    fixed = model.space.defaults().expand(pairs, 2)
    return TrainingData(
        MemoryStepper(model, 0.1), batch, split, SETTINGS, fixed, labels, network, groups, seed=0
    )


def parts(training_result: TrainingResult, network: int) -> list[torch.Tensor]:
    return [value[network] for value in training_result.network.parameters()]


def test_it_learns_what_can_be_learned() -> None:
    training_result = ImitationLearner(epochs=80, learning_rate=0.02, patience=None).fit(
        GruPolicy(), training_data()
    )
    curve = training_result.curves.groupby("epoch")[["train_loss", "validation_loss"]].mean()
    assert curve.train_loss.iloc[-1] < 0.05 * curve.train_loss.iloc[0]
    assert curve.validation_loss.min() < 0.2 * curve.validation_loss.iloc[0]
    assert set(training_result.curves.network) == {"p0", "p1", "p2"}


def test_networks_do_not_depend_on_their_companions() -> None:
    """Trained alone or beside others, a network gets the same weights."""
    learner = ImitationLearner(**QUICK)
    three, two = (
        learner.fit(GruPolicy(), training_data(3)),
        learner.fit(GruPolicy(), training_data(2)),
    )
    # Initial weights are drawn for all networks together, so only the losses can be compared across sizes.
    again = learner.fit(GruPolicy(), training_data(3))
    assert all(torch.equal(a, b) for a, b in zip(parts(three, 1), parts(again, 1), strict=True))
    assert len(three.curves) // 3 <= 30
    assert set(two.curves.network) == {"p0", "p1"}


def test_the_same_seed_gives_the_same_weights_and_another_does_not() -> None:
    from dataclasses import replace

    learner = ImitationLearner(**QUICK)
    one, two = (
        learner.fit(GruPolicy(dropout=0.1), training_data()),
        learner.fit(GruPolicy(dropout=0.1), training_data()),
    )
    other = learner.fit(GruPolicy(dropout=0.1), replace(training_data(), seed=1))
    assert all(
        torch.equal(a, b)
        for a, b in zip(one.network.parameters(), two.network.parameters(), strict=True)
    )
    assert not all(
        torch.equal(a, b)
        for a, b in zip(one.network.parameters(), other.network.parameters(), strict=True)
    )


def test_the_best_epoch_is_kept() -> None:
    dataset = training_data(1)
    training_result = ImitationLearner(
        epochs=60, learning_rate=0.05, patience=None, gradient_clip=None, batch_size=4
    ).fit(GruPolicy(), dataset)
    best = training_result.curves.validation_loss.min()
    # One epoch without learning measures the weights that were kept.
    kept = ImitationLearner(epochs=1, learning_rate=1e-12)
    again = kept.fit(_Fixed(training_result.network), dataset)
    assert again.curves.validation_loss.iloc[0] == pytest.approx(best, rel=1e-4)
    assert training_result.curves.validation_loss.iloc[-1] > best


class _Fixed(GruPolicy):
    """Hands out networks that are already there."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def build(self, *_: object) -> torch.nn.Module:  # type: ignore[override]  # it does not need what a builder needs
        return self.network


def test_patience_ends_the_training() -> None:
    training_result = ImitationLearner(epochs=500, learning_rate=0.2, patience=3).fit(
        GruPolicy(), training_data(1)
    )
    assert training_result.curves.epoch.max() < 499


def test_without_validation_the_training_loss_decides() -> None:
    training_result = ImitationLearner(validation=0.0, **QUICK).fit(GruPolicy(), training_data(2))
    assert training_result.curves.validation_loss.isna().all()
    assert training_result.curves.train_loss.iloc[-1] < training_result.curves.train_loss.iloc[0]


def test_one_network_for_all_pairs() -> None:
    training_result = ImitationLearner(**QUICK).fit(GruPolicy(), training_data(3, scope="all"))
    assert {value.shape[0] for value in training_result.network.parameters()} == {1}
    assert set(training_result.curves.network) == {"all"}


def test_windows_that_tell_nothing_weigh_nothing() -> None:
    """Labels of windows without spread are replaced by noise; weighting by spread must not notice."""
    from dataclasses import replace

    dataset = training_data(1)
    assert dataset.labels is not None
    count = len(dataset.labels.windows)
    mute = torch.arange(count) % 2 == 0
    sensitivity = torch.where(mute, 0.0, 1.0).double()
    silent = replace(dataset.labels, sensitivity=sensitivity)
    scrambled = replace(
        silent, parameters=torch.where(mute[:, None], silent.parameters.flip(0), silent.parameters)
    )
    learner = ImitationLearner(weight_by_sensitivity=True, **QUICK)
    one = learner.fit(GruPolicy(), replace(dataset, labels=silent))
    two = learner.fit(GruPolicy(), replace(dataset, labels=scrambled))
    assert all(
        torch.equal(a, b)
        for a, b in zip(one.network.parameters(), two.network.parameters(), strict=True)
    )
    plain = ImitationLearner(weight_by_sensitivity=False, **QUICK)
    three = plain.fit(GruPolicy(), replace(dataset, labels=scrambled))
    assert not all(
        torch.equal(a, b)
        for a, b in zip(one.network.parameters(), three.network.parameters(), strict=True)
    )


def test_labels_without_any_spread_still_train() -> None:
    training_result = ImitationLearner(**QUICK).fit(GruPolicy(), training_data(2, sensitivity=0.0))
    assert all(math.isfinite(loss) for loss in training_result.curves.train_loss)


def test_only_the_training_part_is_read() -> None:
    """NaN after the split would poison every weight."""
    from dataclasses import replace

    dataset = training_data(2)
    after = torch.arange(dataset.batch.mask.shape[1]) > dataset.split.frame[:, None]
    hidden = {
        name: torch.where(after, torch.nan, getattr(dataset.batch, name))
        for name in ("leader_speed", "follower_speed", "follower_position", "leader_position")
    }
    training_result = ImitationLearner(**QUICK).fit(
        GruPolicy(), replace(dataset, batch=replace(dataset.batch, **hidden))
    )
    assert all(bool(value.isfinite().all()) for value in training_result.network.parameters())


def test_too_few_windows_for_validation_is_said() -> None:
    with pytest.raises(DataError, match=r"only 2 training windows.*learner.validation=0"):
        ImitationLearner(validation=0.9).fit(GruPolicy(), training_data(1, frames=18))
