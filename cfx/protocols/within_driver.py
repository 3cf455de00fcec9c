"""Each driver on his own: the first part of each pair to calibrate and train, the rest to test."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from pydantic import Field

from cfx.agents.placement import ALL, group_by
from cfx.calibration.windows import Split
from cfx.component import Settings
from cfx.evaluation.closed_loop import simulate_closed_loop
from cfx.evaluation.evaluate import evaluate
from cfx.evaluation.platoon import measure_platoons
from cfx.learners.base import TrainingData
from cfx.policies.default import DefaultPolicy
from cfx.policies.fixed import FixedPolicy
from cfx.protocols.base import Protocol, ProtocolContext, ProtocolResult


class WithinDriverSettings(Settings):
    """Settings of `within_driver`."""

    networks: Literal["pair", "all"] = Field(
        "pair",
        description="pair: a network for each pair, as in the paper; all: one network for all pairs",
    )


class WithinDriver(Protocol):
    """The paper's first experiment: the first 80 % of each pair's windows to calibrate and train, the last 20 % to test.

    The fixed parameters come from the training part as one closed-loop drive; the test starts from the last measured state
    of the training part. No frame of the test part is read before the evaluation.
    """

    schema: ClassVar[type[Settings]] = WithinDriverSettings
    settings: WithinDriverSettings

    def run(self, context: ProtocolContext) -> ProtocolResult:
        pairs, batch = context.pairs, context.batch
        split = Split.of(pairs, context.windows, context.split)
        fixed = context.calibrator.fixed(pairs, batch, split.frame)
        labels = context.labels(split.windows, fixed)
        device = batch.lengths.device
        own = torch.arange(len(pairs), device=device)
        network, groups = own, tuple(pair.pair_id for pair in pairs)
        if context.policy.trainable:
            if self.settings.networks == "all":
                network, groups = group_by([ALL] * len(pairs))
                network = network.to(device)
            training_data = TrainingData(
                simulator=context.simulator,
                batch=batch,
                split=split,
                windows=context.windows,
                fixed=fixed,
                labels=labels,
                network=network,
                names=groups,
                seed=context.seed,
                objective=context.objective,
                base=fixed if self.settings.networks == "all" else None,
                drivers=tuple(pair.driver for pair in pairs),
                workspace=context.workspace,
            )
            training_result = context.learner.fit(context.policy, training_data)
        else:
            training_result = context.untrained(context.policy, fixed)
        policy = context.ready(context.policy, training_result, groups)
        first = split.frame.to(device)
        loops = {
            name: simulate_closed_loop(
                context.simulator, context.constant(constant, fixed), batch, first, own
            )
            for name, constant in {"default": DefaultPolicy(), "fixed": FixedPolicy()}.items()
        }
        loops["policy"] = simulate_closed_loop(
            context.simulator, policy, batch, first, network, base=fixed
        )
        platoon = None
        if self.settings.networks == "all" and context.policy.trainable:
            default = context.constant(DefaultPolicy(), fixed[:1])
            platoon = measure_platoons(
                context.simulator.model,
                {"default": (default, ("any",)), "policy": (policy, policy.names)},
            )
        evaluation = evaluate(
            pairs,
            batch,
            first,
            loops,
            context.space,
            context.style,
            adaptation_space=policy.space,
            seed=context.seed,
            platoon=platoon,
            metrics=context.metrics,
        )
        return ProtocolResult(
            evaluation,
            policy,
            training_result.curves,
            labels,
            calibration=context.calibration_metrics("fixed", split.frame, fixed),
        )
