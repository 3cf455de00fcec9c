"""How often pairs are sampled where sites and drivers are of different size."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.learners.rollout.dataset import chances

SITES = ("road", "road", "road", "track", "track", "track")
DRIVERS = ("1", "2", "2", "Kia", "Kia", "VW")
FRAMES = torch.tensor([100, 100, 300, 400, 400, 200])


def test_without_balance_every_pair_is_as_likely() -> None:
    assert chances(SITES, DRIVERS, FRAMES, 0.0).tolist() == pytest.approx([1 / 6] * 6)


def test_with_balance_sites_and_their_drivers_are_alike_and_frames_within_them() -> None:
    found = chances(SITES, DRIVERS, FRAMES, 1.0).tolist()
    assert found == pytest.approx([1 / 4, 1 / 16, 3 / 16, 1 / 8, 1 / 8, 1 / 4])


@given(
    st.lists(
        st.tuples(st.sampled_from("abc"), st.sampled_from("xyz"), st.integers(1, 1000)), min_size=1
    ),
    st.floats(0, 1),
)
def test_chances_are_positive_and_add_up_to_one(
    pairs: list[tuple[str, str, int]], balance: float
) -> None:
    sites, drivers, frames = zip(*pairs, strict=True)
    found = chances(sites, drivers, torch.tensor(frames), balance)
    assert bool((found > 0).all())
    assert float(found.sum()) == pytest.approx(1)


def test_a_small_site_is_sampled_more_with_balance() -> None:
    sites, drivers = ["big"] * 9 + ["small"], [str(number) for number in range(10)]
    frames = torch.full((10,), 100)
    shares = [float(chances(sites, drivers, frames, balance)[-1]) for balance in (0, 0.5, 1)]
    assert np.all(np.diff(shares) > 0)
    assert shares[-1] == pytest.approx(0.5)
