"""The contract of a learner: it trains the networks that a policy builds.

Shapes: P pairs, one behind the other for all networks; U recorded pairs, of which several networks
may learn from the same; N networks, W windows of the longest training part, n tuned parameters.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import pandas as pd
import torch
from torch import Tensor

from cfx.calibration.calibrator import WindowLabels
from cfx.calibration.objectives import Objective
from cfx.calibration.rmse import SpeedRmse
from cfx.core.component import Component
from cfx.core.engine import Engine
from cfx.core.local_engine import LocalEngine
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError
from cfx.learners.workspace import Workspace
from cfx.models.base import DrivingModel
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import Scaler
from cfx.policies.history import History, changed, measured_history
from cfx.policies.valid_range import ValidRange, situations
from cfx.simulation.base import Stepper
from cfx.simulation.windows import Split, WindowSettings

_PAIRS_AT_MOST = 4096
"""Pairs of a network whose situations are measured: of more, as many at equal distances. A range
and its quantiles need no more than the hundred thousands of situations that these have."""

Augment = Callable[[History, Tensor], History]
"""Takes the situations of pairs `(P,)`, `(P, W)` each, and returns others of the same shape."""

CURVE_COLUMNS = ["network", "epoch", "train_loss", "validation_loss"]


@dataclass(frozen=True)
class TrainingPairs:
    """P pairs to learn from, one behind the other for all networks.

    Attributes:
        index: which of the U recorded pairs each is, `(P,)` int64.
        split: where the training part of each ends.
        network: which network learns from each, `(P,)` int64.
        start: the parameters that each pair's network starts from, `(P, n)`, SI units: the driver's
            own calibrated set, or the pooled one where networks are for unseen drivers.
        base: the parameters that answers refer to for each driver whose history was observed, `(P,
            n)`, SI units, while those in `start` serve unseen drivers; None where there are no
            unseen drivers. Only learners of offsets read them.
        labels: per-window calibrated parameters of the training parts; None if the learner needs
            none.
        drivers: whose pair each is; None if each is another driver's.
        sites: where each was recorded; None if all were recorded at one site.
    """

    index: Tensor
    split: Split
    network: Tensor
    start: Tensor
    base: Tensor | None = None
    labels: WindowLabels | None = None
    drivers: tuple[str, ...] | None = None
    sites: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.index)

    @property
    def known_drivers(self) -> tuple[str, ...]:
        """The driver of each pair; where none is named, each pair is a driver of its own."""
        return self.drivers or tuple(str(number) for number in range(len(self)))


@dataclass(frozen=True)
class TrainingData:
    """What a learner may see: the training part of some pairs.

    Attributes:
        stepper: simulates the driving model, with its time step.
        recorded: U pairs, full trajectories; only frames up to `pairs.split.frame` may be read.
        pairs: what is learned from each of P pairs, and by which network.
        windows: how trajectories are cut.
        names: what each network is for, N of them.
        seed: for initial weights and everything random.
        workspace: has files for what training needs to go on after an interruption; None: nothing
            is kept.
        objective: what training that simulates in closed loop minimises; calibration has minimised
            it too.
        engine: where independent networks may train.
    """

    stepper: Stepper
    recorded: PairBatch
    pairs: TrainingPairs
    windows: WindowSettings
    names: tuple[str, ...]
    seed: int
    workspace: Workspace | None = None
    objective: Objective = field(default_factory=SpeedRmse)
    engine: Engine = field(default_factory=LocalEngine)

    @property
    def batch(self) -> PairBatch:
        """The P pairs, copied: as many times as many recordings as there are networks.

        A learner that is to learn from thousands of pairs reads `recorded` and `pairs`.
        """
        return self.recorded[self.pairs.index]

    @property
    def device(self) -> torch.device:
        """The device of the trajectories."""
        return self.recorded.lengths.device


@dataclass(frozen=True)
class TrainingResult:
    """The trained networks of a learner.

    Attributes:
        network: N trained networks, in evaluation mode.
        scaler: how their tokens are normalised.
        curves: columns network, epoch, train_loss, validation_loss (NaN where not measured).
        base: parameters that answers refer to for drivers without a base of their own, `(N, n)`, SI
            units; None where the head needs none.
        head: what makes parameters of answers (`cfx.policies.heads`); None: `offset` where
            there is a base, otherwise `direct`.
        valid_range: the situations that each network learned from; None: those of its training
            parts (`learned_range`).
        dispersion: factor on each network's noise, `(N,)`; None: 1, or a head without noise.
    """

    network: PolicyNetwork
    scaler: Scaler
    curves: pd.DataFrame
    base: Tensor | None = None
    head: str | None = None
    valid_range: ValidRange | None = None
    dispersion: Tensor | None = None


class Learner(Component):
    """Base of every learner.

    Life cycle: a protocol makes a `TrainingData` (with labels if `needs_labels`) and calls `fit`
        once.
    Networks are independent: what one learns does not depend on which others are trained beside it.

    Attributes:
        needs_labels: whether the protocol must find per-window calibrated parameters first.
        needs_gradients: whether it differentiates through the simulation.
        uses_driver_features: whether its networks read driver features (`policy.driver_features`),
            and are trained for unseen drivers without them too.
    """

    kind = "learner"
    needs_labels: ClassVar[bool] = False
    needs_gradients: ClassVar[bool] = False
    uses_driver_features: ClassVar[bool] = False

    @property
    def learned_before(self) -> Mapping[str, str]:
        """The pairs that networks have learned from before they begin (`TrainedOn.pairs`)."""
        return {}

    @property
    def reads_history(self) -> bool:
        """Whether its networks learn from trajectories with observed history before them."""
        return True

    def require_gradients(self, model: DrivingModel, differentiable: bool) -> None:
        """Checks that there are gradients where they are needed; a job asks before any work begins.

        Args:
            model: the driving model.
            differentiable: whether gradients flow through the simulator.

        Raises:
            ConfigError: there are none.
        """
        if not self.needs_gradients or (differentiable and model.differentiable):
            return
        component = "the simulator"
        if differentiable:
            component = "the driving model"
        raise ConfigError(
            f"this learner needs gradients, and {component} has none; choose a differentiable model"
            " and simulator=memory, or learner=imitation"
        )

    def require_no_driver_features(self, policy: Policy) -> None:
        """Checks that a policy reads no driver features; a job asks before any work begins.

        Raises:
            ConfigError: it reads some, and this learner does not provide them.
        """
        if policy.driver_features and not self.uses_driver_features:
            raise ConfigError(
                f"policy.driver_features={list(policy.driver_features)}: this learner provides no"
                " driver features; choose learner=rollout, or policy.driver_features=none"
            )

    @abstractmethod
    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """Trains the networks of `policy` on `training_data`."""


def learned_range(training_data: TrainingData, augment: Augment | None = None) -> ValidRange:
    """Measures the situations at the windows of each network's training parts.

    Args:
        training_data: what the networks learn from.
        augment: what training made of situations besides; None: nothing.
    """
    device = training_data.device
    last = training_data.pairs.split.frame.to(device)
    windows = torch.arange(0, int(last.max()) + 1, training_data.windows.stride, device=device)
    networks = training_data.pairs.network.to(device)
    rows = _some_of_each(networks, len(training_data.names))
    pair = training_data.pairs.index.to(device)[rows]
    history = measured_history(training_data.recorded, pair[:, None], windows, 1)
    recorded = changed(history, lambda signal: signal[..., 0])
    counted = windows <= last[rows, None]
    versions = [situations(recorded)]
    if augment is not None:
        versions.append(situations(augment(recorded, rows)))
    by_network = []
    for number in range(len(training_data.names)):
        of_network = networks[rows] == number
        features = [version[of_network][counted[of_network]] for version in versions]
        by_network.append(torch.cat(features))
    return ValidRange.of(by_network)


def _some_of_each(network: Tensor, networks: int) -> Tensor:
    """Returns rows of each network, all or `_PAIRS_AT_MOST` of them, in order, `(S,)`."""
    chosen = []
    for number in range(networks):
        rows = (network == number).nonzero()[:, 0]
        if len(rows) > _PAIRS_AT_MOST:
            # At equal distances, so that every site and time of a recording is among them.
            at = torch.arange(_PAIRS_AT_MOST, device=rows.device) * len(rows) // _PAIRS_AT_MOST
            rows = rows[at]
        chosen.append(rows)
    return torch.cat(chosen).sort().values
