"""The contract of a protocol, statement by statement.

The context: six simulated drivers, each behind their own leader, a coarse search and a short
training. Where frames of a test part are changed ("poisoned"), nothing that was found or learned
before that part may change with them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch

from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.core.contract import NotApplicable, once
from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.data.style import StyleSettings, measure_style
from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.result import METHODS, PairTrajectory
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.imitation import ImitationLearner
from cfx.models.krauss import Krauss
from cfx.policies.base import Policy
from cfx.policies.constant import FixedPolicy
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.windows import WindowSettings
from cfx_contracts import contract_of

PAIRS, FRAMES = 6, 111

_COLUMNS = (
    "pair_id", "recording", "leader_id", "follower_id", "driver", "cluster", "style_score", "fold",
    "method", "frames", "rmse_speed", "rmse_gap", "improvement_over_driver_specific", "collisions",
)  # fmt: skip


@cache
def recording() -> PairSet:
    """Returns the trajectories of the context."""
    return SyntheticDataset(pairs=PAIRS, platoon_size=1, frames=FRAMES, heterogeneity=1.0).load()


def context(
    pairs: PairSet, *, policy: Policy | None = None, learner: Learner | None = None, seed: int = 0
) -> ProtocolContext:
    """Returns a context of some trajectories; a small recurrent network is its policy."""
    model = Krauss()
    batch = PairBatch.of(pairs)
    stepper = MemoryStepper(model, pairs.dt)
    return ProtocolContext(
        pairs=pairs,
        batch=batch,
        style=measure_style(pairs, StyleSettings()),
        model_node={"name": "krauss"},
        policy_node={"name": "gru"},
        calibrator=Calibrator(
            Solver(stepper, RandomSearch(samples=512), seed=seed, memory=1 << 28),
            cache=Cache(None),
        ),
        policy=policy or GruPolicy(hidden_size=4),
        learner=learner or ImitationLearner(epochs=3, learning_rate=0.02),
        windows=WindowSettings(),
        split=0.8,
    )


def all_methods_drive_the_same_frames(protocol: Protocol) -> None:
    protocol_result = _protocol_result(protocol)
    assert isinstance(protocol_result, ProtocolResult), (
        f"`run` must return a cfx.plugin.ProtocolResult, not a {type(protocol_result).__name__}"
    )
    for pair in protocol_result.evaluation.trajectories:
        where = f"(pair {pair.pair_id})"
        for method in protocol_result.evaluation.methods:
            speed, gap = pair.speed[method], pair.gap[method]
            assert len(speed) == len(gap) == len(pair.time) == len(pair.real_speed), (
                "every method is simulated over the same frames, or their errors cannot be"
                f" compared; {method} has {len(speed)} of {len(pair.time)} {where}"
            )
            begin = (pair.real_speed[0], pair.real_gap[0])
            assert (speed[0], gap[0]) == begin, (
                f"every method starts from the last measured state; {method} does not {where}"
            )
            assert bool(np.isfinite(speed).all()), (
                f"every frame of the test part is simulated; {method} leaves some out {where}"
            )
    frames = protocol_result.evaluation.table.groupby("pair_id")["frames"].nunique()
    assert bool((frames == 1).all()), (
        "every method of a pair is measured over the same number of frames"
    )


def the_table_has_a_row_for_each_pair_and_method(protocol: Protocol) -> None:
    evaluation = _protocol_result(protocol).evaluation
    parameters = [f"parameter_{name}" for name in evaluation.names]
    missing = [name for name in (*_COLUMNS, *parameters) if name not in evaluation.table]
    assert not missing, (
        f"reports, figures and `cfx report` read these columns of the table: {', '.join(missing)}"
    )
    assert {"default", "driver_specific", "policy"} <= set(evaluation.methods), (
        "the policy is compared with the model's defaults and with driver-specific parameters;"
        f" there are only {', '.join(evaluation.methods)}"
    )
    assert set(evaluation.table["method"]) <= set(METHODS), (
        f"methods are named {', '.join(METHODS)}"
    )
    assert set(evaluation.improvements["test"]) == set(evaluation.methods) - {"policy"}, (
        "the improvement of the policy is given over every baseline that was simulated"
    )
    counts = evaluation.table.groupby(["pair_id", "method"]).size()
    assert bool((counts == 1).all()), (
        "a pair is tested once by each method; twice would count it twice in every mean"
    )
    assert len(counts) == len(evaluation.methods) * evaluation.table["pair_id"].nunique(), (
        "every method is tested on every pair"
    )
    simulated = {pair.pair_id for pair in evaluation.trajectories}
    assert simulated == set(evaluation.table["pair_id"]), (
        "the trajectories are those that the table measures"
    )


def no_method_sees_the_measured_follower_of_the_test_part(protocol: Protocol) -> None:
    """The follower alone is changed: every method must be simulated exactly as before."""
    pairs = recording()
    before = _trajectories(_protocol_result(protocol))
    tested = next(iter(before.values()))
    after = _trajectories(protocol.run(context(_poisoned(pairs, tested, leader=False))))[
        tested.pair_id
    ]
    for method in tested.speed:
        _same("parameters", method, tested.parameters[method], after.parameters[method])
        _same("speeds", method, tested.speed[method], after.speed[method])


def _same(what: str, method: str, before: np.ndarray, after: np.ndarray) -> None:
    assert np.array_equal(before, after), (
        f"the measured follower of a driver's test part was changed, and the {what} of method"
        f" '{method}' in it changed: it was calibrated on, learned from, or seen in the simulation,"
        " so the test proves nothing"
    )


def nothing_is_found_or_learned_from_the_test_part(protocol: Protocol) -> None:
    """Leader and follower are changed: what holds at the first test frame must be as before."""
    pairs = recording()
    before = _trajectories(_protocol_result(protocol))
    tested = list(before.values())[-1]
    after = _trajectories(protocol.run(context(_poisoned(pairs, tested, leader=True))))[
        tested.pair_id
    ]
    for method in tested.parameters:
        assert np.array_equal(tested.parameters[method][0], after.parameters[method][0]), (
            f"a driver's test part was changed, and with it the parameters that method '{method}'"
            " begins it with: frames that calibration or learning has read are no test"
        )


def the_same_seed_gives_the_same_result(protocol: Protocol) -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        first = _protocol_result(protocol)
        torch.manual_seed(2)
        second = protocol.run(context(recording()))
    assert first.evaluation.table.equals(second.evaluation.table), (
        "the same context twice gave two results: randomness must come from `context.seed` alone"
    )


def learners_get_only_what_they_may_use(protocol: Protocol) -> None:
    if not protocol.trains:
        raise NotApplicable("this protocol trains nothing")
    watched = _Watched(ImitationLearner(epochs=1))
    protocol.run(context(recording(), learner=watched))
    assert watched.training_data_seen, "a trainable policy must be trained by the context's learner"
    for training_data in watched.training_data_seen:
        pairs = training_data.pairs
        per_pair = (pairs.split.frame, pairs.network, pairs.start)
        assert all(len(values) == len(pairs) for values in per_pair), (
            "split, network and start of training data have an entry for each of its pairs"
        )
        assert bool((pairs.split.frame < training_data.recorded.lengths[pairs.index]).all()), (
            "`split.frame` is a frame of the pair"
        )
        assert set(pairs.network.tolist()) == set(range(len(training_data.names))), (
            "every network of training data has a name and learns from at least one pair"
        )
        assert pairs.labels is not None, "the learner needs labels: find them with `context.labels`"
        windows = pairs.labels.windows
        ends = windows.first + windows.settings.length
        assert bool((ends <= pairs.split.frame[windows.pair]).all()), (
            "a label's window must end within the training part: labels are found from measurements"
        )


def a_policy_without_training_is_not_trained(protocol: Protocol) -> None:
    protocol_result = protocol.run(
        context(recording(), policy=FixedPolicy(), learner=_Refusing(epochs=1))
    )
    assert protocol_result.labels is None, (
        "labels cost most of a job's time: without a learner to read them, find none"
    )
    assert len(protocol_result.curves) == 0, "where nothing was learned the curves are empty"
    assert list(protocol_result.curves.columns) == CURVE_COLUMNS, (
        f"empty curves still have the columns {', '.join(CURVE_COLUMNS)}"
    )


def _protocol_result(protocol: Protocol) -> ProtocolResult:
    """Runs the context as it is once for all checks of one protocol."""
    return once(protocol, "result", lambda: protocol.run(context(recording())))


class _Watched(Learner):
    """A learner that remembers what it was given."""

    schema = ImitationLearner.schema
    needs_labels = True

    def __init__(self, learner: ImitationLearner) -> None:
        super().__init__(learner.settings)
        self._learner = learner
        self.training_data_seen: list[TrainingData] = []

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        self.training_data_seen.append(training_data)
        return self._learner.fit(policy, training_data)


class _Refusing(ImitationLearner):
    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        raise AssertionError(
            "a policy that is not `trainable` must not go to a learner: there is nothing to train"
        )


def _trajectories(protocol_result: ProtocolResult) -> dict[str, PairTrajectory]:
    return {pair.pair_id: pair for pair in protocol_result.evaluation.trajectories}


def _poisoned(pairs: PairSet, tested: PairTrajectory, *, leader: bool) -> PairSet:
    """Changes a driver's frames after the last measured state, where the test part starts."""
    changed = []
    for pair in pairs:
        is_tested = pair.pair_id == tested.pair_id
        changed.append(_changed(pair, tested, leader) if is_tested else pair)
    return PairSet(tuple(changed), pairs.source)


def _changed(pair: Pair, tested: PairTrajectory, leader: bool) -> Pair:
    first = len(pair) - (len(tested.time) - 1)
    steady = np.arange(len(pair)) >= first
    ramp = np.where(steady, np.arange(len(pair)) - first + 1.0, 0.0)
    # The follower falls far back and the leader pulls away: calibration on this finds another
    # driver.
    values: dict[str, Any] = {
        "follower_position": pair.follower_position - ramp,
        "follower_speed": np.where(steady, 0.3 * pair.follower_speed, pair.follower_speed),
        "follower_acceleration": np.where(steady, -1.0, pair.follower_acceleration),
    }
    if leader:
        values |= {
            "leader_position": pair.leader_position + ramp,
            "leader_speed": np.where(steady, 2.0 * pair.leader_speed + 3.0, pair.leader_speed),
            "leader_acceleration": np.where(steady, 1.0, pair.leader_acceleration),
        }
    return replace(pair, **values)


CONTRACT = contract_of(
    __name__,
    "protocol",
    slow=[
        the_same_seed_gives_the_same_result,
        no_method_sees_the_measured_follower_of_the_test_part,
    ],
)
