"""What a suite of the benchmark fixes: recordings, who is learned from, what is asked, and a hash.

Shapes: P pairs. SI units.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from torch import Tensor

import cfx
from cfx.errors import DataError, nearest
from cfx.plugin import Pair, PairSet, folds


@dataclass(frozen=True)
class Scheme:
    """How drivers are divided, so that nothing of a tested driver is learned from.

    Attributes:
        name: of the files that belong to it.
        together: what a fold keeps together, as `protocol.together`.
        folds: how many; None: each is left out once.
    """

    name: str
    together: folds.Together
    folds: int | None


Kind = Literal["full", "last_part", "forecast"]


@dataclass(frozen=True)
class Task:
    """One question.

    Attributes:
        name: in files and tables.
        title: for people.
        scheme: who is learned from.
        kind: `full`: whole trajectories from their first frame; `last_part`: the last fifth, with
            what was before; `forecast`: from many moments, with the seconds before.
    """

    name: str
    title: str
    scheme: str
    kind: Kind


@dataclass(frozen=True)
class Site:
    """Drivers of one kind on one road, who count once.

    Attributes:
        name: for people.
        recording: a regular expression that the names of its recordings match from the first
            letter on.
        driver_type: of its drivers; "": any.
    """

    name: str
    recording: str
    driver_type: str


JOB = (
    "data=tidy",
    "data.min_duration=0",
    "data.accelerations=recorded",
    "data.check=off",
    "protocol=across_drivers",
    "protocol.base=pooled",
    "protocol.history=0.0",
    "protocol.histories=[]",
    "windows.length=5",
    "windows.stride=5",
    "simulator=memory",
    "dtype=float64",
    "metrics=[rmse_speed,rmse_gap,collisions]",
)
"""What every job of a suite has. The pairs were checked, and noisy accelerations replaced, when the
suite read them."""


@dataclass(frozen=True)
class Suite:
    """A frozen protocol over recordings.

    Attributes:
        name: as after `--suite`.
        version: another one begins whenever anything here changes.
        files: as they are called in the folder that `--data` names.
        sites: the first that fits a pair counts; pairs that none fits are left out.
        min_duration: s, of a pair.
        longest: so many pairs of each driver at a site are used, the longest ones.
        last_part: share of a trajectory that `last_part` tests.
        horizons: of forecasts, s.
        past_s: s before the moment of a forecast that may be read.
        every_s: s between moments.
        samples: of a stochastic forecast.
        fingerprint: of the pairs.
        about: what they are, in words.
        baseline, baseline_words: the row that scores are relative to, and what gives it.
        min_test_duration: s that a tested pair lasts; shorter ones are only learned from. None:
            all are tested.
        job: overrides of the jobs of cfx's own methods, besides those of a scheme.
    """

    name: str
    version: str
    files: tuple[str, ...]
    sites: tuple[Site, ...]
    schemes: tuple[Scheme, ...]
    tasks: tuple[Task, ...]
    fingerprint: str
    about: str
    min_duration: float = 30.0
    longest: int = 5
    last_part: float = 0.2
    horizons: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
    past_s: float = 10.0
    every_s: float = 10.0
    samples: int = 50
    baseline: str = "idm, constant"
    baseline_words: tuple[str, ...] = ("model=idm",)
    min_test_duration: float | None = None
    job: tuple[str, ...] = JOB

    @property
    def protocol(self) -> str:
        """Version and hash of everything that is fixed."""
        return self.protocol_of(self.fingerprint)

    def protocol_of(self, fingerprint: str) -> str:
        """Returns version and hash on pairs of this fingerprint."""
        fixed = {**asdict(self), "fingerprint": fingerprint}
        del fixed["about"]
        text = json.dumps(fixed, sort_keys=True)
        return f"{self.version}/{hashlib.sha256(text.encode()).hexdigest()[:12]}"

    def site_of(self, pair: Pair) -> str:
        """Returns the name of a pair's site; "" where it belongs to none."""
        for site in self.sites:
            fits = site.driver_type in {"", pair.driver_type}
            if fits and re.match(site.recording, pair.recording):
                return site.name
        return ""

    def scheme(self, name: str) -> Scheme:
        """Returns a scheme by its name."""
        return next(scheme for scheme in self.schemes if scheme.name == name)

    def task(self, name: str) -> Task:
        """Returns a task by its name.

        Raises:
            DataError: there is none.
        """
        for task in self.tasks:
            if task.name == name:
                return task
        names = [task.name for task in self.tasks]
        raise DataError(
            f"task '{name}': {self.version} has no such task.{nearest(name, names)} Known:"
            f" {', '.join(names)}"
        )

    def tasks_of(self, scheme: Scheme) -> list[Task]:
        """Returns the tasks that a scheme's drivers are tested in."""
        return [task for task in self.tasks if task.scheme == scheme.name]

    def load(self, folder: Path, *, other_data: bool = False) -> PairSet:
        """Reads the pairs, and compares them with the frozen ones.

        Args:
            folder: with the files; of a suite that needs one file also that file.
            other_data: whether pairs other than the frozen ones are allowed.

        Raises:
            DataError: a file is missing, or they are other pairs.
        """
        read = cfx.read(self.paths(folder), dataset="tidy", min_duration=self.min_duration).selected
        pairs = self.selected(read)
        if pairs.fingerprint != self.fingerprint and not other_data:
            raise DataError(
                f"{folder}: holds other pairs than {self.version}'s: their fingerprint is"
                f" {pairs.fingerprint[:12]} instead of {self.fingerprint[:12]}. Errors on other"
                " pairs do not compare; with --other-data the row is made and marked"
            )
        return pairs

    def paths(self, folder: Path) -> list[Path]:
        """Returns the files.

        Raises:
            DataError: one is missing.
        """
        if folder.is_file() and len(self.files) == 1:
            return [folder]
        for file in self.files:
            if not (folder / file).is_file():
                raise DataError(
                    f"{folder}: {file} is missing; {self.version} needs {', '.join(self.files)}"
                    " (docs/benchmark.md says where they come from)"
                )
        return [folder / file for file in self.files]

    def selected(self, pairs: PairSet) -> PairSet:
        """Returns the pairs that belong to a site, the longest ones of each driver."""
        labelled = []
        for pair in pairs:
            # The recordings that label nobody are of people: NGSIM's.
            labelled.append(replace(pair, driver_type=pair.driver_type or "human"))
        of_driver: dict[tuple[str, str], list[Pair]] = defaultdict(list)
        for pair in labelled:
            site = self.site_of(pair)
            if site:
                of_driver[site, pair.driver].append(pair)
        kept: set[str] = set()
        for theirs in of_driver.values():
            theirs.sort(key=lambda pair: (-len(pair), pair.pair_id))
            kept.update(pair.pair_id for pair in theirs[: self.longest])
        chosen = [pair for pair in labelled if pair.pair_id in kept]
        return PairSet(tuple(chosen), self.version)

    def sites_of(self, pairs: Sequence[Pair]) -> list[str]:
        """Returns the site of each pair."""
        return [self.site_of(pair) for pair in pairs]

    def folds_of(self, pairs: PairSet, scheme: Scheme, seed: int) -> Tensor:
        """Returns the fold in which each pair is tested, `(P,)`; see `cfx.plugin.folds`."""
        return folds.assign_folds(
            pairs, scheme.folds, scheme.together, self.min_test_duration, seed=seed
        )

    def tested(self, pairs: PairSet) -> PairSet:
        """Returns the pairs that some fold tests."""
        if self.min_test_duration is None:
            return pairs
        shortest = self.min_test_duration
        return replace(pairs, pairs=tuple(pair for pair in pairs if pair.lasts(shortest)))
