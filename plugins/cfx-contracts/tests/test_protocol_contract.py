"""Each statement of the contract fails for a protocol that breaks it, and says so."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import pytest
import torch

from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.protocols.within_driver import WithinDriver
from cfx.evaluation.result import Evaluation, PairTrajectory
from cfx.learners.base import TrainingData, TrainingResult
from cfx.learners.imitation import ImitationLearner
from cfx.policies.base import Policy
from cfx.policies.constant import FixedPolicy
from cfx.simulation.windows import Split
from cfx_contracts import protocols as checks


class Retelling(WithinDriver):
    """Changes what came out."""

    def run(self, context: ProtocolContext) -> ProtocolResult:
        protocol_result = super().run(context)
        return replace(protocol_result, evaluation=self.retell(protocol_result.evaluation))

    def retell(self, evaluation: Evaluation) -> Evaluation:
        return replace(
            evaluation, trajectories=tuple(self.redrive(drive) for drive in evaluation.trajectories)
        )

    def redrive(self, drive: PairTrajectory) -> PairTrajectory:
        return drive


class Shorter(Retelling):
    def redrive(self, drive: PairTrajectory) -> PairTrajectory:
        return replace(drive, speed={**drive.speed, "policy": drive.speed["policy"][:-5]})


class Elsewhere(Retelling):
    def redrive(self, drive: PairTrajectory) -> PairTrajectory:
        return replace(drive, speed={**drive.speed, "policy": drive.speed["policy"] + 0.1})


class Copying(Retelling):
    def redrive(self, drive: PairTrajectory) -> PairTrajectory:
        return replace(drive, speed={**drive.speed, "policy": drive.real_speed})


class Narrow(Retelling):
    def retell(self, evaluation: Evaluation) -> Evaluation:
        measured = tuple(one for one in evaluation.measured if one.name != "rmse_gap")
        return replace(evaluation, measured=measured)


class Double(Retelling):
    def retell(self, evaluation: Evaluation) -> Evaluation:
        about = evaluation.about.loc[[0, *evaluation.about.index]]
        return replace(evaluation, about=about.reset_index(drop=True))


class Mute(Retelling):
    def retell(self, evaluation: Evaluation) -> Evaluation:
        return replace(
            evaluation,
            improvements={
                "test": {"driver_specific": evaluation.improvements["test"]["driver_specific"]}
            },
        )


class _Whole:
    """A calibrator that uses drives to their end."""

    def __init__(self, calibrator: Any) -> None:
        self._calibrator = calibrator

    def __getattr__(self, name: str) -> Any:
        return getattr(self._calibrator, name)

    def driver_specific(self, pairs: Any, batch: Any, last: Any) -> Any:
        return self._calibrator.driver_specific(pairs, batch, batch.lengths - 1)


class Peeking(WithinDriver):
    def run(self, context: ProtocolContext) -> ProtocolResult:
        return super().run(replace(context, calibrator=_Whole(context.calibrator)))


class _Telling(ImitationLearner):
    """Is given the whole drives to learn from."""

    def __init__(self, learner: Any, context: ProtocolContext) -> None:
        super().__init__(epochs=1)
        self._learner, self._context = learner, context

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        whole = Split.none(self._context.pairs, self._context.windows)
        labels = self._context.labels(whole.windows, training_data.pairs.start)
        told = replace(training_data, pairs=replace(training_data.pairs, labels=labels))
        return self._learner.fit(policy, told)


class Telling(WithinDriver):
    def run(self, context: ProtocolContext) -> ProtocolResult:
        if not context.policy.trainable:
            return super().run(context)
        return super().run(replace(context, learner=_Telling(context.learner, context)))


class Drawing(WithinDriver):
    def run(self, context: ProtocolContext) -> ProtocolResult:
        calibrator = copy(context.calibrator)
        seed = int(torch.randint(0, 1000, ()))
        calibrator.solver = replace(calibrator.solver, seed=seed)
        return super().run(replace(context, calibrator=calibrator))


class Eager(WithinDriver):
    """Trains whatever it is given."""

    def run(self, context: ProtocolContext) -> ProtocolResult:
        if not context.policy.trainable:
            context.learner.fit(context.policy, None)  # type: ignore[arg-type]  # the mistake to be found
        return super().run(context)


class Labelling(WithinDriver):
    def run(self, context: ProtocolContext) -> ProtocolResult:
        protocol_result = super().run(context)
        counts = Split.of(context.pairs, context.windows, context.split).windows
        training_result = replace(context, policy=FixedPolicy())
        assert training_result.labels(counts, torch.zeros(0)) is None
        return replace(protocol_result, labels=protocol_result.labels or object())  # type: ignore[arg-type]  # the mistake to be found


FRAMES = checks.all_methods_drive_the_same_frames
TABLE = checks.the_table_has_a_row_for_each_pair_and_method
BROKEN: dict[str, tuple[Protocol, Any, str]] = {
    "shorter": (Shorter(), FRAMES, "simulated over the same frames"),
    "elsewhere": (Elsewhere(), FRAMES, "last measured state"),
    "narrow": (Narrow(), TABLE, "read these columns of the table: rmse_gap"),
    "double": (Double(), TABLE, "would count it twice"),
    "mute": (Mute(), TABLE, "over every baseline"),
    "copying": (
        Copying(),
        checks.no_method_sees_the_measured_follower_of_the_test_part,
        "speeds of method 'policy'",
    ),
    "peeking": (
        Peeking(),
        checks.nothing_is_found_or_learned_from_the_test_part,
        "method 'driver_specific' begins",
    ),
    "telling": (
        Telling(),
        checks.nothing_is_found_or_learned_from_the_test_part,
        "method 'policy' begins",
    ),
    "told": (Telling(), checks.learners_get_only_what_they_may_use, "end within the training part"),
    "drawing": (Drawing(), checks.the_same_seed_gives_the_same_result, "from `context.seed` alone"),
    "eager": (Eager(), checks.a_policy_without_training_is_not_trained, "nothing to train"),
    "labelling": (Labelling(), checks.a_policy_without_training_is_not_trained, "find none"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    with pytest.raises(AssertionError, match=sentence):
        check(component)


def test_every_statement_has_a_protocol_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)
