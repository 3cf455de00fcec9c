"""Closed-loop training as a whole: what it learns, how it goes on, and what it refuses."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from cfx.calibration.huber import SpeedHuber
from cfx.calibration.mixed import Mixed
from cfx.calibration.objectives import Objective
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.calibration.theil_u import TheilInequality
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError
from cfx.learners.base import TrainingPairs, TrainingResult
from cfx.learners.rollout import RolloutLearner
from cfx.learners.rollout.module import RolloutModule
from cfx.learners.rollout.shard import training_key
from cfx.learners.workspace import Workspace
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies.core import Ensemble
from cfx.policies.gru import GruPolicy
from cfx.policies.lstm import LstmPolicy
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split
from tests.further import RAIN
from tests.learners.made import (
    COMPILED,
    INPUTS,
    QUICK,
    TRUE,
    error,
    gru,
    loop,
    placed,
    training_data,
    untrained,
)

SHORT = QUICK | {"epochs": 3, "steps": 5, "horizon": 6, "learning_rate": 0.02}


def assert_same_weights(one: TrainingResult, two: TrainingResult) -> None:
    for a, b in zip(one.network.parameters(), two.network.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("has_base", [False, True], ids=["pooled", "driver-specific"])
def test_untrained_it_is_the_fixed_model(has_base: bool) -> None:
    """With the pooled base and with driver-specific ones, to the last bits."""
    own = TRUE.repeat(2, 1)
    policy, data = gru(), training_data(base=own)
    expected = own if has_base else data.pairs.start
    found = loop(untrained(data, policy), data, policy, first=100, base=own if has_base else None)
    constant = expected[:, None].expand_as(found.parameters)
    torch.testing.assert_close(found.parameters, constant, rtol=0, atol=1e-6)


def test_it_learns_to_drive_like_the_drivers() -> None:
    policy, data = gru(), training_data()
    before = error(loop(untrained(data, policy), data, policy), data)
    result = RolloutLearner(**(COMPILED | {"cold_start_fraction": 0.0})).fit(policy, data)
    assert error(loop(result, data, policy, first=100), data, first=100) < 0.5 * before
    curves = result.curves.groupby("epoch")[["train_loss", "validation_loss"]].mean()
    assert curves.train_loss.iloc[-1] < 0.7 * curves.train_loss.iloc[0]
    assert curves.validation_loss.min() < 0.8 * curves.validation_loss.iloc[0]


@pytest.mark.slow
def test_a_residual_policy_starts_where_the_driver_is_and_drives_better() -> None:
    """It has exactly the driver's acceleration at first, trained or not."""
    policy, data = gru(), training_data(networks=1)
    options = QUICK | {"cold_start_fraction": 0.0, "head": "residual"}
    errors = []
    for result in (
        untrained(data, policy, head="residual"),
        RolloutLearner(**options).fit(policy, data),
    ):
        found = loop(result, data, policy, first=100)
        first = (found.speed[:, 1] - found.speed[:, 0]) / 0.1
        measured = data.batch.follower_acceleration[:, 100]
        torch.testing.assert_close(first, measured, rtol=0, atol=1e-5)
        assert found.parameters.shape[-1] == len(data.stepper.model.space)
        errors.append(error(found, data, first=100))
    assert errors[1] < 0.6 * errors[0]


_losses_of_objectives: list[list[float]] = []


@pytest.mark.parametrize(
    "objective",
    [SpeedRmse(), GapRmse(), Mixed(), TheilInequality(), SpeedHuber()],
    ids=lambda o: type(o).__name__,
)
def test_it_minimises_the_objective_of_the_job(objective: Objective) -> None:
    options = COMPILED | {"epochs": 3, "steps": 8, "gap_weight": 0.0}
    data = training_data(networks=1, objective=objective, base=TRUE * 1.3)
    losses = RolloutLearner(**options).fit(gru(), data).curves.train_loss.tolist()
    assert losses[-1] < losses[0]
    assert losses not in _losses_of_objectives, "each objective has a loss of its own"
    _losses_of_objectives.append(losses)


@pytest.mark.slow
def test_driver_features_help_to_drive_more_like_each_driver() -> None:
    """All from one base and without history, so that nothing else tells drivers apart."""
    errors = []
    for driver_features in ((), ("time_headway", "time_gap")):
        policy = gru(driver_features=driver_features)
        data = training_data(networks=1, frames=400)
        short = {"epochs": 5, "cold_start_fraction": 0.0, "burn_in_s": 0.5, "horizon": 20}
        result = RolloutLearner(**(QUICK | short)).fit(policy, data)
        errors.append(error(loop(result, data, policy, first=300), data, first=300))
    assert errors[1] < 0.6 * errors[0]


def test_training_goes_on_where_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, whole = gru(dropout=0.1), training_data(frames=150)
    learner = RolloutLearner(**(SHORT | {"epochs": 6, "ensemble_size": 2}))
    expected = learner.fit(policy, whole)
    workspace = Workspace(tmp_path / "broken")
    broken = replace(whole, workspace=workspace)
    judge, epochs = RolloutModule.judge, []

    def interrupt(self: RolloutModule, *losses: torch.Tensor, **options: bool) -> None:
        judge(self, *losses, **options)
        epochs.append(len(self.rows))
        if len(epochs) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(RolloutModule, "judge", interrupt)
    with pytest.raises(KeyboardInterrupt):
        learner.fit(policy, broken)
    assert len(list((tmp_path / "broken").iterdir())) == 1
    again = learner.fit(policy, broken)
    # The broken epoch is done again, those before it are not.
    assert epochs == [1, 2, 3, 3, 4, 5, 6]
    pd.testing.assert_frame_equal(again.curves, expected.curves)
    assert_same_weights(again, expected)
    workspace.clear()
    assert not list(tmp_path.glob("*/*"))


@pytest.mark.parametrize("stops_early", [False, True])
def test_training_that_ended_is_not_done_again_until_the_workspace_is_cleared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, stops_early: bool
) -> None:
    """A job may be interrupted after it, while it simulates."""
    workspace = Workspace(tmp_path)
    data, ended = training_data(frames=150, workspace=workspace), {"epochs": 4}
    if stops_early:
        ended |= {"patience": 1, "learning_rate": 1e-12}  # no epoch is better than the first
    learner = RolloutLearner(**(SHORT | ended))
    expected = learner.fit(gru(), data)
    assert (expected.curves["epoch"].max() < 3) == stops_early
    with monkeypatch.context() as patched:
        patched.setattr(RolloutModule, "judge", None)
        again = learner.fit(gru(), data)
    pd.testing.assert_frame_equal(again.curves, expected.curves)
    assert_same_weights(again, expected)
    assert list(tmp_path.iterdir())
    workspace.clear()
    assert not list(tmp_path.iterdir())


def test_neither_experts_nor_their_students_train_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, whole = gru(), training_data(networks=1, frames=150)
    learner = RolloutLearner(**(SHORT | {"epochs": 4, "distillation_epochs": 2}))
    expected = learner.fit(policy, whole)
    workspace = Workspace(tmp_path / "broken")
    broken = replace(whole, workspace=workspace)
    judge, epochs = RolloutModule.judge, []

    def interrupt(self: RolloutModule, *losses: torch.Tensor, **options: bool) -> None:
        judge(self, *losses, **options)
        epochs.append(("student" if self.expert else "expert", len(self.rows)))
        if len(epochs) in {2, 5}:
            raise KeyboardInterrupt

    monkeypatch.setattr(RolloutModule, "judge", interrupt)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            learner.fit(policy, broken)
    again = learner.fit(policy, broken)
    assert epochs[:4] == [("expert", 1), ("expert", 2), ("expert", 2), ("student", 1)]
    assert epochs[4:] == [("student", 2), ("student", 2), ("student", 3), ("student", 4)]
    pd.testing.assert_frame_equal(again.curves, expected.curves)
    assert_same_weights(again, expected)
    workspace.clear()
    assert not list(tmp_path.glob("*/*"))


def test_a_checkpoint_of_another_training_is_not_taken_up() -> None:
    policy, data, learner = gru(), training_data(), RolloutLearner(**QUICK).identity()
    key = training_key(learner, policy, data)
    assert key == training_key(learner, policy, training_data())
    assert key != training_key(learner, policy, replace(data, seed=1))
    assert key != training_key(learner, policy, replace(data, objective=GapRmse()))
    longer = RolloutLearner(**(QUICK | {"steps": 16})).identity()
    assert key != training_key(longer, policy, data)


def test_a_checkpoint_of_other_data_is_not_taken_up() -> None:
    """Whatever is changed of the recordings or of what is learned from them gives another file."""
    policy, identity = gru(), RolloutLearner(**QUICK).identity()
    data = training_data(base=TRUE * 1.3)
    rain = torch.ones_like(data.recorded.leader_speed)
    data = replace(data, recorded=replace(data.recorded, surroundings={RAIN: rain}))
    others = []
    for name in ("recorded", "pairs"):
        record = getattr(data, name)
        for field in fields(record):
            value = getattr(record, field.name)
            if isinstance(value, torch.Tensor):
                value = ~value if value.dtype == torch.bool else value + 1
            elif isinstance(value, Split):
                value = replace(value, frame=value.frame - 1)
            elif field.name in {"drivers", "sites"}:
                value = ("other",) * len(data.pairs)
            elif field.name == "dt":
                value = 0.2
            elif field.name == "surroundings":
                value = {RAIN: rain + 1}
            else:
                assert (field.name, value) == ("labels", None)
                continue
            others.append(replace(data, **{name: replace(record, **{field.name: value})}))
    files = {training_key(identity, policy, one) for one in (data, *others)}
    assert len(others) == len(fields(PairBatch)) + len(fields(TrainingPairs)) - 1
    assert len(files) == 1 + len(others)


def test_nothing_is_learned_from_validation_drivers() -> None:
    """What such a driver does changes the validation loss, and no weight."""
    policy, settings = gru(), COMPILED | {"epochs": 2, "steps": 5, "patience": None}
    data = training_data(networks=1)
    dataset = placed(data, policy)
    kept = dataset.validates[0]
    assert 0 < int(kept.sum()) < 6
    assert not bool((dataset.trains & dataset.validates).any())
    speed = data.recorded.follower_speed
    shifted = torch.where(kept[:, None], speed + 1.0, speed)
    other = replace(data, recorded=replace(data.recorded, follower_speed=shifted))
    one = RolloutLearner(**settings).fit(policy, data)
    two = RolloutLearner(**settings).fit(policy, other)
    assert one.curves.train_loss.tolist() == two.curves.train_loss.tolist()
    assert one.curves.validation_loss.tolist() != two.curves.validation_loss.tolist()


def test_an_ensemble_learns_and_drives_as_one() -> None:
    """Its networks learn different things; to a user it is one, with one learning curve."""
    policy, data = gru(), training_data()
    result = RolloutLearner(**(COMPILED | {"ensemble_size": 3})).fit(policy, data)
    assert isinstance(result.network, Ensemble)
    assert result.curves.network.tolist() == ["n0", "n1"] * 6
    assert result.scaler.mean.shape[0] == len(data.names)
    for weights in result.network.members.parameters():
        assert not torch.equal(weights[0], weights[1])
        assert not torch.equal(weights[0], weights[2])
    before = error(loop(untrained(data, policy), data, policy, first=100), data, first=100)
    assert error(loop(result, data, policy, first=100), data, first=100) < 0.8 * before


@pytest.mark.parametrize(
    "options",
    [
        {"tbptt_windows": 4, "drivers": 3, "gradient_clip": None, "patience": None},
        {"validation": 0.0, "cold_start_fraction": 1.0, "temperature": 0.0},
        {"head": "residual", "time_weighting": "relative", "distillation_epochs": 1},
        {"head": "stochastic", "time_weighting": "relative", "jerk_weight": 0.01},
    ],
    ids=lambda options: next(iter(options)),
)
def test_every_option_trains(options: dict[str, Any]) -> None:
    policy, data = gru(), training_data(networks=1, frames=150, base=TRUE * 1.3)
    result = RolloutLearner(**(SHORT | options)).fit(policy, data)
    # The training loss of a stochastic head counts other terms from half of the epochs on.
    measure = "validation_loss" if options.get("head") == "stochastic" else "train_loss"
    curve = result.curves.groupby("epoch")[measure].mean()
    assert curve.iloc[-1] < curve.iloc[0]
    is_unvalidated = bool(result.curves.validation_loss.isna().all())
    assert is_unvalidated == (options.get("validation") == 0.0)


@pytest.mark.slow
def test_w99_learns_through_smoothed_regimes_and_drives_exactly() -> None:
    """Exact thresholds have no gradient, smoothed ones do; the exact model drives better for it."""
    policy = LstmPolicy(inputs=INPUTS, hidden_size=12)
    data = training_data(model=W99(), networks=1)
    before = error(loop(untrained(data, policy), data, policy, first=50), data, first=50)
    options = QUICK | {"epochs": 4, "steps": 8, "patience": None}
    result = RolloutLearner(**options).fit(policy, data)
    assert error(loop(result, data, policy, first=50), data, first=50) < 0.9 * before
    assert data.stepper.model.temperature == 0


@pytest.mark.slow
def test_compiled_training_is_eager_training() -> None:
    policy, data = gru(), training_data(networks=1)
    curves = []
    for how in ("never", "always"):
        learner = RolloutLearner(**(QUICK | {"epochs": 2, "steps": 3, "compile": how}))
        curves.append(learner.fit(policy, data).curves)
    pd.testing.assert_frame_equal(*curves, rtol=1e-3)


def test_patience_begins_after_distillation() -> None:
    """Nothing gets better: four epochs are distillation, and two more are waited for."""
    policy, data = gru(), training_data(networks=1, frames=150)
    still = {"steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0}
    options = QUICK | still | {"epochs": 8, "distillation_epochs": 4, "patience": 2}
    curves = RolloutLearner(**options).fit(policy, data).curves
    assert curves.epoch.max() + 1 == 6


@pytest.mark.slow
def test_distillation_makes_a_policy_drive_better() -> None:
    """The validation loss is of the student's own trajectories; it learns from the expert alone."""
    policy, data = gru(), training_data(networks=1)
    before = untrained(data, policy).curves.validation_loss.iloc[0]
    options = {
        "epochs": 12,
        "distillation_epochs": 6,
        "cold_start_fraction": 0.0,
        "patience": None,
    }
    curves = RolloutLearner(**(QUICK | options)).fit(policy, data).curves
    assert curves.validation_loss[curves.epoch == 5].item() < 0.7 * before


def test_some_epochs_must_be_left_for_training_in_closed_loop() -> None:
    message = "distillation_epochs=6 leaves none of epochs=6 for training in closed loop"
    with pytest.raises(ConfigError, match=rf"learner.*{message}.*learner.distillation_epochs"):
        RolloutLearner(**(QUICK | {"distillation_epochs": 6}))


def test_a_simulator_without_gradients_is_refused() -> None:
    class Blind(MemoryStepper):
        differentiable = False

    data = replace(training_data(networks=1), stepper=Blind(Krauss(), 0.1))
    message = r"this learner needs gradients, and the simulator has none; choose .*=imitation"
    with pytest.raises(ConfigError, match=message):
        RolloutLearner(**QUICK).fit(gru(), data)


def test_a_model_without_gradients_is_refused() -> None:
    class Stepwise(Krauss):
        differentiable = False

    with pytest.raises(ConfigError, match="the driving model has none"):
        RolloutLearner(**QUICK).fit(gru(), training_data(networks=1, model=Stepwise()))


def test_a_policy_without_the_gap_trains_too() -> None:
    policy = GruPolicy(inputs=("leader_speed", "follower_speed"), hidden_size=8)
    options = QUICK | {"epochs": 2, "steps": 6}
    curves = RolloutLearner(**options).fit(policy, training_data(networks=1)).curves
    assert bool(curves.train_loss.notna().all())
