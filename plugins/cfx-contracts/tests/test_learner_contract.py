"""Each statement of the contract fails for a learner that breaks it, and says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pandas as pd
import pytest
import torch
from torch import Tensor

from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import Scaler, tokens
from cfx.policies.history import measured_history
from cfx.policies.inputs import policy_inputs
from cfx_contracts import learners as checks

EPOCHS = 12


class Plain(Learner):
    """Learns labels by a plain loop, with a method for each part that a subclass spoils."""

    needs_labels = True

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        torch_seed = torch.Generator().manual_seed(self.seed(training_data))
        windows = training_data.pairs.labels.windows
        history = measured_history(
            training_data.batch,
            windows.pair,
            windows.first + self.ahead,
            training_data.windows.length,
        )
        seen, mask = windows.to_grid(
            tokens(history, policy_inputs(policy.inputs), policy.summary).float(),
            len(training_data.batch),
        )
        space = training_data.stepper.model.space
        wanted, _ = windows.to_grid(
            space.to_unit(training_data.pairs.labels.parameters).float(), len(training_data.batch)
        )
        network_of, names = training_data.pairs.network, training_data.names
        grid, mask, wanted = (self.arrange(x, network_of, len(names)) for x in (seen, mask, wanted))
        scaler = self.scaler(grid, mask)
        start = space.to_unit(training_data.pairs.start).float()
        first = torch.stack([start[network_of == k].mean(0) for k in range(len(names))])
        network = policy.build(grid.shape[-1], first[0], first, torch_seed)
        rows = self.train(network, scaler(grid), wanted, mask)
        return self.finish(
            TrainingResult(network.eval(), scaler, self.curves(rows, names)), training_data
        )

    ahead = 0

    def seed(self, training_data: TrainingData) -> int:
        return training_data.seed

    @staticmethod
    def arrange(values: Tensor, network: Tensor, networks: int) -> Tensor:
        return torch.stack([values[network == k] for k in range(networks)])

    def scaler(self, grid: Tensor, mask: Tensor) -> Scaler:
        return Scaler.of(grid, mask)

    def train(
        self, network: PolicyNetwork, seen: Tensor, wanted: Tensor, mask: Tensor
    ) -> list[Tensor]:
        adam = torch.optim.Adam(network.parameters(), lr=0.1)
        rows = []
        for _ in range(EPOCHS):
            out, _ = network(seen, network.initial_state(*seen.shape[:2]))
            loss = ((out - wanted).square().mean(-1) * mask).sum((1, 2)) / mask.sum((1, 2))
            adam.zero_grad()
            loss.sum().backward()
            adam.step()
            rows.append(loss.detach())
        return rows

    def curves(self, rows: list[Tensor], names: tuple[str, ...]) -> pd.DataFrame:
        table = []
        for epoch, row in enumerate(rows):
            for k, name in enumerate(names):
                table.append((name, epoch, float(row[k]), float("nan")))
        return pd.DataFrame(table, columns=CURVE_COLUMNS)

    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        return training_result


class Lazy(Plain):
    def train(self, network: PolicyNetwork, *rest: Any) -> list[Tensor]:
        return [torch.zeros(3)]


class Seedless(Plain):
    def seed(self, training_data: TrainingData) -> int:
        return 0


class Global(Plain):
    def seed(self, training_data: TrainingData) -> int:
        return int(torch.randint(0, 1000, ()))


class Seeding(Plain):
    def seed(self, training_data: TrainingData) -> int:
        torch.manual_seed(training_data.seed)
        return training_data.seed


class Ahead(Plain):
    """Reads the frames that a window ends with: the last window's lie behind the training part."""

    ahead = 6


class Together(Plain):
    """Scales all networks' tokens alike."""

    def scaler(self, grid: Tensor, mask: Tensor) -> Scaler:
        own = Scaler.of(grid, mask)
        return Scaler(own.mean.mean(0).expand_as(own.mean).clone(), own.scale)


class Training(Plain):
    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        training_result.network.train()
        return training_result


class Baseless(Plain):
    """Answers offsets, and does not say from what."""

    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        return replace(training_result, head="offset")


class Undone(Plain):
    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        for value in training_result.network.parameters():
            value.data.fill_(torch.nan)
        return training_result


class Separate(Plain):
    """Makes a network for each pair, whatever the training data wants."""

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        pairs = replace(training_data.pairs, network=torch.arange(3))
        return super().fit(policy, replace(training_data, pairs=pairs, names=("a", "b", "c")))


class Meddling(Plain):
    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        training_data.pairs.start.mul_(1.01)
        return training_result


class Renaming(Plain):
    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        return replace(
            training_result, curves=training_result.curves.rename(columns={"train_loss": "loss"})
        )


class Skipping(Plain):
    def finish(
        self, training_result: TrainingResult, training_data: TrainingData
    ) -> TrainingResult:
        return replace(
            training_result, curves=training_result.curves[training_result.curves.epoch % 2 == 0]
        )


READY = checks.delivers_networks_that_are_ready_to_drive
BROKEN: dict[str, tuple[Learner, Any, str]] = {
    "separate": (Separate(), READY, "how many there are"),
    "training": (Training(), READY, "evaluation mode"),
    "baseless": (Baseless(), READY, "`base` and `head` of the result disagree"),
    "undone": (Undone(), READY, "nothing outside the model's bounds"),
    "lazy": (Lazy(), checks.learns_something, "at least 30 % nearer"),
    "global": (
        Global(),
        checks.the_same_seed_gives_the_same_networks,
        "must not be drawn from|from `seed` of the training data",
    ),
    "seeding": (Seeding(), checks.the_same_seed_gives_the_same_networks, "must not be drawn from"),
    "seedless": (
        Seedless(),
        checks.another_seed_gives_other_networks,
        "must reach the initial weights",
    ),
    "ahead": (Ahead(), checks.reads_no_frame_after_the_training_part, "prove nothing"),
    "together": (Together(), checks.networks_are_independent, "drivers of another network"),
    "meddling": (Meddling(), checks.the_training_data_stays_as_it_is, "not be changed in place"),
    "renaming": (Renaming(), checks.curves_tell_how_it_went, "figures and MLflow read them"),
    "skipping": (Skipping(), checks.curves_tell_how_it_went, "counted 0, 1, 2"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    with pytest.raises(AssertionError, match=sentence):
        check(component)


def test_every_statement_has_a_learner_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


SOUND = Plain()


@pytest.mark.parametrize("check", checks.CONTRACT.checks)
def test_a_sound_learner_holds_it(check: Any) -> None:
    check(SOUND)
