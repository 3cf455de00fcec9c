"""Unseen drivers: k-fold cross-validation over the drivers."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import pandas as pd
from pydantic import Field, model_validator
from torch import Tensor

from cfx.calibration.calibrator import WindowLabels
from cfx.core.component import Distinct, Settings
from cfx.data.pairs import PairSet
from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.protocols.folds import Together, assign_folds, describe_folds, learned_from
from cfx.evaluation.protocols.held_out import HeldOut
from cfx.evaluation.protocols.past import expected_error, expected_of_unseen
from cfx.evaluation.result import Evaluation
from cfx.evaluation.tables import values_of
from cfx.learners.base import TrainingData, TrainingPairs, TrainingResult
from cfx.policies.agent import Agent
from cfx.policies.context import ContextRule, ExpectedError
from cfx.policies.core import ANY_DRIVER
from cfx.policies.heads.offset import shrunk
from cfx.simulation.windows import Split

log = logging.getLogger(__name__)


class AcrossDriversSettings(Settings):
    """Settings of `across_drivers`."""

    folds: int | None = Field(
        5,
        ge=2,
        description="parts that the drivers are divided into; each is tested once; null: as many as"
        " there are drivers (sites, ...), so that one is left out at a time",
    )
    together: Together = Field(
        "driver",
        description="what a fold keeps together: driver: all pairs of one follower; platoon: also"
        " all who follow each other; vehicle: all drives of a car (data.vehicle), with adaptive"
        " cruise control and without; recording, site: all drivers of a recording or of a site"
        " (data.site), so that no network learned from the road it is tested on",
    )
    min_test_duration: float | None = Field(
        None,
        gt=0,
        description="s that a pair must last to be tested; shorter ones are only learned from;"
        " null: all are tested",
    )
    base: Literal["driver_specific", "pooled", "default"] = Field(
        "driver_specific",
        description="what a policy of offsets starts from for drivers with history:"
        " driver_specific, pooled or default parameters; for"
        " drivers without history: the pooled ones, or the model's",
    )
    shrinkage: float = Field(
        0.7,
        ge=0,
        le=1,
        description="how far driver-specific parameters, as such a base, are shrunk towards the"
        " model's default (in the squashed space); 0: not at all. The baseline driver_specific is"
        " never shrunk.",
    )
    history: float | None = Field(
        None,
        ge=0,
        description="s of measured history before the test part that the policy observes; null: all"
        " there is",
    )
    combine: bool = Field(
        False,
        description="driver-specific parameters drive beside the policy in the test part, each"
        " with the share that their errors in the driver's past give it; needs history: null",
    )
    histories: Distinct[tuple[Annotated[float, Field(ge=0)], ...]] = Field(
        (0.0, 10.0, 30.0),
        description="s: other amounts of history to compare, for policies of offsets; empty: none",
    )

    @model_validator(mode="after")
    def _past_is_known(self) -> Self:
        if self.combine and self.history is not None:
            raise ValueError(
                "combine: driver-specific parameters are calibrated on all of their past; leave"
                " history: null, or set combine: false"
            )
        return self


@dataclass(frozen=True)
class _Calibrated:
    """What calibration found; P pairs, K + 1 networks, n tuned parameters.

    Attributes:
        driver_specific: driver-specific parameters, `(P, n)`, SI units.
        pooled: pooled parameters of each network's pairs, `(K + 1, n)`.
        start: what each network starts from, `(K + 1, n)`.
        base: driver-specific base parameters, `(P, n)`; None: `start` for every driver.
        labels: per-window calibrated parameters; None if the learner needs none.
    """

    driver_specific: Tensor
    pooled: Tensor
    start: Tensor
    base: Tensor | None
    labels: WindowLabels | None


@dataclass(frozen=True)
class Trained:
    """What calibration and training over the folds delivered; Q test pairs.

    Attributes:
        test: the test pairs and all methods.
        fold: in which fold each test pair is tested, `(Q,)`; None: there are none.
        curves, labels, notes, calibration: as in `ProtocolResult`.
    """

    test: HeldOut
    fold: Tensor | None
    curves: pd.DataFrame
    labels: WindowLabels | None
    notes: Mapping[str, Any]
    calibration: Mapping[str, float]

    def result(self, evaluation: Evaluation) -> ProtocolResult:
        """Returns what the protocol delivers, after its test."""
        return ProtocolResult(
            evaluation,
            self.policy_after(evaluation),
            self.curves,
            self.labels,
            self.notes,
            self.calibration,
        )

    def policy_after(self, evaluation: Evaluation) -> Agent:
        """Returns the policy, which knows of its test what error to expect of it."""
        policy = self.test.policy
        if self.fold is None or not policy.core.policy.trainable:
            return policy
        expected, fold = ExpectedError(), self.fold.cpu().numpy()
        if "past" in evaluation.tables:
            expected = expected_error(evaluation.tables["past"], fold)
        speed = values_of(evaluation.values, "rmse_speed", "full_trajectory")
        expected = expected_of_unseen(speed, fold, expected)
        return replace(policy, trained_on=replace(policy.trained_on, expected_error=expected))


class AcrossDrivers(Protocol):
    """The paper's experiment on clusters: a policy is trained on some drivers and tested on others.

    The drivers are divided into k folds. For each fold a network is trained, and one parameter set,
    `pooled`, is calibrated jointly, on the full trajectories of all other drivers. Then
    default, pooled, `driver_specific` (calibrated on the first 80 % of the driver's
    trajectory) and the policy are simulated over the last 20 % of each test trajectory. The policy
    observes the measured first part before (burn-in) and learns nothing from it. Default,
    pooled and policy are also simulated over each full test trajectory, from its first frame.

    All folds train as one batch of networks. One more network, `all`, learns from every driver. It
    is tested on no driver; the saved policy uses it for drivers of other recordings.

    No driver is, as follower, in both training and test. A vehicle may be follower in one pair and
    leader in another. Its trajectory as leader is an input only, so such pairs are kept, and
    counted (`data.json`, and a line in the log). `together=platoon` puts all who follow one another
    into one fold, where even that cannot happen. `together=recording` asks the harder question:
    whether what was learned holds on another day, road or data set.

    Differences from the paper: the paper's baseline is `pooled`; `driver_specific` is the stronger
    one. The paper does not say how folds are drawn; here a shuffle that `seed` determines draws
    them.
    """

    schema: ClassVar[type[Settings]] = AcrossDriversSettings
    settings: AcrossDriversSettings
    trial: ClassVar[Mapping[str, Any]] = {"folds": 3}

    def run(self, context: ProtocolContext) -> ProtocolResult:
        trained = self.trained(context)
        return trained.result(trained.test.evaluation(self.settings.histories, fold=trained.fold))

    def trained(self, context: ProtocolContext) -> Trained:
        """Calibrates and trains, and returns what is to be tested."""
        pairs = context.pairs
        fold = self.folds(pairs, seed=context.seed)
        notes = describe_folds(pairs, fold, self.settings.together)
        members = learned_from(fold, int(fold.max()) + 1)
        split = Split.of(pairs, context.windows, context.split)
        tested = fold >= 0
        of_tested = pairs.select(tested.tolist(), "not tested")
        context.check_start(of_tested)
        split[tested].check_test_parts(of_tested, context.windows, context.split)
        full = Split.none(pairs, context.windows)
        calibrator, batch = context.calibrator, context.batch
        driver_specific = calibrator.driver_specific(pairs, batch, split.frame)
        pooled = calibrator.pooled(pairs, batch, full.frame, members)
        calibrated = self._calibrated(
            context, driver_specific, pooled, context.labels(full.windows, driver_specific)
        )
        policy, training_result = self._learn(context, full, members, calibrated)
        calibration = context.calibration_metrics(
            "driver_specific", split.frame, calibrated.driver_specific
        )
        calibration |= context.calibration_metrics("pooled", full.frame, calibrated.pooled, members)
        return Trained(
            test=self._held_out(context, fold, split, calibrated, policy),
            fold=fold[fold >= 0],
            curves=training_result.curves,
            labels=calibrated.labels,
            notes=notes,
            calibration=calibration,
        )

    def folds(self, pairs: PairSet, *, seed: int) -> Tensor:
        """Returns the fold of each pair, `(P,)` int64; see `cfx.evaluation.protocols.folds`.

        Raises:
            DataError: there are fewer drivers (platoons, recordings) than folds.
        """
        s = self.settings
        return assign_folds(pairs, s.folds, s.together, s.min_test_duration, seed=seed)

    def _calibrated(
        self,
        context: ProtocolContext,
        driver_specific: Tensor,
        pooled: Tensor,
        labels: WindowLabels | None,
    ) -> _Calibrated:
        """Returns the calibrated parameters, and those from which the policies' answers start."""
        s = self.settings
        start = pooled
        if s.base == "default":
            start = context.defaults(pooled).expand_as(pooled)
        base = None
        if s.base == "driver_specific":
            space = context.stepper.model.adaptation_space
            base = shrunk(space, driver_specific, s.shrinkage)
        return _Calibrated(driver_specific, pooled, start, base, labels)

    def _learn(
        self, context: ProtocolContext, full: Split, members: Tensor, calibrated: _Calibrated
    ) -> tuple[Agent, TrainingResult]:
        """Trains a network for each row of `members`, `(K + 1, P)`, on full trajectories."""
        s = self.settings
        names = (*(f"fold {number}" for number in range(len(members) - 1)), ANY_DRIVER)
        if not context.policy.trainable:
            training_result = context.agents.untrained(context.policy, calibrated.start)
            policy = context.agents.trained(context.policy, training_result, names)
            return replace(policy, pooled=calibrated.pooled), training_result
        self._warn(context)
        training_data = _training_data(context, full, members, calibrated, names)
        training_result = context.learner.fit(context.policy, training_data)
        policy = context.agents.trained(context.policy, training_result, names)
        rule = ContextRule(
            driver_specific=s.base == "driver_specific",
            shrinkage=s.shrinkage if s.base == "driver_specific" else 0.0,
            history_s=s.history,
            combines=s.combine,
        )
        return replace(policy, context_rule=rule, pooled=calibrated.pooled), training_result

    def _warn(self, context: ProtocolContext) -> None:
        """Warns of settings that do not fit the learner's."""
        s, learns_from_history = self.settings, context.learner.reads_history
        if not learns_from_history and (s.history != 0 or any(s.histories)):
            log.warning(
                "This policy learns from no trajectory with history before it (rollout:"
                " learner.cold_start_fraction=1), and drives badly after a burn-in, as it will have"
                " in the test; set protocol.history=0 protocol.histories=[], or lower"
                " learner.cold_start_fraction"
            )
        if context.policy.driver_features and (s.history == 0 or not learns_from_history):
            log.warning(
                "policy.driver_features are measured from a driver's history, of which nothing is"
                " known here (protocol.history=0, or learner.cold_start_fraction=1 of rollout);"
                " leave them out, or set protocol.history=null and lower"
                " learner.cold_start_fraction"
            )

    def _held_out(
        self,
        context: ProtocolContext,
        fold: Tensor,
        split: Split,
        calibrated: _Calibrated,
        policy: Agent,
    ) -> HeldOut:
        """Returns the test of the pairs that are tested in some fold."""
        tested = (fold >= 0).nonzero()[:, 0]
        here = tested.to(context.batch.lengths.device)
        there = tested.to(calibrated.driver_specific.device)
        network = fold[tested]
        return HeldOut(
            context=context,
            pairs=context.pairs.take(tested.tolist()),
            batch=context.batch[here],
            network=network.to(here.device),
            first=split.frame[tested].to(here.device),
            driver_specific=calibrated.driver_specific[there],
            base=None if calibrated.base is None else calibrated.base[there],
            unseen_base=calibrated.start[network.to(calibrated.start.device)],
            pooled=calibrated.pooled,
            policy=policy,
        )


def _training_data(
    context: ProtocolContext,
    full: Split,
    members: Tensor,
    calibrated: _Calibrated,
    names: tuple[str, ...],
) -> TrainingData:
    """Returns each network's pairs, one network behind the other."""
    network, index = members.nonzero().unbind(1)
    device = context.batch.lengths.device
    rows, network = index.to(device), network.to(device)
    start = calibrated.start[network]
    # Also where both bases are the same: for unseen drivers nothing of their history is observed.
    base = start if calibrated.base is None else calibrated.base[rows]
    drivers, sites = [], []
    for number in index.tolist():
        drivers.append(context.pairs[number].driver)
        sites.append(context.pairs[number].site)
    pairs = TrainingPairs(
        index=rows,
        split=full[index],
        network=network,
        start=start,
        base=base,
        labels=None if calibrated.labels is None else calibrated.labels.select(index),
        drivers=tuple(drivers),
        sites=tuple(sites),
    )
    return context.training_data(pairs, names)
