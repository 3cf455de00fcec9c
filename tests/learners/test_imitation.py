"""Imitation of labels: what networks learn, with direct answers and with offsets."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cfx.calibration.calibrator import WindowLabels
from cfx.data.pairs import PairBatch
from cfx.errors import DataError
from cfx.learners.base import TrainingData, TrainingPairs, TrainingResult
from cfx.learners.imitation import ImitationLearner
from cfx.models.krauss import Krauss
from cfx.policies.checkpoint import load_agent, save_agent
from cfx.policies.context import DriverContext
from cfx.policies.core import group_by
from cfx.policies.gru import GruPolicy
from cfx.policies.history import measured_history
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, Windows, WindowSettings
from cfx_contracts import check_contract
from tests.drives import wavy_pairs
from tests.learners.made import ready

SETTINGS = WindowSettings()
QUICK = {"epochs": 12, "learning_rate": 0.02}
TRUE = torch.tensor([[1.5, 0.1], [2.0, 0.3], [2.5, 0.5], [1.0, 0.0]]).double()


def training_data(
    pairs: int = 3, *, together: bool = False, frames: int = 200, sensitivity: float = 1.0
) -> TrainingData:
    """Labels that follow the leader's speed, so that there is something to learn."""
    model = Krauss()
    recorded = wavy_pairs(model, TRUE[:pairs], frames=frames)
    batch = PairBatch.of(recorded)
    split = Split.of(recorded, SETTINGS, 0.8)
    windows = Windows.of(split.windows, SETTINGS)
    speed = batch.leader_speed[windows.pair, windows.first]
    unit = torch.stack([speed / 20, 1 - speed / 20], dim=-1).clamp(0.05, 0.95)
    even = torch.full((len(windows),), sensitivity).double()
    labels = WindowLabels(
        windows=windows,
        parameters=model.space.from_unit(unit),
        loss=even,
        sensitivity=even,
        diverged=torch.zeros(len(windows), dtype=torch.int64),
    )
    names = [f"p{i}" for i in range(pairs)]
    if together:
        names = ["all"] * pairs
    network, groups = group_by(names)
    return TrainingData(
        stepper=MemoryStepper(model, 0.1),
        recorded=batch,
        pairs=TrainingPairs(
            index=torch.arange(pairs),
            split=split,
            network=network,
            start=model.space.defaults().expand(pairs, 2),
            labels=labels,
        ),
        windows=SETTINGS,
        names=groups,
        seed=0,
    )


def own_bases(data: TrainingData) -> torch.Tensor:
    """Returns a base for each driver, `(P, n)`, all different."""
    shift = torch.linspace(-0.2, 0.2, len(data.pairs.start)).double()[:, None]
    space = data.stepper.model.space
    return space.from_unit(space.to_unit(data.pairs.start) + shift)


def same_weights(one: TrainingResult, two: TrainingResult) -> bool:
    others = dict(two.network.named_parameters())
    return all(torch.equal(value, others[name]) for name, value in one.network.named_parameters())


def test_contract_with_offsets() -> None:
    check_contract(ImitationLearner(epochs=30, learning_rate=0.03, head="offset"))


@pytest.mark.parametrize("head", ["direct", "offset"])
def test_it_learns_what_can_be_learned(head: str) -> None:
    learner = ImitationLearner(epochs=40, learning_rate=0.03, patience=None, head=head)
    result = learner.fit(GruPolicy(), training_data())
    curve = result.curves.groupby("epoch")[["train_loss", "validation_loss"]].mean()
    assert curve.train_loss.iloc[-1] < 0.05 * curve.train_loss.iloc[0]
    assert curve.validation_loss.min() < 0.2 * curve.validation_loss.iloc[0]
    assert set(result.curves.network) == {"p0", "p1", "p2"}
    assert result.head == head


def test_answers_as_offsets_begin_at_the_base_of_each_driver() -> None:
    """Hardly trained, every driver gets their own base, and unseen drivers the pooled one."""
    data = training_data(together=True)
    own = own_bases(data)
    learner = ImitationLearner(epochs=1, learning_rate=1e-12, head="offset")
    result = learner.fit(GruPolicy(), replace(data, pairs=replace(data.pairs, base=own)))
    assert result.base is not None
    torch.testing.assert_close(result.base, data.pairs.start[:1], rtol=1e-6, atol=0)
    agent = ready(result, data, GruPolicy())
    history = measured_history(data.batch, torch.arange(3), torch.full((3,), 50), SETTINGS.length)
    for base, expected in ((own, own), (None, data.pairs.start)):
        state = agent.begin(data.pairs.network, DriverContext(base=base))
        chosen, _ = agent.act(history, state)
        torch.testing.assert_close(chosen, expected, rtol=1e-5, atol=1e-6)


def test_offsets_are_learned_from_each_drivers_base_and_from_the_pooled_one() -> None:
    """Labels are driver-specific parameters: no offset from these, one from the pooled base."""
    data = training_data(together=True)
    assert data.pairs.labels is not None
    own = own_bases(data)
    labels = replace(data.pairs.labels, parameters=own[data.pairs.labels.windows.pair])
    data = replace(data, pairs=replace(data.pairs, labels=labels, base=own))
    learner = ImitationLearner(epochs=60, learning_rate=0.02, patience=None, head="offset")
    result = learner.fit(GruPolicy(), data)
    agent, space = ready(result, data, GruPolicy()), data.stepper.model.space
    truth = space.to_unit(own)
    errors = {}
    for name, base in (("own", own), ("pooled", None)):
        frames = torch.full_like(data.pairs.network, 100)
        state = agent.begin(data.pairs.network, DriverContext(base=base))
        state = agent.burn_in(data.batch, frames, state)
        history = measured_history(data.batch, torch.arange(3), frames, SETTINGS.length)
        chosen, _ = agent.act(history, state)
        errors[name] = float((space.to_unit(chosen) - truth).abs().mean())
    untrained = float((space.to_unit(data.pairs.start) - truth).abs().mean())
    assert errors["own"] < 0.3 * untrained
    assert errors["pooled"] < 0.7 * untrained


def test_a_saved_policy_of_offsets_answers_the_same(tmp_path: Path) -> None:
    data = training_data(together=True)
    own = own_bases(data)
    policy = GruPolicy()
    learner = ImitationLearner(epochs=3, learning_rate=0.05, head="offset")
    agent = ready(
        learner.fit(policy, replace(data, pairs=replace(data.pairs, base=own))), data, policy
    )
    agent = replace(agent, model_node={"name": "krauss"}, policy_node={"name": "gru"})
    save_agent(agent, tmp_path)
    again = load_agent(tmp_path)
    assert again.core.head.name == "offset"
    history = measured_history(data.batch, torch.arange(3), torch.full((3,), 50), SETTINGS.length)
    answers = []
    for one in (agent, again):
        state = one.begin(data.pairs.network, DriverContext(base=own))
        answers.append(one.act(history, state)[0])
    assert torch.equal(*answers)


def test_direct_answers_do_not_depend_on_bases() -> None:
    learner, data = ImitationLearner(**QUICK), training_data(together=True)
    one = learner.fit(GruPolicy(), data)
    two = learner.fit(GruPolicy(), replace(data, pairs=replace(data.pairs, base=own_bases(data))))
    assert same_weights(one, two)
    assert one.base is None
    assert two.base is None


def test_networks_do_not_depend_on_their_companions() -> None:
    """Initial weights are drawn for all networks together: only the curves show which there are."""
    learner = ImitationLearner(**QUICK)
    three = learner.fit(GruPolicy(), training_data(3))
    again = learner.fit(GruPolicy(), training_data(3))
    assert same_weights(three, again)
    assert len(three.curves) // 3 <= 30
    assert set(learner.fit(GruPolicy(), training_data(2)).curves.network) == {"p0", "p1"}


def test_the_same_seed_gives_the_same_weights_and_another_does_not() -> None:
    learner, policy = ImitationLearner(**QUICK), GruPolicy(dropout=0.1)
    one = learner.fit(policy, training_data())
    two = learner.fit(policy, training_data())
    other = learner.fit(policy, replace(training_data(), seed=1))
    assert same_weights(one, two)
    assert not same_weights(one, other)


def test_the_best_epoch_is_kept() -> None:
    data = training_data(1)
    learner = ImitationLearner(
        epochs=60, learning_rate=0.05, patience=None, gradient_clip=None, batch_size=4
    )
    result = learner.fit(GruPolicy(), data)
    best = result.curves.validation_loss.min()
    # One epoch without learning measures the weights that were kept.
    kept = ImitationLearner(epochs=1, learning_rate=1e-12)
    again = kept.fit(_Fixed(result.network), data)
    assert again.curves.validation_loss.iloc[0] == pytest.approx(best, rel=1e-4)
    assert result.curves.validation_loss.iloc[-1] > best


class _Fixed(GruPolicy):
    """Hands out networks that are already there."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def build(self, *_: object) -> torch.nn.Module:  # type: ignore[override]  # needs nothing of it
        return self.network


def test_patience_ends_the_training() -> None:
    learner = ImitationLearner(epochs=500, learning_rate=0.2, patience=3)
    assert learner.fit(GruPolicy(), training_data(1)).curves.epoch.max() < 499


def test_without_validation_the_training_loss_decides() -> None:
    result = ImitationLearner(validation=0.0, **QUICK).fit(GruPolicy(), training_data(2))
    assert result.curves.validation_loss.isna().all()
    assert result.curves.train_loss.iloc[-1] < result.curves.train_loss.iloc[0]


def test_one_network_for_all_pairs() -> None:
    result = ImitationLearner(**QUICK).fit(GruPolicy(), training_data(together=True))
    for value in result.network.parameters():
        assert value.shape[0] == 1
    assert set(result.curves.network) == {"all"}


def test_windows_without_sensitivity_weigh_nothing() -> None:
    """Labels of such windows are replaced by noise; only an unweighted error notices."""
    data = training_data(1)
    assert data.pairs.labels is not None
    mute = torch.arange(len(data.pairs.labels.windows)) % 2 == 0
    sensitivity = torch.where(mute, 0.0, 1.0).double()
    silent = replace(data.pairs.labels, sensitivity=sensitivity)
    noise = torch.where(mute[:, None], silent.parameters.flip(0), silent.parameters)
    scrambled = replace(silent, parameters=noise)
    results = {}
    for weighted in (True, False):
        learner = ImitationLearner(weight_by_sensitivity=weighted, **QUICK)
        one = learner.fit(GruPolicy(), replace(data, pairs=replace(data.pairs, labels=silent)))
        two = learner.fit(GruPolicy(), replace(data, pairs=replace(data.pairs, labels=scrambled)))
        results[weighted] = same_weights(one, two)
    assert results == {True: True, False: False}


def test_labels_without_any_sensitivity_still_train() -> None:
    result = ImitationLearner(**QUICK).fit(GruPolicy(), training_data(2, sensitivity=0.0))
    for loss in result.curves.train_loss:
        assert math.isfinite(loss)


@pytest.mark.parametrize("head", ["direct", "offset"])
def test_only_the_training_part_is_read(head: str) -> None:
    """NaN after the split would reach every weight."""
    data = training_data(2)
    after = torch.arange(data.batch.mask.shape[1]) > data.pairs.split.frame[:, None]
    hidden = {}
    for name in ("leader_speed", "follower_speed", "follower_position", "leader_position"):
        hidden[name] = torch.where(after, torch.nan, getattr(data.batch, name))
    other = replace(data, recorded=replace(data.recorded, **hidden))
    result = ImitationLearner(head=head, **QUICK).fit(GruPolicy(), other)
    for value in result.network.parameters():
        assert bool(value.isfinite().all())


def test_too_few_windows_for_validation_is_said() -> None:
    with pytest.raises(DataError, match=r"only 2 training windows.*learner.validation=0"):
        ImitationLearner(validation=0.9).fit(GruPolicy(), training_data(1, frames=18))
