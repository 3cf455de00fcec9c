"""Cold starts on faster roads: accelerations stay human, and the gap is one of the driver's own."""

from __future__ import annotations

from dataclasses import replace

import torch

from cfx.data.pairs import PairBatch
from cfx.learners.rollout.dataset import RolloutBatch, usual_time_gaps
from cfx.learners.rollout.sampling import augmentation
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.rollout.window import RolloutInputs
from cfx.models.krauss import Krauss
from cfx.policies.gru import GruPolicy
from tests.drives import wavy_pairs
from tests.further import known_inputs, with_surroundings
from tests.histories import observed
from tests.learners.made import TRUE, gru, module_of, training_data

DATA = training_data(base=TRUE.repeat(2, 1))
MODULE = module_of(DATA, cold_start_fraction=1.0, speed_shift=20.0)


def inputs(batch: RolloutBatch) -> RolloutInputs:
    dataset = MODULE.dataset
    pair = dataset.pair.gather(1, batch.place)
    return RolloutInputs.of(dataset.recordings.batch, pair, batch, MODULE.exact_step, 3)


def batch(shift: float, wider: float) -> RolloutBatch:
    place = torch.arange(3).expand(2, 3)
    like = torch.ones(2, 3)
    return RolloutBatch(
        place=place,
        start=torch.full_like(place, 8),
        cold_start=torch.ones_like(place, dtype=torch.bool),
        last=torch.full_like(place, 200),
        weight=like,
        shift=shift * like,
        wider=wider * like,
    )


def test_a_faster_road_moves_both_vehicles_alike() -> None:
    slow, fast = inputs(batch(0.0, 0.0)), inputs(batch(15.0, 22.5))
    torch.testing.assert_close(fast.follower[2], slow.follower[2])
    torch.testing.assert_close(fast.leader[2], slow.leader[2])
    torch.testing.assert_close(fast.leader[1], slow.leader[1] + 15.0)
    torch.testing.assert_close(fast.measured.speed, slow.measured.speed + 15.0)
    torch.testing.assert_close(fast.measured.gap, slow.measured.gap + 22.5)
    # Positions go with the speeds, from the moment at which the policy takes over.
    step = fast.leader[0, 1:, ..., 0] - fast.leader[0, :-1, ..., 0]
    before = slow.leader[0, 1:, ..., 0] - slow.leader[0, :-1, ..., 0]
    stride = MODULE.exact_step.stride * MODULE.exact_step.dt
    torch.testing.assert_close(step, before + 15.0 * stride, rtol=1e-4, atol=1e-4)
    gap = fast.leader[0, 0][..., MODULE.exact_step.length - 1]
    slow_gap = slow.leader[0, 0][..., MODULE.exact_step.length - 1]
    torch.testing.assert_close(gap, slow_gap + 22.5, rtol=1e-4, atol=1e-4)


def test_further_signals_are_augmented_as_vehicles_are() -> None:
    """On a faster and scaled road the second leader stays where they belong: 30 m, scaled, ahead."""
    pairs = with_surroundings(wavy_pairs(Krauss(), TRUE, frames=260))
    data = replace(training_data(base=TRUE.repeat(2, 1)), recorded=PairBatch.of(pairs))
    with known_inputs():
        policy = GruPolicy(inputs=("gap", "rain", "second_leader"), hidden_size=12)
        made = module_of(data, policy=policy, cold_start_fraction=1.0, speed_shift=20.0)
    pair = made.dataset.pair.gather(1, batch(0.0, 0.0).place)
    changed = batch(15.0, 6.0)._replace(scale=torch.full((2, 3), 1.5))
    recorded = made.dataset.recordings.batch
    slow = RolloutInputs.of(recorded, pair, batch(0.0, 0.0), made.exact_step, 3)
    fast = RolloutInputs.of(recorded, pair, changed, made.exact_step, 3)
    rain, ahead, speed = 3, 4, 5
    assert torch.equal(fast.leader[rain], slow.leader[rain])
    torch.testing.assert_close(fast.leader[speed], slow.leader[speed] * 1.5 + 15.0)
    rear = fast.leader[0] - fast.leader_length[..., None]
    torch.testing.assert_close(fast.leader[ahead] - rear, torch.full_like(rear, 45.0))


def test_some_cold_starts_are_faster_and_their_gap_fits() -> None:
    drawn = MODULE.sampler.training(0)
    assert drawn.shift is not None
    assert drawn.wider is not None
    faster = drawn.shift > 0
    share = []
    for step in range(30):
        shift = MODULE.sampler.training(step).shift
        assert shift is not None
        share.append(float((shift > 0).float().mean()))
    assert 0.15 < sum(share) / len(share) < 0.45
    pair = MODULE.dataset.pair.gather(1, drawn.place)
    time_gap = MODULE.dataset.recordings.time_gap[pair]
    torch.testing.assert_close(drawn.wider[faster], (drawn.shift * time_gap)[faster])
    none = module_of(DATA, cold_start_fraction=1.0, speed_shift=0.0).sampler.training(0)
    assert none.shift is None


def test_time_gaps_are_those_of_people() -> None:
    found = usual_time_gaps(DATA.batch, DATA.pairs.split.frame, DATA.pairs.index)
    assert bool(((found >= 0.8) & (found <= 2.5)).all())


def test_situations_are_augmented_as_trajectories_are() -> None:
    settings = RolloutSettings(scaling=0.0, speed_shift=20.0)
    time_gap = torch.tensor([1.0, 2.0], dtype=torch.float64)
    values = torch.full((2, 500), 5.0, dtype=torch.float64)
    history = observed(values, values * 0.1, values, values * 0.1, values * 2)
    augment = augmentation(settings, time_gap, torch.Generator().manual_seed(0))
    after = augment(history, torch.arange(2))
    shift = after["follower_speed"] - 5.0
    torch.testing.assert_close(after["leader_speed"] - 5.0, shift)
    torch.testing.assert_close(after["gap"] - 10.0, shift * time_gap[:, None])
    torch.testing.assert_close(after["follower_acceleration"], history["follower_acceleration"])
    assert 0.2 < float((shift > 0).double().mean()) < 0.4
    assert float(shift.max()) <= 20.0


def test_what_was_learned_on_faster_roads_is_inside_the_valid_range() -> None:
    from cfx.learners.rollout import RolloutLearner
    from tests.learners.made import QUICK

    ranges = {}
    for shift in (0.0, 20.0):
        quick = {**QUICK, "epochs": 1, "steps": 1}
        learner = RolloutLearner(speed_shift=shift, cold_start_fraction=1.0, **quick)
        found = learner.fit(gru(), DATA).valid_range
        assert found is not None
        ranges[shift] = found
    assert float(ranges[20.0].high[0, 0]) > float(ranges[0.0].high[0, 0]) + 10.0
