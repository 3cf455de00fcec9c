"""The contract of a dataset: recordings in, leader-follower pairs out."""

from __future__ import annotations

import itertools
import logging
import math
import re
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from cfx.core import memory, registry
from cfx.core.component import Component, Distinct, Settings
from cfx.core.files import absolute
from cfx.core.storage import is_url, local_copies
from cfx.data.accelerations import Accelerations, with_usable_accelerations
from cfx.data.check import Check, check_pairs
from cfx.data.files import FileStart, recording_of, stem
from cfx.data.known import with_known_types, with_names
from cfx.data.names import Name
from cfx.data.pairs import Dropped, Pair, PairSet, Remark, driver_names, of_each
from cfx.data.resampling import resampled, scaled
from cfx.data.signals import RECORDED
from cfx.data.sites import SiteNames, VehiclePattern
from cfx.data.tracks import totals_by_reason
from cfx.errors import DataError, PluginError, listed, nearest

log = logging.getLogger(__name__)


def _files(value: Any) -> Path | str | tuple[Path | str, ...]:
    """Returns one path, or several, as absolute ones; URLs as they are."""
    several = isinstance(value, list | tuple)
    written = [value]
    if several:
        written = value
    if not written:
        raise PydanticCustomError("path", "the list is empty; write at least one file")
    paths: list[Any] = []
    for path in written:
        if not isinstance(path, str | Path | None):
            raise PydanticCustomError(
                "path", "write a file, a list of files, or a pattern such as 'i-80/*.txt'"
            )
        if is_url(path):
            paths.append(path)
        else:
            paths.append(absolute(path))
    if several:
        return tuple(paths)
    only: Path | str = paths[0]
    return only


FilePaths = Annotated[Path | str | tuple[Path | str, ...], BeforeValidator(_files)]
"""One or several paths or URLs that a user writes.

`~` is their home, and a relative path starts at the working directory.
"""


class DatasetSettings(Settings):
    """Settings that all datasets have: which pairs to select."""

    check: Check = Field(
        "drop_few",
        description="pairs whose positions, speeds, accelerations and gaps contradict one another,"
        " as with a wrong unit or time step: drop_few: they are left out if they are fewer than one"
        " in twenty, else the job ends; drop: they are left out, however many; refuse: the job"
        " ends; report: they are used, with a warning; off: not checked. A file whose columns"
        " contradict one another as a whole ends the job but with report and off",
    )
    min_duration: float = Field(
        10.0,
        ge=0,
        description="s: shortest pair that is kept, of as many frames as this holds time steps; 0:"
        " all; the paper keeps pairs of 70 s",
    )
    time_step: float | None = Field(
        None,
        ge=0.001,
        le=10.0,
        description="s: bring all pairs to this step, in which windows and policies count too;"
        " null: as recorded",
    )
    recording: Name | None = Field(None, description="keep this recording alone; null: all")
    site: SiteNames = Field(
        None,
        description="the road or area of the recordings: one name for all, or names by patterns of"
        " recordings or files, such as {i80-*: I-80}; null: what the source says, or else, where"
        " several files are read, the road of a public recording that is known by its name, or the"
        " file's name",
    )
    vehicle: VehiclePattern | None = Field(
        None,
        description="a regular expression whose group finds, in a follower's id, the name that its"
        " vehicle keeps over recordings, such as '^[0-9]+-(.+)$'; null: what the source says, or"
        " what is known of a public recording",
    )
    lanes: Distinct[list[int] | None] = Field(
        None, description="keep pairs in these lanes alone; null: all"
    )
    pair_ids: Distinct[list[Name] | None] = Field(
        None, description="keep these pairs alone, by their ids; null: all"
    )
    driver_type: Name | None = Field(
        None,
        description="keep followers of this type alone, as the recording labels them: human, acc,"
        " automated, truck, a vType; NGSIM's are human; null: all",
    )
    leader_driver_type: Name | None = Field(
        None, description="keep pairs behind leaders of this type alone; null: all"
    )
    max_pairs: int | None = Field(None, ge=1, description="keep the first so many pairs; null: all")
    scale: float = Field(
        1.0,
        gt=0,
        le=10,
        description="factor on all distances, speeds and accelerations, vehicles' lengths excepted:"
        " shows what becomes of policies beyond what they were recorded at",
    )


class FileDatasetSettings(DatasetSettings):
    """Settings of datasets that read a file."""

    path: FilePaths = Field(
        description="the file to read, a list of files, or a pattern such as 'i-80/*.txt';"
        " ~, relative paths and URLs such as s3://bucket/file work"
    )
    accelerations: Accelerations = Field(
        "smooth",
        description="smooth: accelerations that are mostly noise are replaced by the average of"
        " their past that best predicts the speed; recorded: all as recorded",
    )

    def files(self) -> list[Path]:
        """Returns the files in the order in which they are written.

        The files of a pattern are sorted by name. Those behind URLs are copied to this machine.

        Raises:
            DataError: no file matches a pattern, or a file is named twice.
        """
        written = self.path
        if isinstance(written, Path | str):
            written = (written,)
        files: list[Path] = []
        for path in written:
            for file in matching(path):
                if file in files:
                    raise DataError(
                        f"data.path: {file} is named more than once; name each file once"
                    )
                files.append(file)
        return files


_PATTERN = re.compile(r"[*?\[]")
"""What makes a path a pattern of file names."""


def matching(path: Path | str) -> list[Path]:
    """Returns the files that a path, a URL or a pattern stands for, sorted by name."""
    if isinstance(path, str):
        return local_copies(path)
    if path.exists() or not _PATTERN.search(str(path)):
        return [path]
    files = []
    for file in Path(path.anchor).glob(str(path.relative_to(path.anchor))):
        if file.is_file():
            files.append(file)
    if not files:
        raise DataError(f"data.path={path}: no file matches this pattern")
    return sorted(files)


class Contents(NamedTuple):
    """A file's pairs, and what the pairs do not show, for `data describe`.

    Attributes:
        rows: of the file.
        vehicles: how many there are, over all recordings.
        problem: a sentence on what a user should know before they use it; "" if there is none.
        has_gaps: the file gives gaps, which do not depend on vehicles' lengths.
        unnamed: what has no ids in the file, in words that follow "vehicles"; "" if all have.
    """

    pairs: PairSet
    rows: int
    vehicles: int
    problem: str = ""
    has_gaps: bool = False
    unnamed: str = ""


class Dataset(Component):
    """Base of every dataset.

    Life cycle: constructed once per job; `load` is called once, calls `read`, and selects.

    A subclass implements `read`. Its settings extend `DatasetSettings`. One that reads files tells
    `data describe` about its layout by `layout` and `recognises`.

    Attributes:
        layout: what the layout is called, units included; "" for a dataset that reads no files.
    """

    kind = "dataset"
    layout: ClassVar[str] = ""
    schema: ClassVar[type[Settings]] = DatasetSettings
    settings: DatasetSettings

    @classmethod
    def recognises(cls, start: FileStart) -> bool:  # noqa: ARG003 - what overrides look at
        """Says whether a file is in this dataset's layout, from its beginning alone."""
        return False

    def contents(self) -> Contents:
        """Returns everything in the file, before any selection.

        Raises:
            DataError: as `read`.
        """
        pairs = self.read()
        vehicles = set()
        for pair in pairs:
            vehicles.add((pair.recording, pair.leader_id))
            vehicles.add((pair.recording, pair.follower_id))
        return Contents(pairs, pairs.frames, len(vehicles))

    def units(self) -> Mapping[str, str]:
        """Returns the units that the source is said to have in place of SI units.

        `speed`, `position`, `acceleration`, `leader_speed` and so on, `gap` and `time` are keys.
        """
        return {}

    @abstractmethod
    def read(self) -> PairSet:
        """Returns every pair found, in a fixed order, with a count of whatever it had to leave out.

        Raises:
            DataError: the source is missing, cannot be read, or holds what no recording can hold.
        """

    def load(self) -> PairSet:
        """Returns the pairs that the settings select.

        They are selected by recording, lane, id, what drives them, and duration, after they were
        brought to `time_step`; of those the first `max_pairs` are kept. Short ones are warned of.

        Raises:
            DataError: as `read`; or the recording, a pair id or a type of driver is unknown, the
                source has no lanes, too few pairs remain, or some contradict themselves.
            PluginError: `read` gives anything but pairs of finite numbers.
        """
        pairs = self.read()
        memory.give_back()
        self._check(pairs)
        if not len(pairs):
            reasons = []
            for dropped in pairs.dropped:
                reasons.append(f"{dropped.count:,} {dropped.unit}: {dropped.reason}")
            why = ""
            if reasons:
                why = f" (left out: {'; '.join(reasons)})"
            raise DataError(f"{pairs.source}: no leader-follower pair found{why}")
        pairs = with_names(pairs, self.settings.site, self.settings.vehicle)
        if self.settings.driver_type is not None or self.settings.leader_driver_type is not None:
            pairs = with_known_types(pairs)
        for name in _NOUNS:
            pairs = _selected(pairs, name, getattr(self.settings, name))
        recorded = dict(zip(of_each(pairs, "pair_id"), pairs, strict=True))
        if self.settings.time_step is not None:
            pairs = resampled(pairs, self.settings.time_step)
            if not len(pairs):
                raise DataError(
                    f"data.time_step={self.settings.time_step:g}: no pair in {pairs.source} lasts"
                    " two such steps; give a shorter one"
                )
        selected = _select_first(_select_long(pairs, self.settings.min_duration), self.settings)
        as_recorded = [recorded[pair.pair_id] for pair in selected.pairs]
        verdict = check_pairs(
            replace(selected, pairs=tuple(as_recorded)),
            self.settings.check,
            self.units(),
            can_say_units=hasattr(self.settings, "units"),
        )
        left_out = frozenset(verdict.left_out)
        is_coherent = [pair.pair_id not in left_out for pair in selected.pairs]
        selected = selected.select(is_coherent, verdict.reason)
        if isinstance(self.settings, FileDatasetSettings):
            selected = with_usable_accelerations(selected, self.settings.accelerations)
        return scaled(selected, self.settings.scale)

    def _check(self, pairs: Any) -> None:
        """Raises PluginError unless these are pairs of finite numbers."""
        if not isinstance(pairs, PairSet):
            raise PluginError(
                f"{registry.origin(self)}: read must return a cfx.plugin.PairSet,"
                f" but returned a {type(pairs).__name__}"
            )
        for pair in pairs:
            for name in RECORDED:
                if not bool(np.isfinite(getattr(pair, name)).all()):
                    raise PluginError(
                        f"{registry.origin(self)}: pair {pair.pair_id} has a {name} that is not"
                        " finite; a dataset splits or leaves out what has gaps"
                    )
            for signal, values in pair.surroundings.items():
                if not bool(np.isfinite(values).all()):
                    raise PluginError(
                        f"{registry.origin(self)}: pair {pair.pair_id} has a {signal.name} that is"
                        " not finite; a dataset splits or leaves out what has gaps"
                    )


def joined(files: Iterable[PairSet]) -> PairSet:
    """Returns the pairs of several files as one set, in their order.

    Of several files each is a site of its own name, unless it says otherwise. What was left out for
    the same reason is counted together. Where there are many pairs, their signals are moved into
    temporary files (`cfx.core.memory`), so that memory holds those of one file.

    Args:
        files: read one after the other.

    Raises:
        DataError: a pair stands in two of the files, by its id or by its content, however it is
            called: a driver who counts twice would be learned from and tested.
        OutputError: the disk of temporary files is full.
    """
    parts = _compact(files)
    if len(parts) == 1:
        return parts[0]
    for number, part in enumerate(parts):
        parts[number] = _at_site(part)
    _require_different(parts)
    pairs: list[Pair] = []
    dropped: list[Dropped] = []
    ends: list[Dropped] = []
    remarks: list[Remark] = []
    for part in parts:
        pairs += part
        dropped += part.dropped
        ends += part.ends
        for remark in part.remarks:
            remarks.append(replace(remark, text=f"{part.source}: {remark.text}"))
    sources = listed([part.source for part in parts], 3)
    return PairSet(
        tuple(pairs),
        f"{len(parts)} files ({sources})",
        totals_by_reason(dropped),
        totals_by_reason(ends),
        tuple(remarks),
    )


def _at_site(part: PairSet) -> PairSet:
    """Returns the pairs of a file; its name stands in for a site that is not known."""
    file = Path(part.source)
    if recording_of(file) is not None:
        return part
    pairs = []
    for pair in part.pairs:
        if pair.site:
            pairs.append(pair)
        else:
            pairs.append(replace(pair, site=stem(file)))
    return replace(part, pairs=tuple(pairs))


def _compact(files: Iterable[PairSet]) -> list[PairSet]:
    """Returns the pairs of each file; where there are many, their signals lie in files."""
    parts: list[PairSet] = []
    size = moved = 0
    for part in files:
        parts.append(part)
        size += part.size
        if size >= memory.LARGE:
            for number in range(moved, len(parts)):
                parts[number] = parts[number].in_file()
            moved = len(parts)
            memory.give_back()
    return parts


def _require_different(parts: Sequence[PairSet]) -> None:
    """Raises DataError if a pair stands in two of the files."""
    sources: dict[str, tuple[str, str]] = {}
    for part in parts:
        sources_of_part: dict[str, tuple[str, str]] = {}
        for pair in part:
            for key in (pair.pair_id, pair.content):
                if key in sources:
                    source, name = sources[key]
                    name_there = ""
                    if name != pair.pair_id:
                        name_there = f", there '{pair.pair_id}',"
                    raise DataError(
                        f"{source} and {part.source}: pair '{name}'{name_there} stands in both"
                        " files; leave it out of one of them"
                    )
                sources_of_part[key] = (part.source, pair.pair_id)
        sources |= sources_of_part


_NOUNS = {
    "recording": "recording",
    "lanes": "lane",
    "pair_ids": "pair",
    "driver_type": "type",
    "leader_driver_type": "type",
}
"""What the settings that select pairs by a value name."""


_UNLABELLED = {
    "lanes": "in which lane they are",
    "driver_type": "what drives the follower",
    "leader_driver_type": "what drives the leader",
}
"""What some pairs do not say, by the setting that selects by it."""


def _selected(pairs: PairSet, name: str, setting: Any) -> PairSet:
    """Keeps the pairs that a setting names, one value or a list of them; all where it is None."""
    if setting is None:
        return pairs
    attribute = {"lanes": "lane", "pair_ids": "pair_id"}.get(name, name)
    values = of_each(pairs, attribute)
    recorded = list(dict.fromkeys(values))
    for blank in (None, ""):
        if blank in recorded:
            recorded.remove(blank)
    if not recorded:
        unsaid = _UNLABELLED.get(name, "what its pairs are called")
        raise DataError(
            f"data.{name}={setting}: {pairs.source} does not say {unsaid}; leave data.{name} out"
        )
    chosen = [setting]
    others = f"another {name} than '{setting}'"
    if isinstance(setting, list):
        chosen = setting
        others = f"other {name} than {listed(chosen)}"
    if name == "pair_ids":
        others = "other pairs than data.pair_ids"
    mistake = ""
    if not chosen:
        mistake = "the list is empty."
    for value in chosen:
        if value not in recorded:
            near = nearest(str(value), [str(other) for other in recorded])
            mistake = f"there is no {_NOUNS[name]} '{value}'.{near}"
            break
    if mistake:
        raise DataError(
            f"data.{name}={setting}: {pairs.source}: {mistake} Known: {listed(recorded)}."
        )
    if name in _UNLABELLED:
        is_labelled = [value not in {None, ""} for value in values]
        unlabelled = len(values) - sum(is_labelled)
        if unlabelled:
            log.warning(
                "%s: of %d of %d pairs it is not said %s; they are left out (data.%s=%s)",
                pairs.source,
                unlabelled,
                len(values),
                _UNLABELLED[name],
                name,
                setting,
            )
        pairs = pairs.select(is_labelled, f"of which it is not said {_UNLABELLED[name]}")
        values = list(itertools.compress(values, is_labelled))
    return pairs.select([value in chosen for value in values], others)


def _select_long(pairs: PairSet, min_duration: float) -> PairSet:
    """Keeps the pairs that last at least so many seconds, and warns of the others."""
    is_long, durations = [], []
    for pair in pairs:
        is_long.append(pair.lasts(min_duration))
        durations.append(pair.duration)
    long = pairs.select(is_long, f"shorter than {min_duration:g} s")
    if not len(long):
        longest = max(durations)
        raise DataError(
            f"{pairs.source}: none of its {len(pairs)} pairs lasts {min_duration:g} s, the longest"
            f" lasts {longest:.6g} s; lower data.min_duration"
        )
    short = len(pairs) - len(long)
    if short:
        log.warning(
            "%s: %d of %d pairs are left out, which last less than data.min_duration=%g s;"
            " data.min_duration=%g keeps all",
            pairs.source,
            short,
            len(pairs),
            min_duration,
            rounded_down(min(durations)),
        )
    return long


def rounded_down(duration: float) -> float:
    """Returns a duration, s, to write into a setting: in tenths, and no longer than this one."""
    return math.floor(10.0 * duration + 1e-6) / 10.0


def _select_first(pairs: PairSet, settings: DatasetSettings) -> PairSet:
    count = settings.max_pairs
    if count is None or len(pairs) == count:
        return pairs
    if len(pairs) < count:
        where = ""
        if settings.recording or settings.lanes:
            where = " in the selected recording and lanes"
        raise DataError(
            f"{pairs.source}: asked for {count} pairs but only {len(pairs)} last"
            f" {settings.min_duration:g} s{where}; lower data.max_pairs or data.min_duration"
        )
    beyond = Dropped(f"beyond max_pairs ({count})", len(pairs) - count)
    return replace(pairs, pairs=pairs.pairs[:count], dropped=(*pairs.dropped, beyond))


def load_pairs(dataset: Dataset) -> PairSet:
    """Returns all pairs of a dataset, and says what they are."""
    pairs = dataset.load()
    drivers = len(driver_names(pairs))
    log.info("%d pairs of %d drivers from %s", len(pairs), drivers, pairs.source)
    return pairs
