from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.core.component import validate
from cfx.data.pairs import PairSet
from cfx.errors import ConfigError, DataError
from cfx.simulation.windows import Split, Windows, WindowSettings
from tests.drives import straight_pairs


def test_the_papers_pair_has_the_papers_windows() -> None:
    assert WindowSettings().count(839) == 167


@given(frames=st.integers(2, 400), length=st.integers(1, 30), stride=st.integers(1, 30))
def test_windows_fit_and_none_is_missing(frames: int, length: int, stride: int) -> None:
    settings = WindowSettings(length=max(length, stride), stride=stride)
    count = settings.count(frames)
    last_frame_of = [k * stride + settings.length for k in range(count + 1)]
    assert all(last <= frames - 1 for last in last_frame_of[:count])
    assert last_frame_of[count] > frames - 1


@given(
    frames=st.lists(st.integers(60, 300), min_size=1, max_size=5),
    stride=st.integers(1, 6),
    share=st.floats(0.5, 0.9),
)
def test_training_windows_stay_before_the_test_part(
    frames: list[int], stride: int, share: float
) -> None:
    settings = WindowSettings(length=stride + 2, stride=stride)
    split = Split.of(straight_pairs(frames), settings, share)
    windows = Windows.of(split.windows, settings)
    assert bool((windows.first + settings.length <= split.frame[windows.pair]).all())
    assert bool((split.frame < torch.tensor(frames) - 1).all())


def test_drivers_who_are_not_tested_are_learned_from_up_to_their_last_frame() -> None:
    split = Split.none(straight_pairs([60, 90]), WindowSettings())
    assert split.frame.tolist() == [59, 89]


def test_windows_come_back_from_their_grid() -> None:
    windows = Windows.of(torch.tensor([2, 3]), WindowSettings())
    grid, mask = windows.to_grid(torch.arange(5.0), 2)
    assert grid.tolist() == [[0, 1, 0], [2, 3, 4]]
    assert mask.tolist() == [[True, True, False], [True, True, True]]


def test_a_pair_that_is_too_short_says_how_long_it_must_be() -> None:
    settings = WindowSettings()
    with pytest.raises(DataError, match=r"pair p0 has 9 frames.*at least 1.6") as caught:
        Split.of(straight_pairs([9]), settings, 0.8)
    needed = round(10 * float(str(caught.value).rsplit(" ", 1)[1]))
    Split.of(straight_pairs([needed]), settings, 0.8)
    with pytest.raises(DataError):
        Split.of(straight_pairs([needed - 1]), settings, 0.8)


def test_windows_that_leave_frames_out_are_refused() -> None:
    with pytest.raises(ConfigError, match="leaves frames out between windows"):
        validate(WindowSettings, {"length": 3, "stride": 5}, where="windows")


def split_of(frames: int, share: float) -> tuple[PairSet, Split]:
    pairs = straight_pairs([frames] * 3)
    return pairs, Split.of(pairs, WindowSettings(), share)


def test_a_test_part_within_the_transient_is_warned_of_with_what_is_tested(
    caplog: pytest.LogCaptureFixture,
) -> None:
    pairs, split = split_of(700, 0.99)
    split.check_test_parts(pairs, WindowSettings(), 0.99)
    (said,) = caplog.messages
    assert said.startswith("split=0.99 leaves 42 frames of 3 pairs to be tested, 1.4 s of the")
    assert "lower split, or keep longer pairs" in said


def test_a_test_part_in_which_nothing_adapts_is_refused() -> None:
    pairs, split = split_of(31, 0.99)
    with pytest.raises(DataError, match=r"split=0\.99 leaves 15 frames of 3 pairs .*; lower split"):
        split.check_test_parts(pairs, WindowSettings(), 0.99)


def test_usual_test_parts_are_not_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    pairs, split = split_of(300, 0.8)
    split.check_test_parts(pairs, WindowSettings(), 0.8)
    assert not caplog.messages


@pytest.mark.parametrize(("last", "said"), [(69, None), (70, "4.9 s of the median pair")])
def test_short_test_parts_are_warned_of(
    last: int, said: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """A test part of 5 s is long enough; one frame less is within the transient."""
    pairs = straight_pairs([120])
    split = Split(torch.tensor([last]), torch.tensor([10]))
    split.check_test_parts(pairs, WindowSettings(), 0.6)
    if said is None:
        assert not caplog.messages
    else:
        assert said in caplog.text


@pytest.mark.parametrize(
    ("last", "share", "said"),
    [
        (119, 1.0, "split=1 leaves nothing to be tested"),
        (114, 0.95, "no more than one window, in which nothing adapts"),
    ],
)
def test_without_a_test_part_nothing_can_be_tested(last: int, share: float, said: str) -> None:
    split = Split(torch.tensor([last]), torch.tensor([10]))
    with pytest.raises(DataError, match=said):
        split.check_test_parts(straight_pairs([120]), WindowSettings(), share)
