"""Windows: the short parts of a trajectory for which one set of parameters holds.

A window starts at a measured state and spans `length` steps; one starts every `stride` steps.
Window k of a pair starts at frame `k stride` and is compared at the `length` frames after it.

Shapes: P pairs, W windows of all pairs together.
"""

from __future__ import annotations

import logging
import statistics
from dataclasses import dataclass

import torch
from torch import Tensor

from cfx.data.pairs import PairSet
from cfx.errors import DataError
from cfx.simulation.settings import WindowSettings
from cfx.simulation.trajectory import TRANSIENT_S

__all__ = ["Split", "WindowSettings", "Windows"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Split:
    """The end of each pair's training part.

    Attributes:
        frame: `(P,)` int64, the last measured state that calibration and learning may use. The test
            part starts from this frame's measured state and is compared after it.
        windows: `(P,)` int64, whole windows up to that frame.
    """

    frame: Tensor
    windows: Tensor

    @classmethod
    def of(cls, pairs: PairSet, settings: WindowSettings, share: float) -> Split:
        """Splits each pair so that `share` of its windows come first; 1 gives it whole to training.

        Raises:
            DataError: a pair is too short for two windows of training and one of testing.
        """
        if share == 1:
            return cls.none(pairs, settings)
        frames, windows = [], []
        for pair in pairs:
            count = settings.count(len(pair))
            first = _training_windows(share, count)
            if first < 2 or first >= count:
                least = _least_frames(settings, share) * pair.dt
                raise DataError(
                    f"pair {pair.pair_id} has {len(pair)} frames, too few for windows of"
                    f" {settings.length} steps with split={share:g};"
                    f" set data.min_duration to at least {least:.6g}"
                )
            last = first * settings.stride
            frames.append(last)
            windows.append(settings.count(last + 1))
        return cls(torch.tensor(frames), torch.tensor(windows))

    @classmethod
    def none(cls, pairs: PairSet, settings: WindowSettings) -> Split:
        """Gives each pair whole to training: for drivers who are not tested."""
        frames, windows = [], []
        for pair in pairs:
            frames.append(len(pair) - 1)
            windows.append(settings.count(len(pair)))
        return cls(torch.tensor(frames), torch.tensor(windows))

    def check_test_parts(self, pairs: PairSet, settings: WindowSettings, share: float) -> None:
        """Warns where test parts are so short that their errors say little.

        Args:
            pairs: those that are tested, as many as this has.
            settings, share: as in `of`.

        Raises:
            DataError: most are within one window, so that parameters are chosen once.
        """
        tested = []
        for pair, last in zip(pairs, self.frame.tolist(), strict=True):
            tested.append(len(pair) - 1 - last)
        middle = statistics.median(tested)
        lasts = middle * pairs.dt
        if lasts >= TRANSIENT_S:
            return
        if share == 1:
            raise DataError(
                "split=1 leaves nothing to be tested; it is for a calibration of drivers' own"
                " parameters alone (policy=fixed protocol=within_driver). Lower split"
            )
        warning = (
            f"split={share:g} leaves {sum(tested):,} frames of {len(tested)} pairs to be tested,"
            f" {lasts:.2g} s of the median pair"
        )
        remedy = "lower split, or keep longer pairs (data.min_duration)"
        if middle <= settings.length:
            raise DataError(
                f"{warning}, no more than one window, in which nothing adapts; {remedy}"
            )
        log.warning(
            "%s, all of it within the transient of the first %g s, in which every simulation is"
            " near the measured state: errors say little; %s",
            warning,
            TRANSIENT_S,
            remedy,
        )

    def __getitem__(self, index: Tensor | slice) -> Split:
        """Selects pairs by their numbers, `(D,)`, or a slice of them."""
        return Split(self.frame[index], self.windows[index])


def _training_windows(share: float, count: int) -> int:
    """Returns how many of `count` windows belong to training."""
    return int(share * count + 1e-9)


def _least_frames(settings: WindowSettings, share: float) -> int:
    """Returns how many frames a pair needs at least to be split."""
    count = 3
    while not 2 <= _training_windows(share, count) < count:
        count += 1
    return (count - 1) * settings.stride + settings.length + 1


@dataclass(frozen=True)
class Windows:
    """Windows of several pairs, pair after pair, in time order.

    Attributes:
        pair: `(W,)` int64, index of the pair.
        number: `(W,)` int64, number of the window in its pair, from 0.
        settings: length and stride.
    """

    pair: Tensor
    number: Tensor
    settings: WindowSettings

    @classmethod
    def of(cls, counts: Tensor, settings: WindowSettings) -> Windows:
        """Returns the first `counts[p]` windows of each pair p; `counts` is `(P,)`."""
        pair = torch.repeat_interleave(torch.arange(len(counts)), counts)
        starts = torch.cumsum(counts, 0) - counts
        return cls(pair, torch.arange(len(pair)) - starts[pair], settings)

    def __len__(self) -> int:
        """W."""
        return len(self.pair)

    @property
    def first(self) -> Tensor:
        """Frame of the measured state that each window starts from, `(W,)`."""
        return self.number * self.settings.stride

    def select(self, pairs: Tensor) -> tuple[Windows, Tensor]:
        """Returns the windows of some pairs, and the places of these windows among all.

        The pairs are numbered anew.

        Args:
            pairs: `(D,)` int64; a pair may stand there more than once.
        """
        counts = torch.bincount(self.pair, minlength=int(pairs.max()) + 1)
        starts = torch.cumsum(counts, 0) - counts
        chosen = Windows.of(counts[pairs], self.settings)
        places = starts[pairs][chosen.pair] + chosen.number
        return Windows(chosen.pair, self.number[places], self.settings), places

    def to_grid(self, values: Tensor, pairs: int) -> tuple[Tensor, Tensor]:
        """Arranges values by pair and number of the window.

        Args:
            values: `(W, ...)`.
            pairs: P.

        Returns:
            `(P, windows, ...)`, 0 where a pair has no such window, and the mask `(P, windows)`.
        """
        width = int(self.number.max()) + 1
        pair, number = self.pair.to(values.device), self.number.to(values.device)
        grid = values.new_zeros((pairs, width, *values.shape[1:]))
        mask = torch.zeros((pairs, width), dtype=torch.bool, device=values.device)
        grid[pair, number] = values
        mask[pair, number] = True
        return grid, mask
