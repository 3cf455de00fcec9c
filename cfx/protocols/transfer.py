"""The test of a policy that was trained elsewhere, on recordings that it learned nothing from."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import pandas as pd
import torch
from pydantic import Field

from cfx.agents import checkpoint
from cfx.agents.agent import Agent
from cfx.calibration.windows import Split
from cfx.component import Settings
from cfx.errors import DataError
from cfx.files import FilePath
from cfx.learners.base import CURVE_COLUMNS
from cfx.pairs import PairSet
from cfx.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.protocols.held_out import HeldOut

log = logging.getLogger(__name__)


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
    parameters, `population` (constant parameters that were calibrated on the drivers that the
    policy learned from, where there are any), and the driver-specific parameters, from the first 80
    % of each trajectory here. All are tested on the last 20 %; default, population and policy also
    on each full trajectory.

    So all that `default`, `population` and `policy` know comes from elsewhere: what remains of
    their gains is what transfers to another day, road or country. (To calibrate and train on some
    recordings and test on others of the same data, see `across_drivers` with `together=recording`.)

    Differences from the paper: it has no such experiment.
    """

    schema: ClassVar[type[Settings]] = TransferSettings
    settings: TransferSettings
    trains = False
    jobs = ("run",)

    @cached_property
    def policy(self) -> Agent:
        """The policy that is tested, on the CPU.

        Raises:
            DataError: the folder holds none, or none for other drivers than those it was trained
                for.
        """
        try:
            return checkpoint.load(self.settings.run / "policy").for_unseen_drivers()
        except DataError as error:
            raise DataError(f"protocol.run={self.settings.run}: {error}") from None

    def determines(self) -> Mapping[str, Any]:
        policy = self.policy
        return {
            "model": dict(policy.model_node),
            "policy": dict(policy.policy_node),
            "windows": policy.windows.model_dump(),
        }

    def run(self, context: ProtocolContext) -> ProtocolResult:
        policy, pairs, batch = self.policy, context.pairs, context.batch
        self._check(policy, pairs)
        device = batch.lengths.device
        policy = policy.to(device)
        split = Split.of(pairs, context.windows, context.split)
        fixed = context.calibrator.fixed(pairs, batch, split.frame)
        default = context.space.defaults(dtype=fixed.dtype, device=fixed.device)
        start = default[None]
        base = None
        if policy.base is not None:
            start = policy.base.to(fixed.dtype)
            if policy.context_rule.driver_specific:
                base = policy.base_of(fixed)
        population = None
        if policy.population is not None:
            population = policy.population.to(fixed.dtype)
        test = HeldOut(
            context=context,
            pairs=pairs,
            batch=batch,
            network=torch.zeros(len(pairs), dtype=torch.int64, device=device),
            first=split.frame.to(device),
            fixed=fixed,
            base=base,
            unseen_base=start.expand(len(pairs), -1),
            population=population,
            policy=policy,
        )
        notes = {
            "run": str(self.settings.run),
            "pairs_learned_from": len(policy.learned_from),
            "drivers_named_as_some_learned_from": _named_alike(policy, pairs),
        }
        return ProtocolResult(
            test.evaluation(),
            policy,
            pd.DataFrame(columns=CURVE_COLUMNS),
            None,
            notes,
            calibration=context.calibration_metrics("fixed", split.frame, fixed),
        )

    def _check(self, policy: Agent, pairs: PairSet) -> None:
        """Checks that the policy can drive these pairs and has learned from none of them.

        Raises:
            DataError: it cannot, or it has.
        """
        where = f"protocol.run={self.settings.run}"
        if abs(pairs.dt - policy.dt) > 1e-6:
            raise DataError(
                f"{where}: this policy drives in steps of {policy.dt:g} s, {pairs.source} has"
                f" {pairs.dt:g} s; set data.time_step={policy.dt:g}"
            )
        known = [pair.pair_id for pair in pairs if pair.content in policy.learned_from]
        if known:
            raise DataError(
                f"{where}: this policy has learned from {len(known)} of the {len(pairs)} pairs in"
                f" {pairs.source}, the first of them '{known[0]}'; test it on others"
                " (data.recording, data.pair_ids)"
            )
        if not policy.learned_from:
            log.info(
                "%s does not say which pairs its policy has learned from; check yourself that these"
                " are others",
                where,
            )
        alike = _named_alike(policy, pairs)
        if alike:
            log.warning(
                "%d drivers have the same names, including the recording, as some that the policy"
                " has learned from; if they are the same drivers, as in another cut of one"
                " recording, leave them out (data.recording, data.pair_ids)",
                alike,
            )


def _named_alike(policy: Agent, pairs: PairSet) -> int:
    """Counts drivers here who have the name of one that the policy learned from."""
    return len({pair.driver for pair in pairs} & set(policy.learned_from.values()))
