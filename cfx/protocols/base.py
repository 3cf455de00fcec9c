"""The contract of a protocol: who is calibrated, trained and tested on what."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from cfx.calibration.calibrator import Calibrator, Labels
from cfx.calibration.windows import WindowSettings
from cfx.component import Component
from cfx.evaluation.result import Evaluation
from cfx.learners.base import Learner
from cfx.pairs import PairBatch, PairSet
from cfx.policies.base import Policy
from cfx.policies.trained import TrainedPolicy
from cfx.simulation.rollout import Simulator
from cfx.style.result import StyleResult


@dataclass(frozen=True)
class Study:
    """Everything that a protocol composes.

    Attributes:
        pairs, batch: the drives, as objects and as tensors on the job's device.
        style: score and cluster of each driver.
        simulator: the driving model and its time step.
        model_node, policy_node: config nodes, kept with the trained policy.
        calibrator, policy, learner: the components.
        windows: how drives are cut.
        split: share of each pair's windows for training.
        seed: for everything random.
    """

    pairs: PairSet
    batch: PairBatch
    style: StyleResult
    simulator: Simulator
    model_node: Mapping[str, Any]
    policy_node: Mapping[str, Any]
    calibrator: Calibrator
    policy: Policy
    learner: Learner
    windows: WindowSettings
    split: float
    seed: int


@dataclass(frozen=True)
class Outcome:
    """What a protocol delivers.

    Attributes:
        evaluation: the comparison of default, fixed and policy.
        policy: the policy that drove in it.
        curves: learning curves; empty if nothing was learned.
        labels: window labels; None if none were needed.
    """

    evaluation: Evaluation
    policy: TrainedPolicy
    curves: pd.DataFrame
    labels: Labels | None


class Protocol(Component):
    """Base of every protocol.

    Life cycle: a job calls `run` once. All methods are tested on the same frames from the same measured state.
    """

    kind = "protocol"

    @abstractmethod
    def run(self, study: Study) -> Outcome:
        """Calibrates, trains and evaluates."""
