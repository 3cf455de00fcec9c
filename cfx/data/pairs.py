"""Leader-follower pairs: what every dataset delivers and everything else reads.

Glossary (SI units everywhere): *leader* drives ahead of *follower*; *position* is the front
bumper's, along the lane; *gap* is bumper to bumper, `leader position - leader length - follower
position`; *relative speed* is leader minus follower.
Shapes: P pairs, T frames of the longest pair.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cfx.core import memory
from cfx.data.names import name_of
from cfx.data.signals import RECORDED, Signal
from cfx.errors import DataError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Array = NDArray[np.float64]

_LIKENESS_FRAMES = 8
"""Frames of a pair at which its likeness is taken."""

_TOLERANCE = 0.1 + 1e-9
"""m/s and m; the same trajectory saved with one decimal differs by less, two drivers by more."""

_MIN_SPEED_RANGE_MPS, _MIN_FRAMES = 1.0, 40
"""Two recordings are compared only if the speed varies by at least this much over at least this
many frames. Shorter or steadier ones look alike by chance."""

_PAIRS_AT_ONCE = 1024
"""Pairs that are read before the memory of their signals is released, which may lie in files."""


@dataclass(frozen=True)
class Pair:
    """One follower behind one leader over consecutive frames; the arrays are `(T,)` float64.

    A field is a column of the tidy layout, so that there are as many fields as columns.

    Attributes:
        pair_id: unique within a `PairSet`.
        recording: name of the recording; vehicle ids are unique only within one.
        first_frame: frame number of the first row in the source.
        dt: time step, s.
        leader_length: m.
        lane: lane number, None where the source has none.
        driver_type: what drives the follower, as the source labels it: "human", "acc", "automated",
            "truck", a vType; "" where it has no labels.
        leader_driver_type: what drives the leader.
        site: the road or area that the recording was made at; several recordings may share one.
        vehicle: the follower's name over all recordings, "" where ids mean something within one
            recording alone.
        surroundings: further signals, as measured, `(T,)` each (`cfx.data.signals`).
        truth: true parameters over time, name -> `(T,)`, known only for synthetic pairs.
        truth_model: name of the model these parameters belong to.
    """

    pair_id: str
    recording: str
    leader_id: str
    follower_id: str
    first_frame: int
    dt: float
    leader_length: float
    leader_position: Array
    leader_speed: Array
    leader_acceleration: Array
    follower_position: Array
    follower_speed: Array
    follower_acceleration: Array
    lane: int | None = None
    truth: Mapping[str, Array] = field(default_factory=dict)
    truth_model: str = ""
    driver_type: str = ""
    leader_driver_type: str = ""
    site: str = ""
    vehicle: str = ""
    surroundings: Mapping[Signal, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("pair_id", "recording", "leader_id", "follower_id"):
            object.__setattr__(self, name, name_of(getattr(self, name)))
        shapes = {name: getattr(self, name).shape for name in RECORDED}
        for signal, values in self.surroundings.items():
            shapes[signal.name] = values.shape
        if len(set(shapes.values())) != 1 or len(shapes["leader_position"]) != 1:
            raise DataError(
                f"pair {self.pair_id}: all signals must have the same length, got {shapes}"
            )
        if not self.dt > 0:
            raise DataError(f"pair {self.pair_id}: the time step must be positive, got {self.dt} s")

    def __len__(self) -> int:
        return len(self.leader_position)

    @property
    def duration(self) -> float:
        """How long the pair lasts, s; each frame counts with one time step."""
        return len(self) * self.dt

    def lasts(self, duration: float) -> bool:
        """Says whether the pair lasts so many seconds at least; one frame alone lasts no time."""
        # A share of a frame less than a millionth is rounding: 70 s are 700 frames of 0.1 s.
        return len(self) >= max(2.0, duration / self.dt - 1e-6)

    def beginning(self, frames: int) -> Pair:
        """Returns the pair over its first frames; all of it where it has no more."""
        return self.with_arrays(lambda values: values[:frames])

    def with_arrays(self, change: Callable[[Array], Array]) -> Pair:
        """Returns the pair with all that it has over time changed alike."""
        changed: dict[str, Any] = {}
        for name in RECORDED:
            changed[name] = change(getattr(self, name))
        for name in ("truth", "surroundings"):
            arrays = getattr(self, name)
            changed[name] = {key: change(values) for key, values in arrays.items()}
        return replace(self, **changed)

    @property
    def driver(self) -> str:
        """Who drives the follower, unique across recordings.

        A vehicle that keeps its name over recordings is one driver with adaptive cruise control and
        another one without.
        """
        if not self.vehicle:
            return f"{self.recording}/{self.follower_id}"
        if not self.driver_type:
            return self.vehicle
        return f"{self.vehicle} ({self.driver_type})"

    @property
    def gap(self) -> Array:
        """Bumper-to-bumper gap `(T,)`, m."""
        return self.leader_position - self.leader_length - self.follower_position

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything that calibration and learning read."""
        return self._digest(f"{self.pair_id}|{self.recording}|{self.dt!r}|{self.leader_length!r}")

    @cached_property
    def content(self) -> str:
        """SHA-256 of the trajectories alone, whatever the pair and its recording are called."""
        return self._digest(f"{self.dt!r}|{self.leader_length!r}")

    @cached_property
    def likeness(self) -> str:
        """Summary that identifies the trajectories under other names and units.

        In plain numbers: frames, time step (ms), then at frames evenly spread over the pair both
        speeds (m/s) and the gap (m); see `LearnedFrom`.
        """
        frames = np.linspace(0, len(self) - 1, _LIKENESS_FRAMES).round().astype(np.int64)
        values = (self.leader_speed[frames], self.follower_speed[frames], self.gap[frames])
        words = [str(len(self)), f"{1000 * self.dt:.0f}"]
        for value in np.concatenate(values):
            words.append(f"{value:.2f}")
        return " ".join(words)

    def _digest(self, header: str) -> str:
        digest = hashlib.sha256(header.encode())
        for name in RECORDED:
            digest.update(np.ascontiguousarray(getattr(self, name), dtype=np.float64).tobytes())
        for signal, values in self.surroundings.items():
            digest.update(repr(signal).encode())
            digest.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
        return digest.hexdigest()


class LearnedFrom:
    """Trajectories that were learned from, by what they are recognised by.

    A pair is one of them if it has as many frames of the same step, and if both speeds and the gap
    agree to 0.1 m/s and 0.1 m wherever they are compared: other units, names and decimals of a file
    do not hide it. Another cut of it, in time or in another time step, is not recognised.

    Args:
        likenesses: `Pair.likeness` of each.
    """

    def __init__(self, likenesses: Iterable[str]) -> None:
        rows: dict[str, list[Array]] = {}
        for likeness in likenesses:
            length, numbers = _parsed(likeness)
            rows.setdefault(length, []).append(numbers)
        self._by_length: dict[str, Array] = {}
        for length, same_length in rows.items():
            self._by_length[length] = np.array(same_length)

    def __contains__(self, pair: Pair) -> bool:
        length, numbers = _parsed(pair.likeness)
        candidates = self._by_length.get(length)
        if candidates is None:
            return False
        agrees = np.abs(candidates - numbers) <= _TOLERANCE
        return bool(agrees.all(1).any())


def driver_names(pairs: Iterable[Pair]) -> set[str]:
    """Returns the names of the followers' drivers."""
    return {pair.driver for pair in pairs}


def of_each(pairs: Iterable[Pair], name: str) -> list[Any]:
    """Returns an attribute of each pair."""
    return [getattr(pair, name) for pair in pairs]


def frames_of_each(pairs: Iterable[Pair]) -> list[int]:
    """Returns the number of frames of each pair."""
    return [len(pair) for pair in pairs]


def over_frames(pairs: Iterable[Pair], name: str) -> Array:
    """Returns a signal, or the gap, over the frames of all pairs, one pair after the other."""
    return np.concatenate(of_each(pairs, name))


def _parsed(likeness: str) -> tuple[str, Array]:
    """Returns a likeness's frames and time step, and its speeds and gaps, `(24,)`."""
    frames, step, *numbers = likeness.split()
    return f"{frames} {step}", np.array(numbers, dtype=np.float64)


def twins(pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    """Returns the ids of pairs that drive alike as `LearnedFrom` says, each with an earlier one.

    Pairs whose speed hardly changes, and short ones, are none: many may drive so.
    """
    by_length: dict[str, list[tuple[int, Array]]] = {}
    for place, pair in enumerate(pairs):
        length, numbers = _parsed(pair.likeness)
        speeds = numbers[_LIKENESS_FRAMES : 2 * _LIKENESS_FRAMES]
        if len(pair) >= _MIN_FRAMES and np.ptp(speeds) > _MIN_SPEED_RANGE_MPS:
            by_length.setdefault(length, []).append((place, numbers))
    places: list[tuple[int, int]] = []
    for same_length in by_length.values():
        places_of_length, numbers_of_length = zip(*same_length, strict=True)
        places += _places_alike(np.array(places_of_length), np.array(numbers_of_length))
    ids = []
    for earlier, later in sorted(places):
        ids.append((pairs[earlier].pair_id, pairs[later].pair_id))
    return ids


def _places_alike(places: NDArray[np.int64], values: Array) -> list[tuple[int, int]]:
    """Returns the places of any two pairs of one length that agree, the earlier one first.

    The sums of two pairs that agree differ by no more than the tolerance times the numbers that are
    compared. So pairs are sorted by their sums, and each is compared with its neighbours alone,
    until even the nearest are too far apart.

    Args:
        places: of P pairs, `(P,)`.
        values: their speeds and gaps, `(P, 24)`.
    """
    order = np.argsort(values.sum(1))
    places, values, sums = places[order], values[order], values.sum(1)[order]
    alike = []
    for distance in range(1, len(values)):
        is_near = sums[distance:] - sums[:-distance] <= _TOLERANCE * values.shape[1]
        if not is_near.any():
            break
        (first,) = np.nonzero(is_near)
        differences = np.abs(values[first] - values[first + distance]).max(1)
        for row in first[differences <= _TOLERANCE].tolist():
            earlier, later = sorted((int(places[row]), int(places[row + distance])))
            alike.append((earlier, later))
    return alike


@dataclass(frozen=True)
class Dropped:
    """A count of what a dataset left out or cut, and why.

    Attributes:
        unit: what was counted: rows, pairs or vehicles.
    """

    reason: str
    count: int
    unit: str = "pairs"


@dataclass(frozen=True)
class Remark:
    """What reading has noticed about a source as a whole.

    Attributes:
        text: a sentence without a full stop, for people.
        is_contradiction: the source contradicts itself, so that its pairs are not what they say;
            `data.check` refuses it. Else it is a doubt, of which a job warns.
    """

    text: str
    is_contradiction: bool = False


@dataclass(frozen=True)
class PairSet(Sequence[Pair]):
    """Pairs in a fixed order, where they came from, and a count of everything that was left out.

    Attributes:
        ends: why the pairs that were cut out of tracks end, counted over all that were found.
        remarks: what was noticed about the source as a whole.
    """

    pairs: tuple[Pair, ...]
    source: str
    dropped: tuple[Dropped, ...] = ()
    ends: tuple[Dropped, ...] = ()
    remarks: tuple[Remark, ...] = ()

    def __post_init__(self) -> None:
        ids: set[str] = set()
        for pair in self.pairs:
            if pair.pair_id in ids:
                raise DataError(f"{self.source}: pair id '{pair.pair_id}' stands for two pairs")
            ids.add(pair.pair_id)

    @property
    def ids(self) -> list[str]:
        """The name of each pair."""
        return [pair.pair_id for pair in self.pairs]

    @property
    def drivers(self) -> list[str]:
        """The driver of each pair: several pairs may have the same."""
        return [pair.driver for pair in self.pairs]

    @property
    def sites(self) -> list[str]:
        """The road or area of each pair; "" where it is not known."""
        return [pair.site for pair in self.pairs]

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: Any) -> Any:
        return self.pairs[index]

    def __iter__(self) -> Iterator[Pair]:
        for start in range(0, len(self.pairs), _PAIRS_AT_ONCE):
            yield from self.pairs[start : start + _PAIRS_AT_ONCE]
            memory.release()

    @property
    def frames(self) -> int:
        """The number of frames of all pairs."""
        return sum(frames_of_each(self.pairs))

    @property
    def size(self) -> int:
        """Bytes of all signals."""
        arrays = 0
        for pair in self.pairs:
            arrays += len(pair) * (len(RECORDED) + len(pair.surroundings))
        return 8 * arrays

    def changed(self, change: Callable[[Pair], Pair | None]) -> PairSet:
        """Returns changed pairs, without those of which None is left.

        Raises:
            OutputError: the disk of temporary files is full.
        """
        is_large = self.size >= memory.LARGE
        changed: list[Pair] = []
        for start in range(0, len(self.pairs), _PAIRS_AT_ONCE):
            changed_pairs = []
            for pair in self.pairs[start : start + _PAIRS_AT_ONCE]:
                changed_pair = change(pair)
                if changed_pair is not None:
                    changed_pairs.append(changed_pair)
            part = replace(self, pairs=tuple(changed_pairs))
            if is_large:
                part = part.in_file()
            changed += part
            memory.release()
        return replace(self, pairs=tuple(changed))

    def in_file(self) -> PairSet:
        """Returns the same pairs, whose signals and true parameters lie in a file.

        Raises:
            OutputError: the disk is full.
        """
        size = 0
        for pair in self.pairs:
            size += len(pair) * (len(RECORDED) + len(pair.truth) + len(pair.surroundings))
        free = memory.in_file((size,))

        def stored(array: Array) -> Array:
            nonlocal free
            copy, free = free[: len(array)], free[len(array) :]
            copy[:] = array
            return copy

        pairs = [pair.with_arrays(stored) for pair in self]
        return replace(self, pairs=tuple(pairs))

    def take(self, numbers: Sequence[int]) -> PairSet:
        """Returns the pairs at these places; nothing is counted as left out."""
        pairs = [self.pairs[number] for number in numbers]
        return replace(self, pairs=tuple(pairs))

    def select(self, keep: Sequence[bool], reason: str) -> PairSet:
        """Keeps the pairs marked True and counts the others under `reason`."""
        selected = tuple(itertools.compress(self.pairs, keep))
        dropped = self.dropped
        if len(selected) < len(self.pairs):
            dropped = (*dropped, Dropped(reason, len(self.pairs) - len(selected)))
        return replace(self, pairs=selected, dropped=dropped)

    @property
    def dt(self) -> float:
        """The common time step, s.

        Raises:
            DataError: the pairs have different time steps.
        """
        steps = sorted({round(pair.dt, 9) for pair in self.pairs})
        if len(steps) != 1:
            in_words = ", ".join([f"{step:g} s" for step in steps])
            raise DataError(
                f"{self.source}: the pairs have different time steps ({in_words}); a job needs one:"
                " bring them to one with data.time_step, or split the file"
            )
        return steps[0]

    @property
    def surroundings(self) -> tuple[Signal, ...]:
        """The further signals, which every pair has.

        Raises:
            DataError: a pair has others than the first one.
        """
        signals: tuple[Signal, ...] = ()
        if self.pairs:
            signals = tuple(self.pairs[0].surroundings)
        for pair in self.pairs:
            if set(pair.surroundings) != set(signals):
                expected = ", ".join([signal.name for signal in signals]) or "none"
                raise DataError(
                    f"{self.source}: pair {pair.pair_id} has other further signals than the first"
                    f" pair ({expected}); give every pair the same"
                )
        return signals

    @property
    def fingerprint(self) -> str:
        """SHA-256 over all pairs, in order."""
        digest = hashlib.sha256()
        for pair in self.pairs:
            digest.update(pair.fingerprint.encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class PairBatch:
    """Pairs as padded tensors; those of many pairs lie in files (`cfx.core.memory`).

    Beyond its end a pair is continued at its last speed with zero acceleration, so that a rollout
    stays finite there; `mask` says what is real. Positions are relative to the follower's first
    position, so that float32 resolves millimetres on a road of any length.

    Attributes:
        leader_position ... follower_acceleration: `(P, T)`, SI units.
        leader_length: `(P,)`, m.
        lengths: `(P,)` int64, frames of each pair.
        mask: `(P, T)` bool, True within the pair.
        dt: time step, s.
        surroundings: further signals, `(P, T)` each; in place of a gap the position of what is
            ahead is stored, which does not depend on where the follower is (`Signal.seen_from`).
    """

    leader_position: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    follower_position: Tensor
    follower_speed: Tensor
    follower_acceleration: Tensor
    leader_length: Tensor
    lengths: Tensor
    mask: Tensor
    dt: float
    surroundings: Mapping[Signal, Tensor] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        pairs: PairSet | Sequence[Pair],
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
        frames: int = 0,
    ) -> PairBatch:
        """Stacks pairs; float64 on the CPU unless told otherwise.

        Args:
            pairs: of one time step.
            dtype: of the tables.
            device: of the tables.
            frames: for how many there is room at least.

        Raises:
            DataError: there are no pairs, or their time steps differ.
        """
        import torch

        if not len(pairs):
            raise DataError("no pairs to stack")
        if not isinstance(pairs, PairSet):
            pairs = PairSet(tuple(pairs), "pairs")
        dt, dtype = pairs.dt, dtype or torch.float64
        lengths = torch.tensor(frames_of_each(pairs.pairs))
        length = max(frames, int(lengths.max()))
        shape = (len(pairs), length)
        signals = {}
        for name in RECORDED:
            # Filled row by row: a list of rows would hold the signal twice.
            values = memory.empty(shape, together=len(RECORDED))
            for row, pair in zip(values, pairs, strict=True):
                row[:] = _extend(pair, name, length)
            signals[name] = torch.as_tensor(values).to(device=device, dtype=dtype)
        surroundings = {}
        for signal in pairs.surroundings:
            values = memory.empty(shape, together=len(pairs.surroundings))
            for row, pair in zip(values, pairs, strict=True):
                row[:] = _extended_surroundings(pair, signal, length)
            surroundings[signal] = torch.as_tensor(values).to(device=device, dtype=dtype)
        leader_lengths = of_each(pairs.pairs, "leader_length")
        mask = torch.as_tensor(memory.empty(shape, bool))
        torch.lt(torch.arange(length), lengths[:, None], out=mask)
        return cls(
            **signals,
            leader_length=torch.tensor(leader_lengths, dtype=dtype, device=device),
            lengths=lengths.to(device),
            mask=mask.to(device),
            dt=dt,
            surroundings=surroundings,
        )

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def gap(self) -> Tensor:
        """Bumper-to-bumper gap `(P, T)`, m."""
        return self.leader_position - self.leader_length[:, None] - self.follower_position

    def to(self, device: torch.device | str) -> PairBatch:
        """Returns the same pairs on a device."""
        import torch

        if self.lengths.device == torch.device(device):
            return self
        return self._changed(lambda values: values.to(device))

    def until(self, last: Tensor) -> PairBatch:
        """Returns the pairs without what comes after a frame of each, `(P,)`."""
        import torch

        frames = torch.arange(self.mask.shape[1], device=last.device)
        mask = self.mask & (frames <= last[:, None])
        return replace(self, lengths=last + 1, mask=mask).trimmed()

    def followed_by(self, other: PairBatch) -> PairBatch:
        """Returns these pairs and those of another batch with room for as many frames.

        Raises:
            DataError: only one of them has a further signal.
        """
        import torch

        if set(self.surroundings) != set(other.surroundings):
            names = {signal.name for signal in {*self.surroundings} ^ {*other.surroundings}}
            raise DataError(
                f"pairs with and without the signal {' and '.join(sorted(names))} cannot be used"
                " together; give it to all of them, or leave out the inputs of policies that read"
                " it"
            )

        def joined(ours: Tensor, theirs: Tensor) -> Tensor:
            return torch.cat([ours, theirs.to(ours)])

        changed: dict[str, Any] = {}
        for name in _TENSORS:
            changed[name] = joined(getattr(self, name), getattr(other, name))
        surroundings = {}
        for signal, values in self.surroundings.items():
            surroundings[signal] = joined(values, other.surroundings[signal])
        return replace(self, **changed, surroundings=surroundings)

    def trimmed(self) -> PairBatch:
        """Returns the same pairs without the frames that none of them has."""
        frames = int(self.lengths.max())
        signals: dict[str, Any] = {}
        for name in (*RECORDED, "mask"):
            signals[name] = getattr(self, name)[:, :frames]
        surroundings = {}
        for signal, values in self.surroundings.items():
            surroundings[signal] = values[:, :frames]
        return replace(self, **signals, surroundings=surroundings)

    def __getitem__(self, index: Any) -> PairBatch:
        """Selects pairs (a slice, an index tensor or a boolean mask over P); time stays whole."""
        chosen = self._changed(lambda values: _selected(values, index))
        memory.release()
        return chosen

    def _changed(self, change: Callable[[Tensor], Tensor]) -> PairBatch:
        """Returns these pairs with each of their tensors changed."""
        changed: dict[str, Any] = {}
        for name in _TENSORS:
            changed[name] = change(getattr(self, name))
        surroundings = {}
        for signal, values in self.surroundings.items():
            surroundings[signal] = change(values)
        return replace(self, **changed, surroundings=surroundings)


_TENSORS = (*RECORDED, "leader_length", "lengths", "mask")
"""The tensors of a batch, its surroundings apart."""


def _selected(values: Tensor, index: Any) -> Tensor:
    """Returns rows of values `(P, ...)`, in a file if they are many."""
    import torch

    is_copy = isinstance(index, torch.Tensor) and index.dtype == torch.int64 and values.ndim == 2
    if not is_copy or values.device.type != "cpu":
        return values[index]
    size = len(index) * values.shape[1] * values.itemsize
    if len(RECORDED) * size < memory.LARGE:
        return values[index]
    rows = memory.in_file((len(index), values.shape[1]), values[:0].numpy().dtype)
    return torch.index_select(values, 0, index, out=torch.as_tensor(rows))


def _extend(pair: Pair, name: str, length: int) -> Array:
    """Returns a signal `(length,)`, continued at constant speed; the follower starts at 0 m."""
    values = np.asarray(getattr(pair, name), dtype=np.float64)
    missing = length - len(values)
    tail: Array
    if name.endswith("position"):
        speed = getattr(pair, name.replace("position", "speed"))[-1]
        tail = values[-1] + speed * pair.dt * np.arange(1, missing + 1)
        origin = float(pair.follower_position[0])
    else:
        last = 0.0  # an acceleration
        if name.endswith("speed"):
            last = values[-1]
        tail = np.full(missing, last)
        origin = 0.0
    extended: Array = np.concatenate([values, tail]) - origin
    return extended


def _extended_surroundings(pair: Pair, signal: Signal, length: int) -> Array:
    """Returns a further signal `(length,)` as a batch stores it, continued beyond the end.

    What is ahead goes on at the leader's last speed, there is no acceleration, and everything else
    stays as it was.
    """
    values = np.asarray(pair.surroundings[signal], dtype=np.float64)
    beyond = np.arange(1, length - len(values) + 1)
    last = values[-1]
    if signal.quantity == "acceleration":
        last = 0.0
    tail: Array = np.full(len(beyond), last)
    if signal.quantity == "gap":
        values = values + pair.follower_position - float(pair.follower_position[0])
        tail = values[-1] + float(pair.leader_speed[-1]) * pair.dt * beyond
    extended: Array = np.concatenate([values, tail])
    return extended
