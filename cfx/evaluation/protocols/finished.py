"""A policy that was trained elsewhere, tested on recordings that it learned nothing from."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from pydantic import Field

from cfx.core.component import Settings
from cfx.core.files import IN_MEMORY, FilePath
from cfx.data.pairs import LearnedFrom, PairSet
from cfx.errors import DataError
from cfx.evaluation.protocols.across_drivers import AcrossDrivers, AcrossDriversSettings, Trained
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.evaluation.protocols.held_out import HeldOut
from cfx.learners.base import CURVE_COLUMNS
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.known_drivers import base_of
from cfx.simulation.windows import Split

log = logging.getLogger(__name__)


class FinishedPolicy:
    """The policy of a finished job, which is tested and not trained any further.

    Model, policy and windows are that job's. Its network for unseen drivers (`all`, or the only
    one) is tested as its protocol tested it: from driver-specific base parameters or from the
    pooled ones, after as much history.

    Args:
        run: output folder of the job.
    """

    def __init__(self, run: Path) -> None:
        self.run = run

    @cached_property
    def agent(self) -> Agent:
        """The policy, on the CPU.

        Raises:
            DataError: the folder holds none, or none for other drivers than those it was trained
                for.
        """
        try:
            return checkpoint.load_agent(self.run / "policy").for_unseen_drivers()
        except DataError as error:
            raise DataError(f"protocol.run={self.run}: {error}") from None

    def determines(self) -> Mapping[str, Any]:
        """Returns the nodes of the configuration that are the finished job's.

        Raises:
            DataError: the policy cannot be read.
        """
        return {
            "model": dict(self.agent.model_node),
            "policy": dict(self.agent.policy_node),
            "windows": self.agent.windows.model_dump(),
        }

    def tested(self, context: ProtocolContext) -> Trained:
        """Returns the test of all drivers of a recording; driver-specific sets are calibrated.

        Raises:
            DataError: the policy has learned from some of the pairs, or drives in other steps.
        """
        policy, pairs, batch = self.agent, context.pairs, context.batch
        self.check(pairs)
        context.refuse_segments()
        device = batch.lengths.device
        policy = policy.to(device)
        split = Split.of(pairs, context.windows, context.split)
        split.check_test_parts(pairs, context.windows, context.split)
        driver_specific = context.calibrator.driver_specific(pairs, batch, split.frame)
        start, base = context.defaults(driver_specific)[None], None
        if policy.base is not None:
            start = policy.base.to(driver_specific.dtype)
            if policy.context_rule.driver_specific:
                # Of the model alone: constant parameters of a driver are a baseline, `shrunk`.
                base = base_of(policy, driver_specific)[:, : driver_specific.shape[1]]
        pooled = policy.pooled
        test = HeldOut(
            context=context,
            pairs=pairs,
            batch=batch,
            network=torch.zeros(len(pairs), dtype=torch.int64, device=device),
            first=split.frame.to(device),
            driver_specific=driver_specific,
            base=base,
            unseen_base=start.expand(len(pairs), -1),
            pooled=None if pooled is None else pooled.to(driver_specific.dtype),
            policy=policy,
        )
        notes = {
            "run": str(self.run),
            "pooled_over": "its training drivers",
            "pairs_learned_from": len(policy.trained_on.pairs),
            "drivers_named_as_some_learned_from": self._named_alike(pairs),
        }
        return Trained(
            test=test,
            fold=None,
            curves=pd.DataFrame(columns=CURVE_COLUMNS),
            labels=None,
            notes=notes,
            calibration=context.calibration_metrics(
                "driver_specific", split.frame, driver_specific
            ),
        )

    def check(self, pairs: PairSet) -> None:
        """Checks that the policy can drive these pairs and has learned from none of them.

        Raises:
            DataError: it cannot, or it has.
        """
        policy, where = self.agent, f"protocol.run={self.run}"
        if self.run.name == IN_MEMORY:
            where = f"protocol.run={IN_MEMORY}"
        if abs(pairs.dt - policy.dt) > 1e-6:
            raise DataError(
                f"{where}: this policy drives in steps of {policy.dt:g} s, {pairs.source} has"
                f" {pairs.dt:g} s; set data.time_step={policy.dt:g}"
            )
        learned_from = LearnedFrom(policy.trained_on.pairs)
        learned_pairs = [pair.pair_id for pair in pairs if pair in learned_from]
        if learned_pairs:
            raise DataError(
                f"{where}: this policy has learned from {len(learned_pairs)} of the {len(pairs)}"
                f" pairs in {pairs.source}, the first of them '{learned_pairs[0]}'; test it on"
                " others (data.recording, data.pair_ids; in Python pairs.select)"
            )
        if not policy.trained_on.pairs:
            log.info(
                "%s does not say which pairs its policy has learned from; check yourself that these"
                " are others",
                where,
            )
        alike = self._named_alike(pairs)
        if alike:
            log.warning(
                "%d drivers have the same names, including the recording, as some that the policy"
                " has learned from; if they are the same drivers, as in another cut of one"
                " recording, leave them out (data.recording, data.pair_ids)",
                alike,
            )

    def _named_alike(self, pairs: PairSet) -> int:
        """Counts the drivers that have the same name as one that the policy learned from."""
        return len(set(pairs.drivers) & set(self.agent.trained_on.pairs.values()))


class FoldsOrFinishedSettings(AcrossDriversSettings):
    """Settings of protocols that test networks of folds, or a finished job's policy."""

    run: FilePath | None = Field(
        None,
        description="output folder of a finished job, the id of its MLflow run, or cfx://NAME: its"
        " policy is tested on these recordings and nothing is trained; folds, together, base,"
        " shrinkage and history are then that job's; null: networks are trained over folds",
    )


class FoldsOrFinished(AcrossDrivers):
    """Base of protocols that test unseen drivers by networks of folds, or by a finished policy."""

    schema: ClassVar[type[Settings]] = FoldsOrFinishedSettings
    settings: FoldsOrFinishedSettings
    jobs = ("run",)

    @cached_property
    def finished(self) -> FinishedPolicy | None:
        """The finished job's policy; None: networks are trained."""
        if self.settings.run is None:
            return None
        return FinishedPolicy(self.settings.run)

    @property
    def trains(self) -> bool:
        return self.finished is None

    def determines(self) -> Mapping[str, Any]:
        if self.finished is None:
            return {}
        return self.finished.determines()

    def trained(self, context: ProtocolContext) -> Trained:
        if self.finished is None:
            return super().trained(context)
        return self.finished.tested(self._long_enough(context))

    def _long_enough(self, context: ProtocolContext) -> ProtocolContext:
        """Returns the context with the pairs that are long enough to be tested.

        Raises:
            DataError: none is.
        """
        min_duration = self.settings.min_test_duration
        if min_duration is None:
            return context
        long = [number for number, pair in enumerate(context.pairs) if pair.lasts(min_duration)]
        if not long:
            raise DataError(
                f"no pair in {context.pairs.source} lasts"
                f" protocol.min_test_duration={min_duration:g} s; lower it"
            )
        if len(long) == len(context.pairs):
            return context
        log.info("%d pairs are too short to be tested", len(context.pairs) - len(long))
        pairs = context.pairs.take(long)
        rows = torch.tensor(long, device=context.batch.lengths.device)
        return replace(context, pairs=pairs, batch=context.batch[rows])
