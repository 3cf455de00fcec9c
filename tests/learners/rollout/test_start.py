"""Networks that begin as those of a finished job."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from cfx.errors import ConfigError, DataError
from cfx.learners.base import TrainingResult
from cfx.learners.rollout import RolloutLearner
from cfx.models.w99 import W99
from cfx.policies.checkpoint import save_agent
from cfx.policies.core import ANY_DRIVER
from cfx.simulation.windows import WindowSettings
from tests.learners.made import COMPILED, QUICK, gru, loop, ready, training_data

STILL = QUICK | {"epochs": 1, "steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0}


def learned(folder: Path, ensemble_size: int = 2) -> TrainingResult:
    """Trains one network on the drivers and saves it as a job does."""
    data = training_data(networks=1)
    options = COMPILED | {"epochs": 3, "steps": 6, "ensemble_size": ensemble_size}
    result = RolloutLearner(**options).fit(gru(), data)
    agent = ready(result, data, gru())
    node = {"name": "krauss"}
    save_agent(
        replace(agent, names=(ANY_DRIVER,), model_node=node, policy_node=node_of_policy()), folder
    )
    return result


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainingResult]:
    """A finished job with an ensemble of one: its folder and what it learned."""
    folder = tmp_path_factory.mktemp("one")
    return folder, learned(folder / "policy", ensemble_size=1)


def node_of_policy() -> dict[str, Any]:
    return {"name": "gru", **gru().settings.model_dump()}


def test_without_a_step_they_drive_as_that_policy_does(tmp_path: Path) -> None:
    result, data = learned(tmp_path / "policy"), training_data(networks=1)
    options = STILL | {"ensemble_size": 2, "start": str(tmp_path)}
    found = RolloutLearner(**options).fit(gru(), data)
    before, after = (loop(one, data, gru()).speed for one in (result, found))
    torch.testing.assert_close(after, before, rtol=0, atol=1e-4)
    untrained = RolloutLearner(**(STILL | {"ensemble_size": 2})).fit(gru(), data)
    assert (loop(untrained, data, gru()).speed - before).abs().max() > 0.1


def test_each_network_of_a_training_begins_so_and_knows_what_that_one_had_seen(
    one: tuple[Path, TrainingResult],
) -> None:
    folder, result = one
    data = training_data(networks=2)
    options = STILL | {"start": f"{folder}#all"}
    found = RolloutLearner(**options).fit(gru(), data)
    for name, value in found.network.state_dict().items():
        for network in value:
            torch.testing.assert_close(network, result.network.state_dict()[name][0])
    assert found.valid_range is not None
    assert result.valid_range is not None
    assert bool((found.valid_range.low <= result.valid_range.low).all())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"windows": WindowSettings(length=8)}, "its windows is"),
        ({"model": W99()}, "its model is krauss"),
        ({"head": "residual"}, "its learner.head is offset"),
    ],
)
def test_a_policy_of_another_kind_is_refused(
    one: tuple[Path, TrainingResult], changes: dict[str, Any], message: str
) -> None:
    head = changes.pop("head", "offset")
    with pytest.raises(ConfigError, match=message):
        RolloutLearner(**STILL, start=str(one[0]), head=head).fit(
            gru(), training_data(networks=1, **changes)
        )


def test_another_ensemble_and_a_missing_network_are_refused(
    one: tuple[Path, TrainingResult],
) -> None:
    folder, data = one[0], training_data(networks=1)
    with pytest.raises(ConfigError, match=r"set learner\.ensemble_size=1"):
        RolloutLearner(**(STILL | {"ensemble_size": 2}), start=str(folder)).fit(gru(), data)
    with pytest.raises(DataError, match="it has no network 'fold 7', but all"):
        RolloutLearner(**STILL, start=f"{folder}#fold 7").fit(gru(), data)
