"""Drivers never seen: k-fold cross-validation over the drivers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from sklearn.model_selection import GroupKFold
from torch import Tensor

from cfx.agents.agent import Agent
from cfx.agents.context import ContextRule
from cfx.agents.heads.offset import shrunk
from cfx.agents.placement import ALL
from cfx.calibration.calibrator import Labels
from cfx.calibration.windows import Split
from cfx.component import Settings
from cfx.errors import DataError
from cfx.learners.base import TrainingData, TrainingResult
from cfx.pairs import Pair, PairSet
from cfx.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.protocols.held_out import HeldOut

log = logging.getLogger(__name__)


class AcrossDriversSettings(Settings):
    """Settings of `across_drivers`."""

    folds: int = Field(
        5, ge=2, description="parts that the drivers are divided into; each is tested once"
    )
    together: Literal["driver", "platoon", "recording"] = Field(
        "driver",
        description="what a fold keeps together: driver: all pairs of one follower; platoon: also all who follow each other;"
        " recording: all drivers of a recording, so that whole recordings are tested which nobody learned from",
    )
    min_test_frames: int | None = Field(
        None,
        ge=1,
        description="frames a pair must have to be tested; shorter ones are only learned from; null: all are tested",
    )
    base: Literal["own", "population", "default"] = Field(
        "own",
        description="what a policy of offsets starts from, for a driver whose history it has read: his own fixed parameters, the"
        " population's, or the model's default ones; for unseen drivers it is the population's, or the default ones",
    )
    shrinkage: float = Field(
        0.7,
        ge=0,
        le=1,
        description="how far a driver's own set, as such a base, is drawn towards the model's default parameters (in the squashed"
        " space); 0: not at all. The baseline `fixed` is never drawn.",
    )
    history: float | None = Field(
        None,
        ge=0,
        description="s of measured history before the test part that the policy reads; null: all there is",
    )
    histories: tuple[float, ...] = Field(
        (0.0, 10.0, 30.0),
        description="s: other amounts of history to compare, for policies of offsets; empty: none",
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
    `together=recording` asks the harder question: whether what was learned holds on another day, road or data set.

    Differences from the paper: the paper's baseline is `population`; the driver's own set is the stronger one. It says nothing of
    how folds are drawn; here by a shuffle that `seed` determines.
    """

    schema: ClassVar[type[Settings]] = AcrossDriversSettings
    settings: AcrossDriversSettings

    def run(self, context: ProtocolContext) -> ProtocolResult:
        pairs, batch = context.pairs, context.batch
        fold = self.folds(pairs, seed=context.seed)
        # Row k: the pairs that network k learns from; the last network learns from all.
        numbers = torch.arange(self.settings.folds + 1)[:, None]
        members = ((fold != numbers) & (fold != -2 - numbers)) | (numbers == self.settings.folds)
        notes = _overlap(pairs, fold, apart=self.settings.together == "recording")
        split, whole = (
            Split.of(pairs, context.windows, context.split),
            Split.none(pairs, context.windows),
        )
        fixed = context.calibrator.fixed(pairs, batch, split.frame)
        population = context.calibrator.population(pairs, batch, whole.frame, members)
        labels = context.labels(whole.windows, fixed)
        names = (*(f"fold {k}" for k in range(self.settings.folds)), ALL)
        default = context.space.defaults(
            dtype=population.dtype, device=population.device
        ).expand_as(population)
        strange = default if self.settings.base == "default" else population
        own = (
            shrunk(context.simulator.model.adaptation_space, fixed, self.settings.shrinkage)
            if self.settings.base == "own"
            else None
        )
        policy, training_result = self._learn(context, whole, members, strange, own, labels, names)
        policy = replace(policy, population=population)

        tested = (fold >= 0).nonzero()[:, 0]
        test = HeldOut(
            context=context,
            pairs=replace(pairs, pairs=tuple(pairs[int(number)] for number in tested)),
            batch=batch[tested.to(batch.lengths.device)],
            network=fold[tested].to(batch.lengths.device),
            first=split.frame[tested].to(batch.lengths.device),
            fixed=fixed[tested.to(fixed.device)],
            base=own[tested.to(fixed.device)] if own is not None else None,
            strange=strange[fold[tested].to(strange.device)],
            population=population,
            policy=policy,
        )
        evaluation = test.evaluation(self.settings.histories, fold=fold[tested])
        calibration = context.calibration_metrics("fixed", split.frame, fixed)
        calibration |= context.calibration_metrics("population", whole.frame, population, members)
        return ProtocolResult(
            evaluation, policy, training_result.curves, labels, notes, calibration=calibration
        )

    def folds(self, pairs: PairSet, *, seed: int) -> Tensor:
        """Returns in which fold each pair is tested, `(P,)` int64; -1 for a pair that is only learned from.

        Pairs that are too short to be tested do not change the folds of the others. Where their driver (or platoon) is tested
        with another pair, they belong to the same fold, as number `-2 - fold`, so that nobody of that fold learns from them.

        Raises:
            DataError: there are fewer drivers (platoons, recordings) than folds.
        """
        together = self.settings.together
        groups = _GROUPS[together](pairs)
        least = self.settings.min_test_frames or 0
        tested = [number for number, pair in enumerate(pairs) if len(pair) >= least]
        found = len({groups[number] for number in tested})
        if found < self.settings.folds:
            what = (
                f"{together}{'s' * (found != 1)}{f' with {least} frames or more' if least else ''}"
            )
            raise DataError(
                f"protocol.folds={self.settings.folds}: {pairs.source} has only {found} {what} here; lower protocol.folds"
                f" (2 at least) or use more {'recordings' if together == 'recording' else 'pairs'}"
            )
        of_group: dict[Any, int] = {}
        splitter = GroupKFold(self.settings.folds, shuffle=True, random_state=seed)
        ours = [groups[number] for number in tested]
        for number, (_, part) in enumerate(splitter.split(np.zeros(len(tested)), groups=ours)):
            of_group |= {ours[index]: number for index in part}
        long_enough = set(tested)
        return torch.tensor(
            [
                of_group[group]
                if number in long_enough
                else -2 - of_group[group]
                if group in of_group
                else -1
                for number, group in enumerate(groups)
            ]
        )

    def _learn(
        self,
        context: ProtocolContext,
        whole: Split,
        members: Tensor,
        start: Tensor,
        base: Tensor | None,
        labels: Labels | None,
        names: tuple[str, ...],
    ) -> tuple[Agent, TrainingResult]:
        """Trains a network for each row of `members` `(K, P)` on these pairs' whole drives.

        Args:
            start: what each network starts from, `(K, n)`.
            base: drivers' own bases, `(P, n)`, if they have any.
        """
        if not context.policy.trainable:
            training_result = context.untrained(context.policy, start)
            return context.ready(context.policy, training_result, names), training_result
        network, index = members.nonzero().unbind(1)
        device = context.batch.lengths.device
        training_data = TrainingData(
            simulator=context.simulator,
            batch=context.batch[index.to(device)],
            split=whole[index],
            windows=context.windows,
            fixed=start[network.to(device)],
            labels=labels.select(index) if labels is not None else None,
            network=network.to(device),
            names=names,
            seed=context.seed,
            objective=context.objective,
            # Also where both are the same: unseen drivers differ in that nothing of their history was read.
            base=base[index.to(device)] if base is not None else start[network.to(device)],
            drivers=tuple(context.pairs[number].driver for number in index.tolist()),
            workspace=context.workspace,
        )
        if not context.learner.reads_history and (
            self.settings.history != 0 or any(self.settings.histories)
        ):
            log.warning(
                "This policy learns from no drive with history before it (rollout: learner.cold_start_fraction=1), and drives badly after"
                " reading any, as it will in the test; set protocol.history=0 protocol.histories=[], or lower learner.cold_start_fraction"
            )
        if context.policy.driver_features and (
            self.settings.history == 0 or not context.learner.reads_history
        ):
            log.warning(
                "policy.driver_features are measured from a driver's history, of which nothing is known here (protocol.history=0, or"
                " learner.cold_start_fraction=1 of rollout); leave them out, or set protocol.history=null and lower learner.cold_start_fraction"
            )
        training_result = context.learner.fit(context.policy, training_data)
        policy = context.ready(context.policy, training_result, names)
        own = self.settings.base == "own"
        rule = ContextRule(
            driver_specific=own,
            shrinkage=self.settings.shrinkage if own else 0.0,
            history_s=self.settings.history,
        )
        return replace(policy, context_rule=rule), training_result


def _platoons(pairs: Sequence[Pair]) -> list[int]:
    """Numbers the platoon of each pair: vehicles of a recording that follow one another, directly or through others."""
    names = [(f"{pair.recording}/{pair.leader_id}", pair.driver) for pair in pairs]
    number = {
        name: index
        for index, name in enumerate(sorted({vehicle for both in names for vehicle in both}))
    }
    edges = np.array([[number[leader], number[follower]] for leader, follower in names]).T
    graph = coo_array((np.ones(len(names)), (edges[0], edges[1])), shape=(len(number), len(number)))
    _, platoon = connected_components(graph, directed=False)
    return [int(platoon[number[follower]]) for _, follower in names]


_GROUPS: Mapping[str, Callable[[PairSet], Sequence[Any]]] = {
    "driver": lambda pairs: [pair.driver for pair in pairs],
    "platoon": _platoons,
    "recording": lambda pairs: [pair.recording for pair in pairs],
}
"""What each pair's fold is chosen for: `protocol.together`."""


def _overlap(pairs: PairSet, fold: Tensor, *, apart: bool) -> dict[str, Any]:
    """Counts the vehicles that stand on both sides of a fold, though never as followers; says so in the log.

    Args:
        apart: no recording is on both sides.
    """
    places = [int(number) for number in fold]
    tested = {pair.driver: k for pair, k in zip(pairs, places, strict=True) if k >= 0}
    # Of whom somebody learns: in which fold they do not.
    not_trained_in = {
        pair.driver: k if k >= 0 else -2 - k for pair, k in zip(pairs, places, strict=True)
    }
    behind_trained, leaders = 0, set()
    for pair, k in zip(pairs, places, strict=True):
        leader = f"{pair.recording}/{pair.leader_id}"
        behind_trained += k >= 0 and leader in not_trained_in and not_trained_in[leader] != k
        if leader in tested and tested[leader] not in {k, -2 - k}:
            leaders.add(leader)
    folds, count = max(places) + 1, sum(k >= 0 for k in places)
    log.info(
        "%d folds over %d drivers; %d of %d test pairs follow a driver of the training part, %d test drivers lead one there",
        folds,
        len(tested),
        behind_trained,
        count,
        len(leaders),
    )
    if count < len(pairs):
        log.info("%d shorter pairs are only learned from", len(pairs) - count)
    recordings = [
        sorted({p.recording for p, k in zip(pairs, places, strict=True) if k == number})
        for number in range(folds)
    ]
    if apart:
        for number, names in enumerate(recordings):
            log.info(
                "Fold %d is tested on %s, of which it learns nothing", number, ", ".join(names)
            )
    return {
        "folds": folds,
        "recordings_per_fold": recordings,
        "drivers": len(tested),
        "drivers_per_fold": [sum(k == number for k in tested.values()) for number in range(folds)],
        "test_pairs_behind_a_training_driver": behind_trained,
        "test_drivers_who_lead_a_training_pair": len(leaders),
        "pairs_only_learned_from": len(pairs) - count,
    }
