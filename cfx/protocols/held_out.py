"""The test of drivers that nothing was learned from: the same for all protocols that have some."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.agents.agent import Agent
from cfx.evaluation.closed_loop import ClosedLoop, simulate_closed_loop
from cfx.evaluation.evaluate import closed_loop_errors, evaluate
from cfx.evaluation.platoon import measure_platoons
from cfx.evaluation.result import Evaluation
from cfx.pairs import PairBatch, PairSet
from cfx.policies.default import DefaultPolicy
from cfx.policies.fixed import FixedPolicy
from cfx.protocols.base import ProtocolContext


@dataclass(frozen=True)
class HeldOut:
    """Q pairs of drivers that nothing was learned from, and what drives them.

    Attributes:
        pairs, batch: the drives.
        network: which of the policy's N networks, and of the populations, drives each, `(Q,)`.
        first: the last measured frame before the test part, `(Q,)`.
        fixed: each driver's own set, `(Q, n)`.
        base: what offsets start from for him, if not from what they do for an unseen driver, `(Q, n)`.
        strange: what offsets start from for a driver of whom nothing is known, `(Q, n)`.
        population: of each network, `(N, n)`; None if there is none.
        policy: what was learned.
    """

    context: ProtocolContext
    pairs: PairSet
    batch: PairBatch
    network: Tensor
    first: Tensor
    fixed: Tensor
    base: Tensor | None
    strange: Tensor
    population: Tensor | None
    policy: Agent

    def evaluation(
        self, histories: Sequence[float] = (), *, fold: Tensor | None = None
    ) -> Evaluation:
        """Drives all methods and compares them.

        Args:
            histories: s, other amounts of history to compare, for policies of offsets.
            fold: in which fold each pair is tested, `(Q,)`; None: there are none.
        """
        context, batch, first, network = self.context, self.batch, self.first, self.network
        names, model = self.policy.names, context.simulator.model
        defaults = context.space.defaults(dtype=self.fixed.dtype, device=self.fixed.device)
        cold_start_fraction = {
            "default": context.constant(DefaultPolicy(), defaults.expand(len(names), -1)),
            "policy": self.policy,
        }
        platoons: dict[str, tuple[Agent, Sequence[str]]] = {
            "default": (context.constant(DefaultPolicy(), defaults[None]), ("any",)),
            "policy": (self.policy, names),
        }
        if self.population is not None:
            cold_start_fraction["population"] = context.constant(FixedPolicy(), self.population)
            platoons["population"] = (cold_start_fraction["population"], names)
        base = self.strange if self.base is None else self.base
        loops = {
            name: simulate_closed_loop(
                context.simulator,
                one,
                batch,
                first,
                network,
                base=base,
                history=self.policy.context_rule.history_s,
            )
            for name, one in cold_start_fraction.items()
        }
        each = torch.arange(len(first), device=first.device)
        loops["fixed"] = simulate_closed_loop(
            context.simulator, context.constant(FixedPolicy(), self.fixed), batch, first, each
        )
        if (
            self.base is not None
            and self.policy.base is not None
            and self.policy.context_rule.shrinkage > 0
        ):
            loops["shrunk"] = simulate_closed_loop(
                context.simulator, context.constant(FixedPolicy(), self.base), batch, first, each
            )
        full_trajectory = {
            name: simulate_closed_loop(
                context.simulator, one, batch, torch.zeros_like(first), network
            )
            for name, one in cold_start_fraction.items()
        }
        return evaluate(
            self.pairs,
            batch,
            first,
            loops,
            context.space,
            context.style,
            adaptation_space=self.policy.space,
            seed=context.seed,
            fold=fold,
            full_trajectory=full_trajectory,
            metrics=context.metrics,
            platoon=measure_platoons(model, platoons),
            history=self.history(histories, loops["fixed"])
            if self.policy.base is not None and histories
            else None,
        )

    def history(self, histories: Sequence[float], fixed: ClosedLoop) -> pd.DataFrame:
        """Drives the test part after reading different amounts of history; see `Evaluation.history`.

        Args:
            histories: s; besides them, all there is.
            fixed: what the drivers' own sets drove there.
        """
        context, batch, first, network = self.context, self.batch, self.first, self.network
        own, _ = closed_loop_errors(batch, first, fixed)
        bases = {"own": self.base} if self.base is not None else {}
        rows = []
        for base, values in {**bases, "population": self.strange}.items():
            for amount in (*sorted(histories), None):
                loop = simulate_closed_loop(
                    context.simulator,
                    self.policy,
                    batch,
                    first,
                    network,
                    base=values,
                    history=amount,
                )
                speed, gap = closed_loop_errors(batch, first, loop)
                read = first.cpu().numpy() * context.simulator.dt
                rows.append(
                    pd.DataFrame(
                        {
                            "pair_id": [pair.pair_id for pair in self.pairs],
                            "driver": [pair.driver for pair in self.pairs],
                            "base": base,
                            "history_s": read if amount is None else np.minimum(read, amount),
                            "amount": f"{context.split:.0%}".replace("%", " %")
                            if amount is None
                            else f"{amount:g} s",
                            "rmse_speed": speed,
                            "rmse_gap": gap,
                            "improvement": np.divide(
                                own - speed, own, out=np.full_like(own, np.nan), where=own > 0
                            ),
                        }
                    )
                )
        return pd.concat(rows, ignore_index=True)
