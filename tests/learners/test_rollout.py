"""Learning through the simulation. Small drives, eager code: what is tested is what is learned from, not how fast."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from cfx.agents.agent import Agent
from cfx.agents.core import AgentCore
from cfx.agents.heads import HEADS, head_name
from cfx.agents.heads.offset import coordinates
from cfx.calibration.windows import Split, WindowSettings
from cfx.errors import ConfigError
from cfx.evaluation.closed_loop import ClosedLoop, simulate_closed_loop
from cfx.learners.base import TrainingData, TrainingResult
from cfx.learners.rollout import RolloutLearner, RolloutModule, RolloutSettings
from cfx.learners.rollout.dataset import BaseErrors, RolloutBatch, RolloutDataset, RolloutInputs
from cfx.learners.rollout.distillation import Expert, apart
from cfx.learners.rollout.step import WindowStep
from cfx.models.direct import Direct
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.pairs import PairBatch
from cfx.policies.base import Policy
from cfx.policies.driver_features import measure
from cfx.policies.ensemble import Ensemble
from cfx.policies.gru import GruPolicy
from cfx.policies.lstm import LstmPolicy
from cfx.simulation.rollout import MemoryStepper
from tests.drives import wavy_pairs

WINDOWS = WindowSettings()
INPUTS = ("leader_speed", "relative_speed", "gap")
QUICK: dict[str, Any] = {
    "ensemble_size": 1,
    "epochs": 6,
    "steps": 10,
    "learning_rate": 0.01,
    "horizon": 12,
    "compile": "never",
}
TRUE = torch.tensor(
    [[1.0, 0.1], [1.4, 0.3], [1.8, 0.5], [2.2, 0.0], [2.6, 0.2], [3.0, 0.4]]
).double()


def gru(**options: Any) -> Policy:
    return GruPolicy(inputs=INPUTS, hidden_size=12, **options)


def training_data(
    *, model: Any = None, networks: int = 2, frames: int = 260, **changes: Any
) -> TrainingData:
    """Six Krauss drivers; each network learns from all, starting from a set that fits none, with or without own bases."""
    driven = Krauss()
    model = model or driven
    pairs = wavy_pairs(driven, TRUE, frames=frames)
    batch = PairBatch.of(pairs)
    split = Split.none(pairs, WINDOWS)
    index = torch.arange(len(pairs)).repeat(networks)
    start = model.space.defaults().expand(len(index), -1).clone()
    if isinstance(model, Krauss):
        start[:] = torch.tensor([4.0, 0.8])
    return replace(
        TrainingData(
            MemoryStepper(model, 0.1),
            batch[index],
            split[index],
            WINDOWS,
            start,
            None,
            torch.arange(networks).repeat_interleave(len(pairs)),
            tuple(f"n{number}" for number in range(networks)),
            seed=0,
            drivers=tuple(pairs[int(number)].driver for number in index),
        ),
        **changes,
    )


def ready(training_result: TrainingResult, dataset: TrainingData, policy: Policy) -> Agent:
    model, names = dataset.simulator.model, dataset.names
    head = HEADS[head_name(has_base=training_result.base is not None)].for_model(model)
    return Agent(
        AgentCore(policy, training_result.network, training_result.scaler, head),
        {},
        {},
        WINDOWS,
        0.1,
        names,
        training_result.base,
    )


def loop(
    training_result: TrainingResult,
    dataset: TrainingData,
    policy: Policy,
    first: int = 0,
    **options: Any,
) -> ClosedLoop:
    frames = torch.full_like(dataset.network, first)
    return simulate_closed_loop(
        dataset.simulator,
        ready(training_result, dataset, policy),
        dataset.batch,
        frames,
        dataset.network,
        **options,
    )


def error(found: ClosedLoop, dataset: TrainingData, first: int = 0) -> float:
    real = dataset.batch.follower_speed[:, first:]
    return float((found.speed - real)[found.counted].square().mean().sqrt())


def untrained(dataset: TrainingData, policy: Policy) -> TrainingResult:
    still = RolloutLearner(
        **(QUICK | {"epochs": 1, "steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0})
    )
    return still.fit(policy, dataset)


def test_untrained_it_is_the_fixed_model() -> None:
    """With the population's base and with drivers' own, to the last bits."""
    policy, dataset = gru(), training_data(base=TRUE.repeat(2, 1))
    training_result = untrained(dataset, policy)
    for base, expected in ((None, dataset.fixed), (TRUE.repeat(2, 1), TRUE.repeat(2, 1))):
        found = loop(training_result, dataset, policy, first=100, base=base)
        torch.testing.assert_close(
            found.parameters, expected[:, None].expand_as(found.parameters), rtol=0, atol=1e-6
        )


def test_it_learns_to_drive_like_the_drivers() -> None:
    policy, dataset = gru(), training_data()
    before = error(loop(untrained(dataset, policy), dataset, policy), dataset)
    training_result = RolloutLearner(**(QUICK | {"cold_start_fraction": 0.0})).fit(policy, dataset)
    assert (
        error(loop(training_result, dataset, policy, first=100), dataset, first=100) < 0.5 * before
    )
    curves = training_result.curves.groupby("epoch")[["train_loss", "validation_loss"]].mean()
    assert curves.train_loss.iloc[-1] < 0.7 * curves.train_loss.iloc[0]
    assert curves.validation_loss.min() < 0.8 * curves.validation_loss.iloc[0]


@pytest.mark.parametrize(
    "driver_features", [(), ("time_headway", "acceleration")], ids=["", "driver_features"]
)
@pytest.mark.parametrize("model", [Krauss(), W99()], ids=["krauss", "w99"])
def test_training_simulates_what_evaluation_simulates(
    model: Any, driver_features: tuple[str, ...]
) -> None:
    """The training step's closed loop and `closed_loop.drive` give the same speeds, gaps and memory of what was read."""
    policy, dataset = gru(driver_features=driver_features), training_data(model=model, networks=1)
    training_result = RolloutLearner(**(QUICK | {"epochs": 1, "learning_rate": 0.05})).fit(
        policy, dataset
    )
    settings = RolloutSettings(**QUICK)
    held = RolloutDataset.of(dataset, policy, settings.validation, torch.Generator().manual_seed(0))
    held.scaler = training_result.scaler
    module = RolloutModule(training_result.network, held, policy, dataset, settings)
    place = torch.arange(6)[None]
    start, windows = torch.full_like(place, 40), 11
    if driver_features:  # training measures whole drives, evaluation what was before
        frame = torch.full_like(dataset.network, 200)
        held.driver_features = measure(
            dataset.batch, driver_features, 0.1, 0 * frame, frame
        ).float()
    drives = RolloutBatch(
        place, start, torch.zeros_like(place).bool(), held.last, torch.ones_like(place).float()
    )
    with torch.no_grad():
        speeds, gaps, *_ = next(
            module.stretches(module.exact, held.read(module.exact, drives), drives, windows)
        )
    found = loop(training_result, dataset, policy, first=200)
    torch.testing.assert_close(speeds[0].double(), found.speed[:, 1:56], rtol=0, atol=2e-3)
    torch.testing.assert_close(gaps[0].double(), found.gap[:, 1:56], rtol=0, atol=2e-3)


def test_networks_are_told_how_each_of_their_drivers_drives() -> None:
    """Of unseen drivers, and of those who were hardly measured, the mean of the others, which is no news once it is normalised."""
    dataset = training_data(networks=1, base=TRUE)
    dataset.split.frame[1] = 120
    policy, place = gru(driver_features=("time_gap", "time_headway")), torch.arange(6)[None]
    held = RolloutDataset.of(dataset, policy, 0.25, torch.Generator().manual_seed(0))
    cold_start = torch.tensor([[True, False, False, False, False, False]])
    told = held.of_drives(
        RolloutBatch(place, 0 * place, cold_start, held.last, torch.ones_like(place).float())
    )[2]
    frame = dataset.split.frame
    expected = measure(dataset.batch, policy.driver_features, 0.1, 0 * frame, frame).float()
    torch.testing.assert_close(told[0, 2:, 2:], expected[held.pair[0, 2:]])
    torch.testing.assert_close(told[0, :2, 2:], held.scaler.mean[:, -2:].expand(2, -1))
    torch.testing.assert_close(told[0, 1:, :2], coordinates(held.base)[0, 1:])
    learned_from = expected[held.pair[0, held.trains[0]]]
    known = learned_from[~learned_from.isnan().any(-1)]
    torch.testing.assert_close(held.scaler.mean[0, -2:], known.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        held.scaler.scale[0, -2:], known.std(0, correction=0), rtol=1e-4, atol=1e-5
    )


def test_who_is_told_how_drivers_differ_drives_more_like_each() -> None:
    """All from one base and without a look at their past, which is all the same to networks that are told nothing."""
    errors = []
    for driver_features in ((), ("time_headway", "time_gap")):
        policy, dataset = (
            GruPolicy(inputs=INPUTS, hidden_size=12, driver_features=driver_features),
            training_data(networks=1, frames=400),
        )
        options = QUICK | {
            "epochs": 20,
            "cold_start_fraction": 0.0,
            "burn_in_s": 0.5,
            "horizon": 20,
        }
        training_result = RolloutLearner(**options).fit(policy, dataset)
        errors.append(error(loop(training_result, dataset, policy, first=300), dataset, first=300))
    assert errors[1] < 0.9 * errors[0]


def test_reading_at_most_some_windows_forgets_what_was_before() -> None:
    """The state of one who began to read that many windows ago, in the same network; unseen drivers have read nothing."""
    policy, dataset = gru(), training_data(networks=1)
    generator = torch.Generator().manual_seed(0)
    held = RolloutDataset.of(dataset, policy, 0.25, generator)
    network = policy.build(
        held.scaler.mean.shape[-1], torch.full((2,), 0.5), torch.full((1, 2), 0.5), generator
    )
    step = RolloutModule(network, held, policy, dataset, RolloutSettings(**QUICK)).exact
    place, start = torch.arange(6)[None], torch.tensor([[2, 4, 5, 9, 12, 12]])
    cold_start = torch.tensor([[False, False, False, False, False, True]])
    drives = RolloutBatch(place, start, cold_start, held.last, torch.ones_like(place).float())
    with torch.no_grad():
        torch.testing.assert_close(
            held.read(step, drives, 100), held.read(step, drives), rtol=0, atol=0
        )
        short = held.read(step, drives, 5)
        for number, first in enumerate(start[0, :5].tolist()):
            state = network.initial_state(1, 6)
            for window in range(max(0, first - 5), first):
                state = step.read(
                    held.tokens[:, window][held.pair],
                    coordinates(held.base),
                    state,
                    ~cold_start | True,
                )
            torch.testing.assert_close(short[0, number], state[0, number])
        assert not bool(short[0, 5].any())
        assert not torch.allclose(short[0, 4], held.read(step, drives)[0, 4], atol=1e-6)


def test_training_goes_on_where_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, whole = gru(dropout=0.1), training_data(workspace=tmp_path / "full_trajectory")
    learner = RolloutLearner(**(QUICK | {"ensemble_size": 2, "steps": 4}))
    expected = learner.fit(policy, whole)
    broken = replace(whole, workspace=tmp_path / "broken")
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
    assert epochs == [
        1,
        2,
        3,
        3,
        4,
        5,
        6,
    ]  # the broken epoch is done again, those before it are not
    pd.testing.assert_frame_equal(again.curves, expected.curves)
    assert all(
        torch.equal(a, b)
        for a, b in zip(again.network.parameters(), expected.network.parameters(), strict=True)
    )
    assert not list(tmp_path.glob("*/*"))  # nothing is kept of a training that ended


def test_neither_teachers_nor_their_pupils_train_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, whole = gru(), training_data(networks=1, workspace=tmp_path / "full_trajectory")
    learner = RolloutLearner(**(QUICK | {"epochs": 4, "distillation_epochs": 2, "steps": 4}))
    expected = learner.fit(policy, whole)
    broken = replace(whole, workspace=tmp_path / "broken")
    judge, epochs = RolloutModule.judge, []

    def interrupt(self: RolloutModule, *losses: torch.Tensor, **options: bool) -> None:
        judge(self, *losses, **options)
        epochs.append(("pupil" if self.expert else "teacher", len(self.rows)))
        if len(epochs) in {2, 5}:
            raise KeyboardInterrupt

    monkeypatch.setattr(RolloutModule, "judge", interrupt)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            learner.fit(policy, broken)
    again = learner.fit(policy, broken)
    assert epochs[:4] == [("teacher", 1), ("teacher", 2), ("teacher", 2), ("pupil", 1)]
    assert epochs[4:] == [("pupil", 2), ("pupil", 2), ("pupil", 3), ("pupil", 4)]
    pd.testing.assert_frame_equal(again.curves, expected.curves)
    assert all(
        torch.equal(a, b)
        for a, b in zip(again.network.parameters(), expected.network.parameters(), strict=True)
    )
    assert not list(tmp_path.glob("*/*"))


def test_a_checkpoint_of_another_training_is_not_taken_up(tmp_path: Path) -> None:
    policy, learner = gru(), RolloutLearner(**QUICK)
    one, other = training_data(workspace=tmp_path), training_data(workspace=tmp_path, seed=1)
    assert learner.checkpoint(policy, one) != learner.checkpoint(policy, other)
    assert learner.checkpoint(policy, one) != RolloutLearner(**(QUICK | {"steps": 16})).checkpoint(
        policy, one
    )
    assert learner.checkpoint(policy, one) == learner.checkpoint(
        policy, training_data(workspace=tmp_path)
    )


def test_validation_drivers_teach_nothing() -> None:
    """What a held-out driver does changes the validation loss, and no weight."""
    policy, settings = gru(), QUICK | {"epochs": 2, "steps": 5, "patience": None}
    dataset = training_data(networks=1)
    placed = RolloutDataset.of(dataset, policy, 0.25, torch.Generator().manual_seed(dataset.seed))
    held = placed.validates[0]
    assert 0 < int(held.sum()) < 6
    assert not bool((placed.trains & placed.validates).any())
    shifted = torch.where(
        held[:, None], dataset.batch.follower_speed + 1.0, dataset.batch.follower_speed
    )
    other = replace(dataset, batch=replace(dataset.batch, follower_speed=shifted))
    one, two = (RolloutLearner(**settings).fit(policy, which) for which in (dataset, other))
    assert one.curves.train_loss.tolist() == two.curves.train_loss.tolist()
    assert one.curves.validation_loss.tolist() != two.curves.validation_loss.tolist()


def module_of(dataset: TrainingData, **options: Any) -> RolloutModule:
    policy, settings = gru(), RolloutSettings(**(QUICK | options))
    generator = torch.Generator().manual_seed(0)
    held = RolloutDataset.of(
        dataset, policy, settings.validation, generator, settings.ensemble_size
    )
    blank = torch.full((len(held.pair), 2), 0.5)
    network = policy.build(held.scaler.mean.shape[-1], blank[0], blank, generator)
    with torch.no_grad():
        network.get_parameter("w_out").uniform_(
            -1.0, 1.0, generator=generator
        )  # so that it does something
    return RolloutModule(network, held, policy, dataset, settings)


@pytest.mark.parametrize("cold_start_fraction", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("second", ["aabcde", "aabbcc"], ids=["enough drivers", "few drivers"])
def test_the_validation_loss_is_the_mean_over_validation_drivers(
    cold_start_fraction: float, second: str
) -> None:
    """Each driven on his own: known, from fifths of what is validated on; as an unseen driver, whole, unless its end alone is kept."""
    dataset = training_data(base=TRUE.repeat(2, 1) * 1.3, drivers=tuple("abcdef" + second))
    module = module_of(dataset, validation=0.3, cold_start_fraction=cold_start_fraction)
    held, expected = module.dataset, torch.zeros(2)
    counts = held.validates.sum(1).tolist()
    assert counts[0] != counts[1]
    assert module.errors is not None
    one, no = torch.ones(2, 1), torch.zeros(2, 1).bool()
    with torch.no_grad():
        for network, count in enumerate(counts):
            for place in held.validates[network].nonzero()[:, 0].tolist():
                until, last = int(held.until[network, place]), int(held.last[network, place])
                began, here, end = (
                    (until if until < last else 0),
                    torch.full((2, 1), place),
                    torch.full((2, 1), last),
                )
                share = cold_start_fraction if began == 0 else 0.0
                for fifth in (0.2, 0.4, 0.6, 0.8):
                    known = RolloutBatch(
                        here, ((began + fifth * (end - began)) / 5).long(), no, end, one
                    )
                    (loss,) = module.drive(
                        module.exact,
                        held.read(module.exact, known),
                        known,
                        12,
                        module.errors.over_horizon(known),
                    )
                    expected[network] += (1 - share) * loss[network, 0] / (4 * count)
                whole = RolloutBatch(here, end * 0, ~no, end, one)
                (loss,) = module.drive(
                    module.exact,
                    held.read(module.exact, whole),
                    whole,
                    52,
                    module.errors.over_whole(whole),
                )
                expected[network] += share * loss[network, 0] / count
        torch.testing.assert_close(module._validation_loss(), expected, rtol=1e-4, atol=1e-5)


def test_of_many_drivers_some_drive_in_each_step() -> None:
    """Others in each step, all of whom are learned from; and some are validated, the same ones always."""
    dataset = training_data(base=TRUE.repeat(2, 1))
    module = module_of(dataset, drivers=2, draws=3, validation=0.5)
    drawn = [module._draw(step) for step in range(12)]
    assert all(drives.place.shape == (2, 6) for drives in drawn)
    assert all(bool((drives.weight == 1).all()) for drives in drawn)
    for network in range(2):
        seen = {place for drives in drawn for place in drives.place[network].tolist()}
        assert seen == set(module.dataset.trains[network].nonzero()[:, 0].tolist())
        assert len(set(module.validated[network].tolist())) == 2
        assert bool(module.dataset.validates[network, module.validated[network]].all())
    assert torch.equal(module._draw(3).place, drawn[3].place)
    everybody = module_of(dataset, drivers=6, draws=1, validation=0.5)._draw(0)
    assert everybody.place.tolist() == [
        row.nonzero()[:, 0].tolist() for row in module.dataset.trains
    ]
    assert bool((everybody.weight == 1).all())


def test_drives_without_weight_are_not_simulated() -> None:
    """Unless another network has more with weight; what the others learn from is what it would be beside them."""
    module = module_of(
        training_data(base=TRUE.repeat(2, 1), drivers=tuple("abcdefaabcde")), validation=0.3
    )
    counts = module.dataset.trains.sum(1).tolist()
    assert counts[0] != counts[1]
    drives = module._draw(7)
    assert drives.place.shape == (2, max(counts) * module.settings.draws)
    assert (drives.weight.sum(1) / module.settings.draws).tolist() == counts
    assert drives.scale is not None
    weight = torch.tensor([[1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    made = RolloutBatch(
        *(torch.arange(8.0).view(2, 4) + 10 * k for k in range(4)), weight=weight
    ).weighed()
    assert made.weight.tolist() == [[1.0, 1.0], [0.0, 1.0]]
    assert made.place.tolist() == [[0.0, 2.0], [4.0, 6.0]]
    assert made.last.tolist() == [[30.0, 32.0], [34.0, 36.0]]
    assert made.scale is None


def test_members_of_a_committee_keep_other_drivers_for_validation_and_read_alike() -> None:
    dataset = training_data()
    placed = RolloutDataset.of(
        dataset, gru(), 0.34, torch.Generator().manual_seed(0), ensemble_size=5
    )
    assert len({tuple(row) for row in placed.validates[:5].tolist()}) > 1
    assert placed.pair[:5].tolist() == [list(range(6))] * 5
    assert placed.pair[5:].tolist() == [list(range(6, 12))] * 5
    for number in (0, 5):
        torch.testing.assert_close(
            placed.scaler.mean[number : number + 5],
            placed.scaler.mean[number].expand(5, -1),
            rtol=0,
            atol=0,
        )
    errors = BaseErrors.of(dataset, placed, 12)
    assert errors.familiar.shape[0] == errors.whole.shape[0] == 10


def test_a_committee_learns_and_drives_as_one() -> None:
    """Members learn different things; to whoever drives it is one network, with one learning curve."""
    policy, dataset = gru(), training_data()
    training_result = RolloutLearner(**(QUICK | {"ensemble_size": 3})).fit(policy, dataset)
    assert isinstance(training_result.network, Ensemble)
    assert training_result.curves.network.tolist() == ["n0", "n1"] * 6
    assert training_result.scaler.mean.shape[0] == len(dataset.names)
    for weights in training_result.network.members.parameters():
        assert not any(torch.equal(weights[0], weights[number]) for number in (1, 2))
    before = error(loop(untrained(dataset, policy), dataset, policy, first=100), dataset, first=100)
    assert (
        error(loop(training_result, dataset, policy, first=100), dataset, first=100) < 0.8 * before
    )


def test_a_network_of_few_drivers_holds_out_the_end_of_their_drives() -> None:
    dataset = training_data(networks=1)
    few = replace(
        dataset,
        batch=dataset.batch[:2],
        split=dataset.split[torch.arange(2)],
        fixed=dataset.fixed[:2],
    )
    few = replace(few, network=dataset.network[:2], drivers=("a", "b"))
    placed = RolloutDataset.of(few, gru(), 0.25, torch.Generator().manual_seed(0))
    assert bool((placed.trains & placed.validates).all())
    assert placed.until.tolist() == [[int(0.75 * 259)] * 2]


def test_one_driver_is_never_on_both_sides() -> None:
    names = ("a", "a", "b", "c", "d", "e") * 2
    placed = RolloutDataset.of(
        training_data(drivers=names), gru(), 0.4, torch.Generator().manual_seed(3)
    )
    for row in placed.validates.tolist():
        held = {name for name, chosen in zip(names[:6], row, strict=True) if chosen}
        kept = {name for name, chosen in zip(names[:6], row, strict=True) if not chosen}
        assert held
        assert not held & kept


def test_errors_of_the_base_are_those_of_plain_drives() -> None:
    dataset = training_data(networks=1, base=TRUE)
    placed = RolloutDataset.of(dataset, gru(), 0.0, torch.Generator().manual_seed(0))
    errors = BaseErrors.of(dataset, placed, 12)
    assert (
        float(errors.familiar[..., :30, 0].max()) < 1e-3
    )  # the true parameters drive as the drivers did
    fixed = untrained(replace(dataset, base=None), gru())
    found = loop(fixed, dataset, gru())
    real = (found.speed - dataset.batch.follower_speed).square()[:, 1:]
    torch.testing.assert_close(
        errors.whole[0, :, 0].double(), real.mean(1).sqrt(), rtol=1e-3, atol=1e-3
    )
    torch.testing.assert_close(
        errors.strange[0, :, 0, 0].double(), real[:, :60].mean(1).sqrt(), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize(
    "options",
    [
        {"error": "huber"},
        {"normalise": False},
        {"tbptt_windows": 4},
        {"drivers": 3},
        {"gradient_clip": None, "patience": None},
        {"validation": 0.0},
        {"cold_start_fraction": 1.0},
        {"temperature": 0.0},
        {"distillation_epochs": 1},
    ],
    ids=lambda options: next(iter(options)),
)
def test_every_option_trains(options: dict[str, Any]) -> None:
    policy, dataset = gru(), training_data(base=TRUE.repeat(2, 1) * 1.3)
    training_result = RolloutLearner(**(QUICK | {"epochs": 3, "steps": 8} | options)).fit(
        policy, dataset
    )
    curve = training_result.curves.groupby("epoch").train_loss.mean()
    assert curve.iloc[-1] < curve.iloc[0]
    assert bool(training_result.curves.validation_loss.isna().all()) == (
        options.get("validation") == 0.0
    )


def test_w99_learns_through_its_smoothed_regimes_and_drives_exactly() -> None:
    """Its exact thresholds have no gradient: smoothed they have one, and the exact model drives better for it."""
    policy, dataset = (
        LstmPolicy(inputs=INPUTS, hidden_size=12),
        training_data(model=W99(), networks=1),
    )
    before = error(loop(untrained(dataset, policy), dataset, policy, first=50), dataset, first=50)
    training_result = RolloutLearner(**(QUICK | {"epochs": 4, "steps": 8, "patience": None})).fit(
        policy, dataset
    )
    assert error(loop(training_result, dataset, policy, first=50), dataset, first=50) < 0.9 * before
    assert dataset.simulator.model.temperature == 0


def test_compiled_training_is_eager_training() -> None:
    policy, dataset = gru(), training_data(networks=1)
    curves = [
        RolloutLearner(**(QUICK | {"epochs": 2, "steps": 3, "compile": how}))
        .fit(policy, dataset)
        .curves
        for how in ("never", "always")
    ]
    pd.testing.assert_frame_equal(*curves, rtol=1e-3)


def test_a_simulator_without_gradients_is_refused() -> None:
    class Blind(MemoryStepper):
        differentiable = False

    dataset = training_data(networks=1)
    with pytest.raises(
        ConfigError,
        match=r"this learner needs gradients, and the simulator has none; choose .* learner=imitation",
    ):
        RolloutLearner(**QUICK).fit(gru(), replace(dataset, simulator=Blind(Krauss(), 0.1)))


def test_a_model_without_gradients_is_refused() -> None:
    class Stepwise(Krauss):
        differentiable = False

    with pytest.raises(ConfigError, match="the driving model has none"):
        RolloutLearner(**QUICK).fit(gru(), training_data(networks=1, model=Stepwise()))


def taught_module(dataset: TrainingData, **options: Any) -> RolloutModule:
    """A module whose untrained networks are taught by others, untrained as well, that answer at random."""
    module = module_of(dataset, **options)
    steered = module.dataset.driven_from(torch.tensor([0.6]))
    generator = torch.Generator().manual_seed(1)
    blank = torch.full((len(steered.pair), 1), 0.5)
    network = (
        gru(start="middle")
        .build(steered.scaler.mean.shape[-1], blank[0], blank, generator)
        .requires_grad_(False)
    )
    module.expert = Expert(
        WindowStep(network, steered.scaler, gru(), Direct(), WINDOWS, 0.1), steered
    )
    return module


def test_a_teacher_says_what_he_would_do_where_the_pupil_stands() -> None:
    """Beside a drive of his own he says exactly what he drives, from the same memory of what was read; elsewhere he does not."""
    dataset = training_data(networks=1)
    module = taught_module(dataset)
    assert module.expert is not None
    step, known, place = module.expert.step, module.expert.dataset, torch.arange(6)[None]
    cold_start = torch.tensor([[False, False, False, True, True, True]])
    start = torch.where(cold_start, 0, 15)
    drives = RolloutBatch(place, start, cold_start, known.last, torch.ones_like(place).float())
    with torch.no_grad():
        pair, base, _ = known.of_drives(drives)
        scene = RolloutInputs.of(known.batch, pair, drives, step, 8)
        own = scene.recent(known.read(step, drives))
        watching = module.expert.watch(drives, scene.leader_length, None)
        for window in range(8):
            wanted = watching.would_drive(own, scene.ahead(window))
            own, speed, _ = step.drive(
                own, scene.ahead(window), scene.leader_length, base, coordinates(base)
            )
            torch.testing.assert_close(wanted, speed, rtol=0, atol=1e-6)
        elsewhere = own._replace(speed=own.speed + 1.0)
        assert not torch.allclose(watching.would_drive(elsewhere, scene.ahead(7)), speed, atol=0.1)


def test_who_is_taught_learns_from_each_window_alone() -> None:
    """The loss reported is the drive's, the gradient is not: it comes from what the teacher would have done, window by window."""
    dataset = training_data(networks=1)
    distillation_epochs, alone = (
        make(dataset, distillation_epochs=1, cold_start_fraction=0.0)
        for make in (taught_module, module_of)
    )
    gradients, losses = [], []
    for module in (distillation_epochs, alone):
        loss = next(module.losses_of(0))
        loss.sum().backward()
        losses.append(loss.detach())
        gradients.append(module.network.b_out.grad)
    torch.testing.assert_close(losses[0], losses[1])
    assert not torch.allclose(gradients[0], gradients[1], rtol=0.1)
    drives = distillation_epochs._draw(0)
    state = distillation_epochs.dataset.read(distillation_epochs.step, drives)
    pair, *_ = distillation_epochs.dataset.of_drives(drives)
    recent = RolloutInputs.of(
        distillation_epochs.dataset.batch, pair, drives, distillation_epochs.step, 1
    ).recent(state)
    assert not any(value.grad_fn for value in apart(recent)[:4])


def test_nothing_is_taught_beyond_the_training_part() -> None:
    """Drives may end behind it, where nothing counts: not what was measured there, nor what a teacher would do."""
    gradients = []
    for beyond in (0.0, 5.0):
        module = taught_module(
            training_data(networks=1), distillation_epochs=1, cold_start_fraction=0.0
        )
        dataset = module.dataset
        ends = dataset.last - 100
        dataset.last, dataset.until = ends, ends
        frames = torch.arange(dataset.batch.mask.shape[1])
        secret = frames > ends[0, dataset.pair[0].argsort()][:, None]
        changed = {
            name: getattr(dataset.batch, name) + beyond * secret
            for name in ("leader_speed", "leader_position")
        }
        dataset.batch = replace(dataset.batch, **changed)
        assert bool(
            (module._draw(0).start * WINDOWS.stride + 60 > ends[:, :1]).any()
        )  # some drives do
        next(module.losses_of(0)).sum().backward()
        gradients.append(module.network.w_out.grad)
    assert torch.equal(*gradients)


def test_patience_begins_when_the_teacher_has_gone() -> None:
    policy, dataset = gru(), training_data(networks=1)
    options = QUICK | {
        "epochs": 8,
        "distillation_epochs": 4,
        "steps": 1,
        "learning_rate": 1e-12,
        "weight_decay": 0.0,
        "patience": 2,
    }
    curves = RolloutLearner(**options).fit(policy, dataset).curves
    assert (
        curves.epoch.max() + 1 == 6
    )  # nothing gets better: four are taught, and two are waited for


def test_what_was_taught_drives_better_than_it_began() -> None:
    """The validation loss is of the pupil's own drives, while all that he learns is what his teacher would do."""
    policy, dataset = gru(), training_data(networks=1)
    began = untrained(dataset, policy).curves.validation_loss.iloc[0]
    options = QUICK | {
        "epochs": 12,
        "distillation_epochs": 6,
        "cold_start_fraction": 0.0,
        "patience": None,
    }
    curves = RolloutLearner(**options).fit(policy, dataset).curves
    assert curves.validation_loss[curves.epoch == 5].item() < 0.7 * began


def test_somebody_must_drive_in_the_end() -> None:
    with pytest.raises(
        ConfigError,
        match=r"learner.*taught=6 leaves none of epochs=6 to learn by driving; lower learner.distillation_epochs",
    ):
        RolloutLearner(**(QUICK | {"distillation_epochs": 6}))
