"""Losses of segments and pooled losses, against single rollouts."""

from __future__ import annotations

import pytest
import torch

from cfx.calibration.losses import PooledLosses, SegmentLosses, TrajectorySegments
from cfx.calibration.mixed import Mixed
from cfx.calibration.objectives import FrameValues, Objective
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.calibration.theil_u import TheilInequality
from cfx.data.pairs import PairBatch
from cfx.models.base import Leader
from cfx.models.krauss import Krauss
from cfx.simulation.kernel import run as kernel
from cfx.simulation.rollout import MemoryStepper, simulate_follower
from cfx.simulation.trajectory import Start
from tests.drives import wavy_pairs

TRUE = torch.tensor([[1.2, 0.1], [2.0, 0.4], [3.0, 0.8]], dtype=torch.float64)


OBJECTIVES = [SpeedRmse(), GapRmse(), Mixed(), TheilInequality(signal="gap")]


@pytest.mark.parametrize("objective", OBJECTIVES, ids=lambda one: type(one).__name__)
def test_losses_are_the_objective_of_the_rollout(objective: Objective) -> None:
    model = Krauss()
    batch = PairBatch.of(wavy_pairs(model, TRUE))
    pair, first, steps = torch.tensor([0, 2]), torch.tensor([10, 50]), torch.tensor([7, 20])
    losses = SegmentLosses.of_segments(
        MemoryStepper(model, 0.1), objective, batch, pair, first, steps
    )
    candidates = torch.rand(
        (2, 5, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    found = losses(candidates)
    for i in range(2):
        frames = slice(int(first[i]), int(first[i] + steps[i]) + 1)
        for j in range(5):
            parameters = model.space.from_unit(candidates[i, j])
            expected = loss_of(objective, model, batch, int(pair[i]), frames, parameters)
            torch.testing.assert_close(found[i, j], expected)
    torch.testing.assert_close(losses.take(slice(1, 2))(candidates[1:]), found[1:])


def loss_of(
    objective: Objective,
    model: Krauss,
    batch: PairBatch,
    p: int,
    frames: slice,
    parameters: torch.Tensor,
) -> torch.Tensor:
    """Returns the objective of one rollout by the public function."""
    leader = Leader(
        batch.leader_position[p, frames],
        batch.leader_speed[p, frames],
        batch.leader_acceleration[p, frames],
        batch.leader_length[p],
    )
    first = frames.start
    start = Start(
        batch.follower_position[p, first],
        batch.follower_speed[p, first],
        batch.follower_acceleration[p, first],
    )
    simulated = simulate_follower(model, parameters, leader, start, 0.1)
    speed, gap = batch.follower_speed[p, frames], batch.gap[p, frames]
    values = FrameValues(simulated.speed[1:], simulated.gap[1:], speed[1:], gap[1:], 0.1)
    return objective(values, torch.ones(len(speed) - 1))


def test_a_pooled_loss_is_the_mean_of_its_segments() -> None:
    truth = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8]], dtype=torch.float64)
    batch = PairBatch.of(wavy_pairs(Krauss(), truth))
    stepper = MemoryStepper(Krauss(), 0.1)
    index, steps = torch.arange(3), torch.full((3,), 150)
    segments = SegmentLosses.of_segments(
        stepper, SpeedRmse(), batch, index, torch.zeros_like(index), steps
    )
    members = torch.tensor([[True, True, False], [True, True, True]])
    candidates = torch.rand(
        (2, 7, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    # Also where a segment of both problems is simulated once.
    for asked in (candidates, candidates[:1].expand(2, -1, -1)):
        pooled = PooledLosses(segments, members, memory=1 << 30)
        first, second = (segments(asked[[k, k, k]]) for k in range(2))
        expected = torch.stack([first[:2].mean(0), second.mean(0)])
        torch.testing.assert_close(pooled(asked), expected)
        torch.testing.assert_close(pooled.take(slice(1, 2))(asked[1:]), expected[1:])
        # One candidate at a time gives the same.
        torch.testing.assert_close(PooledLosses(segments, members, memory=1)(asked), expected)


def test_many_trajectories_are_simulated_some_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    batch, index = PairBatch.of(wavy_pairs(Krauss(), TRUE)), torch.arange(3)
    last = torch.tensor([150, 150, 90])
    stepper, objective = MemoryStepper(Krauss(), 0.1), SpeedRmse()
    segments = SegmentLosses.of_segments(
        stepper, objective, batch, index, torch.zeros_like(index), last
    )
    members = torch.tensor([[True, True, False], [True, False, True]])
    candidates = torch.rand(
        (2, 7, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    trajectories = TrajectorySegments.of_pairs(stepper, objective, batch, last)
    for asked in (candidates, candidates[:1].expand(2, -1, -1)):
        expected = PooledLosses(segments, members, memory=1 << 30)(asked)
        pooled = PooledLosses(trajectories, members, memory=1 << 30)
        torch.testing.assert_close(pooled(asked), expected)
        monkeypatch.setattr("cfx.calibration.losses._SEGMENTS_AT_ONCE", 1)
        torch.testing.assert_close(pooled(asked), expected)
        monkeypatch.undo()


@pytest.mark.parametrize("length", [5, 60, 149, 1000, None])
def test_pieces_of_trajectories_hold_each_frame_once_and_pairs_count_alike(
    length: int | None,
) -> None:
    batch = PairBatch.of(wavy_pairs(Krauss(), TRUE))
    last = torch.tensor([150, 150, 90])
    stepper, objective = MemoryStepper(Krauss(), 0.1), SpeedRmse()
    pieces = TrajectorySegments.of_pairs(stepper, objective, batch, last, length)
    for pair, end in enumerate(last.tolist()):
        mine = pieces.pair == pair
        first, lasts = pieces.first[mine].tolist(), pieces.last[mine].tolist()
        assert [*first[1:], end] == lasts
        assert first[0] == 0
        assert len(first) == max(1, round(end / (length or end)))
    candidates = torch.rand(
        (1, 4, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    of_pieces = pieces.take(torch.arange(pieces.problems))(
        candidates.expand(pieces.problems, -1, -1)
    )
    means = torch.stack([of_pieces[pieces.pair == pair].mean(0) for pair in range(3)])
    members = torch.ones((1, 3), dtype=torch.bool)[:, pieces.pair]
    pooled = PooledLosses(pieces, members, 1 << 30, pieces.weight)
    torch.testing.assert_close(pooled(candidates), means.mean(0, keepdim=True))
    # Another problem's candidates, so that pieces are simulated for each.
    two = PooledLosses(pieces, members.expand(2, -1), 1 << 30, pieces.weight)
    other = torch.cat([candidates, 1.0 - candidates])
    torch.testing.assert_close(two(other)[:1], means.mean(0, keepdim=True))


def test_a_segment_that_diverges_spoils_only_its_own_problems() -> None:
    pairs = wavy_pairs(Krauss(), torch.tensor([[1.0, 0.1], [2.0, 0.4]], dtype=torch.float64))
    batch = PairBatch.of(pairs)
    index = torch.arange(2)
    segments = SegmentLosses.of_segments(
        MemoryStepper(Krauss(), 0.1),
        SpeedRmse(),
        batch,
        index,
        torch.zeros_like(index),
        torch.full((2,), 150),
    )
    segments.segments.measured_speed[10, 1] = torch.nan
    same = torch.full((2, 3, 2), 0.5, dtype=torch.float64)
    members = torch.tensor([[True, False], [True, True]])
    losses = PooledLosses(segments, members, memory=1 << 30)(same)
    assert losses.isnan().tolist() == [[False] * 3, [True] * 3]


def test_pooled_losses_are_the_same_where_their_work_is_worth_compiling_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = wavy_pairs(Krauss(), torch.tensor([[1.0, 0.1], [2.0, 0.4]], dtype=torch.float64))
    index = torch.arange(2)
    stepper = MemoryStepper(Krauss(), 0.1)
    segments = SegmentLosses.of_segments(
        stepper,
        SpeedRmse(),
        PairBatch.of(pairs),
        index,
        torch.zeros_like(index),
        torch.full((2,), 23),
    )
    candidates = torch.rand(
        (1, 9, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    pooled = PooledLosses(segments, torch.tensor([[True, True]]), memory=1)
    expected = pooled(candidates)
    # 2 segments, 9 candidates and 23 steps are worth it together; a block of one candidate is not.
    monkeypatch.setattr("cfx.simulation.rollout._WORTH_A_KERNEL", 2 * 9 * 23)
    made = []
    monkeypatch.setattr(kernel, "accumulate", lambda *args, **_: made.append(args))
    torch.testing.assert_close(pooled(candidates), expected)
    assert len(made) == 9
    made.clear()
    monkeypatch.setattr("cfx.simulation.rollout._WORTH_A_KERNEL", 2 * 9 * 23 + 1)
    torch.testing.assert_close(pooled(candidates), expected)
    assert not made
