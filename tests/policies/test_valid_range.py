"""The valid range: what is usual is inside, and answers fade outside."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.policies import valid_range
from cfx.policies.context import DriverContext
from cfx.policies.history import History
from cfx.policies.valid_range import (
    FADED,
    ValidRange,
    recorded_quantiles,
    share_in_words,
    situations,
    weight_of_answer,
)
from tests.agents import adaptive
from tests.drives import straight_pairs
from tests.histories import observed


def learned(count: int = 4000) -> torch.Tensor:
    """Returns situations of a driver with a time gap of 1.5 s up to 15 m/s, `(S, f)`."""
    generator = torch.Generator().manual_seed(0)
    lots = torch.rand((4, count), generator=generator, dtype=torch.float64)
    noise = torch.randn((3, count), generator=generator, dtype=torch.float64)
    speed = 15.0 * lots[0]
    gap = 2.0 + 1.5 * speed + noise[0].abs()
    leader = (speed + 0.5 * noise[0], 0.5 * noise[2])
    return situations(observed(*leader, speed, 0.5 * noise[1], gap))


RANGE = ValidRange.of([learned()])
ONE = torch.zeros(1, dtype=torch.int64)


def situation(speed: float, gap: float, relative: float = 0.0) -> torch.Tensor:
    values = [speed + relative, 0.0, speed, 0.0, gap]
    signals = (torch.tensor([value], dtype=torch.float64) for value in values)
    return situations(observed(*signals))


def history(speed: float, gap: float) -> History:
    def frames(value: float) -> torch.Tensor:
        return torch.full((1, 5), value, dtype=torch.float64)

    return observed(frames(speed), frames(0.0), frames(speed), frames(0.0), frames(gap))


def test_nearly_all_that_was_learned_from_is_inside() -> None:
    everyone = learned()
    score = RANGE.score(everyone, torch.zeros(len(everyone), dtype=torch.int64))
    assert float((score <= 1.0).double().mean()) == pytest.approx(0.995, abs=0.002)


def test_the_score_is_a_mahalanobis_distance() -> None:
    """As SciPy computes it."""
    from scipy.spatial.distance import mahalanobis

    where = situation(25.0, 20.0, -3.0)
    expected = mahalanobis(where[0].numpy(), RANGE.mean[0].numpy(), RANGE.precision[0].numpy())
    assert float(RANGE.score(where, ONE)) == pytest.approx(expected / float(RANGE.distance[0]))


def test_a_usual_speed_with_an_unusual_gap_is_outside() -> None:
    """Both are within the minimum and the maximum of what was learned from."""
    assert float(RANGE.score(situation(10.0, 17.0), ONE)) < 1.0
    assert float(RANGE.score(situation(14.0, 2.5), ONE)) > 1.0


def test_farther_outside_scores_higher_and_weighs_less() -> None:
    scores = [float(RANGE.score(situation(v, 2.0 + 1.5 * v), ONE)) for v in (10, 30, 45, 60)]
    assert scores == sorted(scores)
    weights = weight_of_answer(torch.tensor([0.5, 1.0, (1.0 + FADED) / 2, FADED, 9.0])).tolist()
    assert weights == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])


@pytest.mark.parametrize("offsets", [False, True])
def test_an_answer_fades_to_the_base(offsets: bool) -> None:
    agent = adaptive({"name": "krauss"}, offsets=offsets)
    guarded = replace(agent, valid_range=RANGE)
    base = torch.tensor([[1.1, 0.2]], dtype=torch.float64)
    if not offsets:
        guarded = replace(guarded, pooled=base)
    context = DriverContext(base if offsets else None)

    def chosen(who: object, speed: float) -> torch.Tensor:
        state = who.begin(ONE, context)  # type: ignore[attr-defined]
        values, _ = who.act(history(speed, 2.0 + 1.5 * speed), state)  # type: ignore[attr-defined]
        return values

    assert torch.equal(chosen(guarded, 8.0), chosen(agent, 8.0))
    torch.testing.assert_close(chosen(guarded, 80.0), base)
    assert not torch.allclose(chosen(agent, 80.0), base)
    near = (chosen(guarded, 24.0) - base).abs()
    assert bool((near <= (chosen(agent, 24.0) - base).abs() + 1e-9).all())


def test_each_network_has_its_own_range() -> None:
    shifted = learned() + 20.0
    both = ValidRange.of([learned(), shifted])
    where = learned()[:5]
    zeros, ones = torch.zeros(5, dtype=torch.int64), torch.ones(5, dtype=torch.int64)
    assert bool((both.score(where, zeros) < both.score(where, ones)).all())
    alone = ValidRange.of([shifted]).score(where, zeros)
    torch.testing.assert_close(alone, both.score(where, ones))


def test_words_say_how_much_and_why() -> None:
    where = situation(25.0, 39.5)
    beyond = RANGE.beyond(where, ONE).sum(0) * 37
    words = share_in_words(RANGE, 37, 100, beyond)
    assert words == "37 % of steps outside what the policy has learned (speed above 15 m/s)"
    assert share_in_words(RANGE, 0, 100, beyond) == ""
    assert valid_range.in_words(RANGE, torch.zeros(10)) == ""


def test_recordings_are_kept_as_quantiles_of_what_moves() -> None:
    # Gaps of 20 m: 2 s at 10 m/s; standing has no time gap.
    moving, standing = PairBatch.of(straight_pairs([101])), PairBatch.of(straight_pairs([50], 0.0))
    kept = recorded_quantiles(moving)
    assert kept["speed"] == pytest.approx((10.0,) * 3)
    assert kept["time_gap"] == pytest.approx((2.0,) * 3)
    ramp = replace(moving, follower_acceleration=torch.arange(101.0)[None])
    assert recorded_quantiles(ramp)["acceleration"] == (5.0, 50.0, 95.0)
    assert recorded_quantiles(standing)["time_gap"] == ()
