"""The protocol `transfer`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

from pydantic import Field

from cfx.core.component import Settings
from cfx.core.files import FilePath
from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.protocols.finished import FinishedPolicy


class TransferSettings(Settings):
    """Settings of `transfer`."""

    run: FilePath = Field(
        description="output folder of the job whose policy is tested, or the id of its MLflow run"
    )


class Transfer(Protocol):
    """A finished job's policy is tested on recordings that it has never seen; nothing is trained.

    Model, policy and windows are that job's, whatever else is chosen. Its network for unseen
    drivers (`all`, or the only one) is tested as its protocol tested it: from driver-specific base
    parameters or from the pooled ones, after as much history. The baselines are the model's default
    parameters, `pooled` (constant parameters that were calibrated on the drivers that the
    policy learned from, where there are any), and the driver-specific parameters, from the first 80
    % of each trajectory here. All are tested on the last 20 %; default, pooled and policy also
    on each full trajectory.

    So all that `default`, `pooled` and `policy` know comes from elsewhere: what remains of
    their gains is what transfers to another day, road or country. (To calibrate and train on some
    recordings and test on others of the same data, see `across_drivers` with `together=recording`.
    To forecast the drivers with that policy, or to set them on roads: `protocol.run` of `forecast`
    and `traffic`.)

    Differences from the paper: it has no such experiment.
    """

    schema: ClassVar[type[Settings]] = TransferSettings
    settings: TransferSettings
    jobs = ("run",)

    @cached_property
    def finished(self) -> FinishedPolicy:
        """The policy that is tested."""
        return FinishedPolicy(self.settings.run)

    @property
    def trains(self) -> bool:
        return False

    def determines(self) -> Mapping[str, Any]:
        return self.finished.determines()

    def run(self, context: ProtocolContext) -> ProtocolResult:
        tested = self.finished.tested(context)
        return tested.result(tested.test.evaluation())
