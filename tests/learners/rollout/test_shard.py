"""A training that is cut into shards learns what the whole would."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from cfx.core import threads
from cfx.core.engine import Engine, Report
from cfx.learners.base import TrainingData, TrainingResult
from cfx.learners.rollout import RolloutLearner, shard
from cfx.learners.rollout import module as training
from cfx.learners.rollout.shard import networks_of_shards
from cfx.learners.workspace import Workspace
from tests.learners.made import QUICK, TRUE, gru, placed, training_data
from tests.scripts import run_script

SHORT = QUICK | {"ensemble_size": 2, "epochs": 2, "steps": 2, "horizon": 6}


class Recorded(Engine):
    """Works like `local` on one core, and remembers how many shards there were."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[tuple[str, ...]] = []
        self.alone: bool | None = None

    def map(
        self, work: Any, shards: Iterable[Any], report: Report, *, shares_cores: bool = True
    ) -> Generator[tuple[int, Any], None, None]:
        self.alone = shares_cores
        for number, one in reversed(list(enumerate(shards))):
            self.names.append(one.training_data.names)
            yield number, work(one, report)


def fit(data: TrainingData, monkeypatch: pytest.MonkeyPatch, *, cut: bool, **changes: Any) -> Any:
    """Trains; returns the result and the engine that has run it."""
    monkeypatch.setattr(shard, "_WORTH_A_PROCESS", 0 if cut else 10**12)
    engine = Recorded()
    learner = RolloutLearner(**(SHORT | changes))
    return learner.fit(gru(), replace(data, engine=engine)), engine


def assert_same(one: TrainingResult, two: TrainingResult) -> None:
    weights = two.network.state_dict()
    for name, value in one.network.state_dict().items():
        # Products of batches of other sizes round otherwise, and Adam divides by small gradients.
        torch.testing.assert_close(weights[name], value, rtol=0, atol=1e-3)
    assert one.base is not None
    assert two.base is not None
    torch.testing.assert_close(one.base, two.base)
    torch.testing.assert_close(one.scaler.mean, two.scaler.mean)
    pd.testing.assert_frame_equal(one.curves, two.curves, rtol=1e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cold_start_fraction": 1.0, "head": "residual", "time_weighting": "relative"},
        {"cold_start_fraction": 0.5, "drivers": 3},
        {"distillation_epochs": 1},
    ],
    ids=["with history", "cold starts with residuals", "some drivers", "distilled"],
)
def test_shards_learn_what_the_whole_does(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shards come back in another order than they were made in."""
    data = training_data(networks=3, frames=150, base=TRUE.repeat(3, 1))
    whole, at_once = fit(data, monkeypatch, cut=False, **changes)
    found, in_parts = fit(data, monkeypatch, cut=True, **changes)
    assert at_once.names == [("n0", "n1", "n2")]
    assert at_once.alone
    assert in_parts.names == [("n2",), ("n0", "n1")]
    assert not in_parts.alone
    assert_same(whole, found)


def test_an_interrupted_shard_goes_on_and_finished_ones_are_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = training_data(networks=2, frames=150, base=TRUE.repeat(2, 1))
    expected, _ = fit(data, monkeypatch, cut=True)
    workspace = Workspace(tmp_path)
    data = replace(data, workspace=workspace)
    done: list[tuple[str, ...]] = []

    @dataclass
    class Broken:
        """The first shard ends, the second stops after an epoch."""

        epochs: int = 0

        def __call__(self, one: Any, report: Report) -> Any:
            if one.training_data.names == ("n0",):
                done.append(one.training_data.names)
                return train(one, report)

            def stop(units: int) -> None:
                raise KeyboardInterrupt

            return train(one, stop)

    train = training.train
    monkeypatch.setattr("cfx.learners.rollout.module.train", Broken())
    learner = RolloutLearner(**SHORT)
    monkeypatch.setattr(shard, "_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(threads, "_LIMIT", [1])
    with pytest.raises(KeyboardInterrupt):
        learner.fit(gru(), data)
    assert done == [("n0",)]
    kept = sorted(tmp_path.iterdir())
    assert kept, "nothing to go on from"
    monkeypatch.undo()
    monkeypatch.setattr(shard, "_WORTH_A_PROCESS", 0)
    monkeypatch.setattr(threads, "_LIMIT", [1])
    assert_same(expected, learner.fit(gru(), data))
    workspace.clear()
    assert not list(tmp_path.iterdir())


def test_a_worker_without_a_place_for_checkpoints_trains_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    data = training_data(networks=2, frames=150, base=TRUE.repeat(2, 1))
    expected, _ = fit(data, monkeypatch, cut=True)
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    found, _ = fit(replace(data, workspace=Workspace(tmp_path / "gone")), monkeypatch, cut=True)
    assert_same(expected, found)
    assert "if this training is interrupted, it begins again" in caplog.text


def test_small_trainings_are_not_cut() -> None:
    learner = RolloutLearner(**SHORT)
    dataset = placed(training_data(networks=4), gru(), ensemble_size=2)
    assert networks_of_shards(learner.settings, dataset) == [slice(0, 8)]
    longer = learner.settings.model_copy(update={"epochs": 10_000, "horizon": 30})
    assert networks_of_shards(longer, dataset) == [slice(0, 4), slice(4, 8)]
    many = longer.model_copy(update={"draws": 200})
    assert networks_of_shards(many, dataset) == [
        slice(0, 2),
        slice(2, 4),
        slice(4, 6),
        slice(6, 8),
    ]


def test_shards_keep_two_cores_busy_to_the_end() -> None:
    assert [shard._even(6, count) for count in (2, 3, 4)] == [2, 6, 6]
    assert [shard._even(11, count) for count in (2, 4, 6)] == [2, 4, 6]
    assert [shard._even(count, 4) for count in (1, 3, 4)] == [1, 3, 4]


_SCRIPT = """
import torch
from cfx.learners.rollout import RolloutLearner, shard
from cfx.learners.rollout import module as training
from cfx.core.threads import limit_cores
from tests.learners.made import TRUE, gru, training_data
from tests.learners.rollout.test_shard import SHORT

shard._WORTH_A_PROCESS = 0
data = training_data(networks=2, base=TRUE.repeat(2, 1))
found = []
for cores in (1, 2):
    limit_cores(cores)
    found.append(RolloutLearner(**SHORT).fit(gru(), data).network.state_dict())
one, two = found
assert all(torch.equal(one[name], two[name]) for name in one)
print("the same bits")
"""


@pytest.mark.slow
def test_processes_give_the_same_bits_and_need_no_guard_in_a_script(tmp_path: Path) -> None:
    ran = run_script(_SCRIPT, tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "the same bits"
