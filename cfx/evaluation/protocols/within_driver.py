"""Each driver alone: the first part of each pair to calibrate and train, the rest to test."""

from __future__ import annotations

import logging
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from cfx.core.component import Settings
from cfx.evaluation.closed_loop import ClosedLoop, Followers
from cfx.evaluation.evaluate import ComparedPairs
from cfx.evaluation.platoon import measure_platoons
from cfx.evaluation.protocols.base import Protocol, ProtocolContext, ProtocolResult
from cfx.evaluation.result import Platoon
from cfx.learners.base import TrainingPairs
from cfx.policies.agent import Agent
from cfx.policies.constant import DefaultPolicy, FixedPolicy
from cfx.policies.core import ANY_DRIVER, group_by
from cfx.simulation.windows import Split

log = logging.getLogger(__name__)


class WithinDriverSettings(Settings):
    """Settings of `within_driver`."""

    networks: Literal["pair", "all"] = Field(
        "pair",
        description="pair: a network for each pair, as in the paper; all: one network for all"
        " pairs",
    )


class WithinDriver(Protocol):
    """The paper's first experiment, on each driver alone.

    The first 80 % of each pair's windows serve to calibrate and train, the last 20 % to test.
    Driver-specific parameters come from one closed-loop simulation of the training part. The test
    starts from the last measured state of the training part. No frame of the test part is read
    before the evaluation. With `split=1` constant parameters are calibrated on whole trajectories,
    and errors are those of the same trajectories.
    """

    schema: ClassVar[type[Settings]] = WithinDriverSettings
    settings: WithinDriverSettings

    def run(self, context: ProtocolContext) -> ProtocolResult:
        pairs, batch = context.pairs, context.batch
        context.check_start(context.pairs)
        context.refuse_segments()
        split = Split.of(pairs, context.windows, context.split)
        whole = context.split == 1 and not context.policy.trainable
        if whole:
            log.warning(
                "split=1: whole trajectories are calibrated on, and errors are those of the same"
                " trajectories: they say how well the parameters fit, not how well they predict"
            )
        else:
            split.check_test_parts(pairs, context.windows, context.split)
        driver_specific = context.calibrator.driver_specific(pairs, batch, split.frame)
        labels = context.labels(split.windows, driver_specific)
        network, names = self._networks(context)
        if context.policy.trainable:
            training_pairs = TrainingPairs(
                index=torch.arange(len(batch), device=batch.lengths.device),
                split=split,
                network=network,
                start=driver_specific,
                base=driver_specific if self.settings.networks == "all" else None,
                labels=labels,
                drivers=tuple(pairs.drivers),
            )
            training_data = context.training_data(training_pairs, names)
            training_result = context.learner.fit(context.policy, training_data)
        else:
            training_result = context.agents.untrained(context.policy, driver_specific)
        policy = context.agents.trained(context.policy, training_result, names)
        first = split.frame.to(batch.lengths.device)
        if whole:
            first = torch.zeros_like(first)
        scopes = {"test": _test_part(context, policy, network, first, driver_specific)}
        tested = ComparedPairs(pairs, batch, first, context.style)
        platoon = self._platoons(context, policy, driver_specific)
        evaluation = context.compared(tested, scopes, policy, platoon)
        return ProtocolResult(
            evaluation,
            policy,
            training_result.curves,
            labels,
            calibration=context.calibration_metrics(
                "driver_specific", split.frame, driver_specific
            ),
        )

    def _networks(self, context: ProtocolContext) -> tuple[Tensor, tuple[str, ...]]:
        """Returns which network learns from each pair `(P,)`, and the networks' names."""
        pairs, device = context.pairs, context.batch.lengths.device
        if context.policy.trainable and self.settings.networks == "all":
            network, names = group_by([ANY_DRIVER] * len(pairs))
            return network.to(device), names
        network = torch.arange(len(pairs), device=device)
        return network, tuple(pairs.ids)

    def _platoons(
        self, context: ProtocolContext, policy: Agent, driver_specific: Tensor
    ) -> Platoon | None:
        """Simulates platoons where one network drives any driver; otherwise None."""
        if self.settings.networks != "all" or not context.policy.trainable:
            return None
        default = context.agents.constant(DefaultPolicy(), driver_specific[:1])
        agents = {"default": (default, ("any",)), "policy": (policy, policy.names)}
        return measure_platoons(context.stepper.model, agents)


def _test_part(
    context: ProtocolContext, policy: Agent, network: Tensor, first: Tensor, driver_specific: Tensor
) -> dict[str, ClosedLoop]:
    """Simulates the test part of P pairs, from frames `first` `(P,)` on, by all methods."""
    default = context.agents.constant(DefaultPolicy(), driver_specific)
    constant = context.agents.constant(FixedPolicy(), driver_specific)
    each = torch.arange(len(first), device=first.device)
    alone = Followers(context.batch, each)
    learned = Followers(context.batch, network, base=driver_specific)
    return {
        "default": context.simulated(default, alone, first),
        "driver_specific": context.simulated(constant, alone, first),
        "policy": context.simulated(policy, learned, first),
    }
