"""Each driver on his own: the first part of each pair to calibrate and train, the rest to test."""

from __future__ import annotations

import logging

import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.windows import Split, Windows
from cfx.evaluation.closed_loop import drive
from cfx.evaluation.metrics import evaluate
from cfx.learners.base import CURVE_COLUMNS, Learned, Lesson
from cfx.policies.base import Policy
from cfx.policies.default import DefaultPolicy
from cfx.policies.features import token_width
from cfx.policies.fixed import FixedPolicy
from cfx.policies.trained import Scaler, TrainedPolicy, group_by
from cfx.protocols.base import Outcome, Protocol, Study

log = logging.getLogger(__name__)


class WithinDriver(Protocol):
    """The paper's first experiment: the first 80 % of each pair's windows to calibrate and train, the last 20 % to test.

    The fixed parameters come from the training part as one closed-loop drive; the test starts from the last measured state
    of the training part. No frame of the test part is read before the evaluation.
    """

    def run(self, study: Study) -> Outcome:
        pairs, batch = study.pairs, study.batch
        split = Split.of(pairs, study.windows, study.split)
        fixed = study.calibrator.fixed(pairs, batch, split.frame)
        device = batch.lengths.device
        own = torch.arange(len(pairs), device=device)
        names = tuple(pair.pair_id for pair in pairs)
        labels = None
        network, groups = own, names
        if study.policy.trainable:
            if study.learner.needs_labels:
                windows = Windows.of(split.windows, study.windows)
                labels = study.calibrator.labels(pairs, batch, windows, fixed)
                told = float((labels.spread > study.windows.tie_tolerance).double().mean())
                log.info(
                    "Window labels: %d windows; parameters matter by more than %g m/s in %.0f %% of them",
                    len(windows),
                    study.windows.tie_tolerance,
                    100 * told,
                )
            if study.learner.settings.scope == "all":
                network, groups = group_by(["all"] * len(pairs))
                network = network.to(device)
            lesson = Lesson(
                simulator=study.simulator,
                batch=batch,
                split=split,
                windows=study.windows,
                fixed=fixed,
                labels=labels,
                network=network,
                names=groups,
                seed=study.seed,
            )
            learned = study.learner.fit(study.policy, lesson)
        else:
            learned = _untrained(study.policy, study, fixed)
        policy = _ready(study, study.policy, learned, groups)
        constants = {"default": DefaultPolicy(), "fixed": FixedPolicy()}
        first = split.frame.to(device)
        loops = {
            name: drive(study.simulator, _ready(study, constant, _untrained(constant, study, fixed), names), batch, first, own)
            for name, constant in constants.items()
        }
        loops["policy"] = drive(study.simulator, policy, batch, first, network)
        evaluation = evaluate(pairs, batch, first, loops, policy.space, study.style, seed=study.seed)
        return Outcome(evaluation, policy, learned.curves, labels)


def _untrained(policy: Policy, study: Study, fixed: Tensor) -> Learned:
    """Returns a policy's networks as built, one per pair; in float64, so that constants stay what calibration found."""
    space = study.simulator.model.space
    width = token_width(policy.inputs, policy.summary, study.windows.length)
    unit = space.to_unit(fixed.cpu())
    network = policy.build(width, space.to_unit(space.defaults()), unit, torch.Generator().manual_seed(study.seed))
    device = fixed.device
    scaler = Scaler(unit.new_zeros((len(unit), width)), unit.new_ones((len(unit), width)))
    return Learned(network.to(device).eval(), scaler.to(device), pd.DataFrame(columns=CURVE_COLUMNS))


def _ready(study: Study, policy: Policy, learned: Learned, names: tuple[str, ...]) -> TrainedPolicy:
    return TrainedPolicy(
        policy=policy,
        network=learned.network,
        scaler=learned.scaler,
        model_node=study.model_node,
        policy_node=study.policy_node,
        space=study.simulator.model.space,
        windows=study.windows,
        dt=study.simulator.dt,
        names=names,
    )
