"""Drivers never seen: k-fold cross-validation over the drivers."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from sklearn.model_selection import GroupKFold
from torch import Tensor

from cfx.calibration.calibrator import Labels
from cfx.calibration.windows import Split
from cfx.component import Settings
from cfx.errors import DataError
from cfx.evaluation.closed_loop import drive
from cfx.evaluation.metrics import evaluate
from cfx.learners.base import Learned, Lesson
from cfx.pairs import Pair, PairSet
from cfx.policies.default import DefaultPolicy
from cfx.policies.fixed import FixedPolicy
from cfx.policies.trained import ALL, TrainedPolicy
from cfx.protocols.base import Outcome, Protocol, Study

log = logging.getLogger(__name__)


class AcrossDriversSettings(Settings):
    """Settings of `across_drivers`."""

    folds: int = Field(5, ge=2, description="parts that the drivers are divided into; each is tested once")
    together: Literal["driver", "platoon"] = Field(
        "driver",
        description="what a fold keeps together: driver: all pairs of one follower; platoon: also all who follow each other",
    )


class AcrossDrivers(Protocol):
    """The paper's experiment on clusters: a policy is trained on some drivers and drives as others, whom it never saw.

    The drivers are divided into k folds. For each, a network is trained and one parameter set, `population`, is calibrated
    jointly on the whole drives of all other drivers. Then default, population, the driver's own fixed parameters (from the
    first 80 % of his drive) and the policy drive the last 20 % of each test drive. The policy has read the measured first part
    before, and learned nothing from it. Default, population and policy also drive each test drive whole, from its first frame.

    All folds train as one batch of networks. One more network, `all`, learns from every driver: it is tested on nobody, and is
    what the saved policy uses for drivers of other recordings.

    No driver is, as follower, in both training and test. A vehicle may be follower in one pair and leader in another: its
    recorded drive as leader is only what others react to, so such pairs are kept, and counted (`data.json`, and a line in the
    log). `together=platoon` puts all who follow one another into one fold, where even that cannot happen.

    Differences from the paper: the paper's baseline is `population`; the driver's own set is the stronger one. It says nothing of
    how folds are drawn; here by a shuffle that `seed` determines.
    """

    schema: ClassVar[type[Settings]] = AcrossDriversSettings
    settings: AcrossDriversSettings

    def run(self, study: Study) -> Outcome:
        pairs, batch = study.pairs, study.batch
        device = batch.lengths.device
        fold = self.folds(pairs, seed=study.seed)
        # Row k: the pairs that network k learns from; the last network learns from all.
        members = torch.cat([torch.stack([fold != k for k in range(self.settings.folds)]), torch.ones(1, len(pairs)).bool()])
        notes = _overlap(pairs, fold)
        split, whole = Split.of(pairs, study.windows, study.split), Split.none(pairs, study.windows)
        fixed = study.calibrator.fixed(pairs, batch, split.frame)
        population = study.calibrator.population(pairs, batch, whole.frame, members)
        labels = study.labels(whole.windows, fixed)
        names = (*(f"fold {k}" for k in range(self.settings.folds)), ALL)
        policy, learned = self._learn(study, whole, members, population, labels, names)

        network = fold.to(device)
        own = torch.arange(len(pairs), device=device)
        first, start = split.frame.to(device), torch.zeros_like(own)
        strangers = {
            "default": study.constant(DefaultPolicy(), population),
            "population": study.constant(FixedPolicy(), population),
            "policy": policy,
        }
        loops = {name: drive(study.simulator, one, batch, first, network) for name, one in strangers.items()}
        loops["fixed"] = drive(study.simulator, study.constant(FixedPolicy(), fixed), batch, first, own)
        whole_loops = {name: drive(study.simulator, one, batch, start, network) for name, one in strangers.items()}
        evaluation = evaluate(
            pairs, batch, first, loops, policy.space, study.style, seed=study.seed, fold=fold, whole=whole_loops
        )
        return Outcome(evaluation, policy, learned.curves, labels, notes)

    def folds(self, pairs: PairSet, *, seed: int) -> Tensor:
        """Returns in which fold each pair is tested, `(P,)` int64.

        Raises:
            DataError: there are fewer drivers (or platoons) than folds.
        """
        groups = _platoons(pairs) if self.settings.together == "platoon" else [pair.driver for pair in pairs]
        found = len(set(groups))
        if found < self.settings.folds:
            what = f"platoon{'s' * (found != 1)}" if self.settings.together == "platoon" else f"driver{'s' * (found != 1)}"
            raise DataError(
                f"protocol.folds={self.settings.folds}: {pairs.source} has only {found} {what} here; lower protocol.folds"
                f" (2 at least) or use more pairs"
            )
        fold = torch.full((len(pairs),), -1)
        splitter = GroupKFold(self.settings.folds, shuffle=True, random_state=seed)
        for number, (_, tested) in enumerate(splitter.split(np.zeros(len(pairs)), groups=groups)):
            fold[torch.as_tensor(tested)] = number
        return fold

    def _learn(
        self, study: Study, whole: Split, members: Tensor, population: Tensor, labels: Labels | None, names: tuple[str, ...]
    ) -> tuple[TrainedPolicy, Learned]:
        """Trains a network for each row of `members` `(K, P)` on these pairs' whole drives."""
        if not study.policy.trainable:
            learned = study.untrained(study.policy, population)
            return study.ready(study.policy, learned, names), learned
        network, index = members.nonzero().unbind(1)
        device = study.batch.lengths.device
        lesson = Lesson(
            simulator=study.simulator,
            batch=study.batch[index.to(device)],
            split=whole[index],
            windows=study.windows,
            fixed=population[network.to(device)],
            labels=labels.select(index) if labels is not None else None,
            network=network.to(device),
            names=names,
            seed=study.seed,
        )
        learned = study.learner.fit(study.policy, lesson)
        return study.ready(study.policy, learned, names), learned


def _platoons(pairs: Sequence[Pair]) -> list[int]:
    """Numbers the platoon of each pair: vehicles of a recording that follow one another, directly or through others."""
    names = [(f"{pair.recording}/{pair.leader_id}", pair.driver) for pair in pairs]
    number = {name: index for index, name in enumerate(sorted({vehicle for both in names for vehicle in both}))}
    edges = np.array([[number[leader], number[follower]] for leader, follower in names]).T
    graph = coo_array((np.ones(len(names)), (edges[0], edges[1])), shape=(len(number), len(number)))
    _, platoon = connected_components(graph, directed=False)
    return [int(platoon[number[follower]]) for _, follower in names]


def _overlap(pairs: PairSet, fold: Tensor) -> dict[str, Any]:
    """Counts the vehicles that stand on both sides of a fold, though never as followers; says so in the log."""
    led = [f"{pair.recording}/{pair.leader_id}" for pair in pairs]
    of_driver = {pair.driver: int(k) for pair, k in zip(pairs, fold, strict=True)}
    behind_trained = sum(leader in of_driver and of_driver[leader] != int(k) for leader, k in zip(led, fold, strict=True))
    seen_as_leader = {leader for leader, k in zip(led, fold, strict=True) if leader in of_driver and of_driver[leader] != int(k)}
    drivers = len(of_driver)
    log.info(
        "%d folds over %d drivers; %d of %d test pairs follow a driver of the training part, %d test drivers lead one there",
        int(fold.max()) + 1,
        drivers,
        behind_trained,
        len(pairs),
        len(seen_as_leader),
    )
    return {
        "folds": int(fold.max()) + 1,
        "drivers": drivers,
        "drivers_per_fold": [len({d for d, k in of_driver.items() if k == number}) for number in range(int(fold.max()) + 1)],
        "test_pairs_behind_a_training_driver": behind_trained,
        "test_drivers_who_lead_a_training_pair": len(seen_as_leader),
    }
