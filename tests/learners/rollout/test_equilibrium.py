"""The gap at which drivers settle, in training."""

from __future__ import annotations

import pytest
import torch

from cfx.data.pairs import PairBatch, PairSet
from cfx.data.steady import VEHICLE_M
from cfx.errors import ConfigError
from cfx.evaluation.traffic import settled_gaps
from cfx.learners.base import TrainingData, TrainingPairs
from cfx.learners.rollout import RolloutLearner
from cfx.learners.rollout.equilibrium import EquilibriumTargets, SteadySampler
from cfx.models.idm import IDM
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split
from tests.data.test_steady import steady
from tests.learners.made import COMPILED, WINDOWS, gru, placed, ready, training_data

SPEEDS, HEADWAY, STANDING = (4.0, 8.0, 11.0, 14.0), 1.0, 2.0
STYLES = (0.7, 1.0, 1.3)


def recorded() -> TrainingData:
    """Drivers at constant speeds, whose spacing is 0.7 to 1.3 times that of a gap of 2 m + 1 s."""
    pairs, drivers = [], []
    for number, style in enumerate(STYLES):
        for speed in SPEEDS:
            usual = STANDING + HEADWAY * speed + VEHICLE_M
            gap = style * usual - VEHICLE_M
            pairs.append(steady(f"d{number} at {speed}", speed, gap))
            drivers.append(f"d{number}")
    pair_set, count = PairSet(tuple(pairs), "test"), len(pairs)
    model = IDM()
    return TrainingData(
        stepper=MemoryStepper(model, 0.1),
        recorded=PairBatch.of(pair_set),
        pairs=TrainingPairs(
            index=torch.arange(count),
            split=Split.none(pair_set, WINDOWS),
            network=torch.zeros(count, dtype=torch.int64),
            start=model.space.defaults().expand(count, -1).clone(),
            drivers=tuple(drivers),
        ),
        windows=WINDOWS,
        names=("all",),
        seed=0,
    )


def test_targets_are_the_recorded_relation_and_each_drivers_share_of_it() -> None:
    data = recorded()
    targets = EquilibriumTargets.of(data, placed(data, gru(), share=0.0))
    speed = torch.tensor([[4.0, 6.0, 14.0, 20.0]])
    usual = STANDING + HEADWAY * speed
    torch.testing.assert_close(targets.at(speed)[:, :3], usual[:, :3], rtol=0, atol=0.01)
    assert bool(targets.at(speed)[0, 3].isnan())
    styles = torch.tensor(STYLES).repeat_interleave(len(SPEEDS))
    torch.testing.assert_close(targets.ratio[0], styles, rtol=0, atol=1e-3)
    shares = torch.tensor([[0.0, 1.0]])
    assert targets.speeds(shares).tolist() == [[4.0, 14.0]]


def test_trajectories_begin_anywhere_behind_a_leader_of_constant_speed() -> None:
    """Those with known features are to keep their own driver's gap, the others the mean one."""
    data = recorded()
    policy = gru(driver_features="all")
    dataset = placed(data, policy, share=0.0)
    targets = EquilibriumTargets.of(data, dataset)
    sampler = SteadySampler(dataset, targets, 20.0, WINDOWS.stride, WINDOWS.length)
    found = sampler.training(torch.Generator().manual_seed(0))
    pairs = found.dataset.recordings.batch
    begin = (pairs.gap[:, 0] - 2.0) / pairs.leader_speed[:, 0]
    assert float(begin.min()) >= 0.6 - 1e-4
    assert float(begin.max()) <= 3.0 + 1e-4
    assert float(begin.std()) > 0.3
    assert bool((pairs.leader_speed == pairs.leader_speed[:, :1]).all())
    usual = targets.at(pairs.leader_speed[:, 0].view(1, -1))
    ratio = (found.target + VEHICLE_M) / (usual + VEHICLE_M)
    torch.testing.assert_close(ratio[found.batch.cold_start], torch.ones(8), rtol=0, atol=1e-5)
    own = ratio[~found.batch.cold_start]
    for value in own.tolist():
        assert min(abs(value - style) for style in STYLES) < 1e-3
    assert float(own.std()) > 0.05


def test_training_gives_drivers_one_equilibrium() -> None:
    """Constants of IDM settle at 1.5 s; the recorded drivers keep 1 s, and so does the policy."""
    data, policy = recorded(), gru()
    options = COMPILED | {
        "epochs": 3,
        "steps": 20,
        "learning_rate": 0.02,
        "validation": 0.0,
        "equilibrium_s": 40.0,
        "horizon": 4,
        "cold_start_fraction": 1.0,
    }
    speed = torch.tensor([5.0, 12.0]).double().repeat(2)
    start = torch.tensor([1.0, 2.5]).double().repeat_interleave(2)
    result = RolloutLearner(**(options | {"equilibrium_weight": 1.0})).fit(policy, data)
    gaps = settled_gaps(ready(result, data, policy), data.stepper.model, speed, start)
    torch.testing.assert_close(gaps[:2], gaps[2:], rtol=0.1, atol=0.1)
    spacing = STANDING + HEADWAY * speed + VEHICLE_M
    of_constants = 2.0 + 1.5 * speed + VEHICLE_M  # IDM's, far below its desired speed
    error = (gaps + VEHICLE_M).log() - spacing.log()
    assert float(error.abs().max()) < 0.6 * float((of_constants / spacing).log().max())


def test_drivers_who_never_settle_teach_no_gap() -> None:
    with pytest.raises(ConfigError, match="equilibrium_weight"):
        RolloutLearner(**(COMPILED | {"equilibrium_weight": 1.0})).fit(gru(), training_data())
