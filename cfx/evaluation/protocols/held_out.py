"""The test of unseen drivers, the same for all protocols that have some.

Shapes: Q test pairs, N networks, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch, PairSet
from cfx.evaluation.closed_loop import ClosedLoop, Followers
from cfx.evaluation.evaluate import ComparedPairs, closed_loop_errors
from cfx.evaluation.platoon import measure_platoons
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.evaluation.protocols.past import (
    PastErrors,
    past_errors,
    with_bounds,
    with_bounds_of_other_folds,
)
from cfx.evaluation.result import Evaluation, Platoon
from cfx.policies.agent import Agent
from cfx.policies.constant import DefaultPolicy, FixedPolicy
from cfx.policies.known_drivers import driver_features_of, unlikeness


@dataclass(frozen=True)
class HeldOut:
    """Q pairs of drivers from whom nothing was learned, and the methods that are tested on them.

    Attributes:
        context: what the protocol composes.
        pairs, batch: the trajectories.
        network: which of the policy's N networks, and of the pooled sets, each pair is tested with,
            `(Q,)`.
        first: the last measured frame before the test part, `(Q,)`.
        driver_specific: driver-specific parameters, `(Q, n)`, SI units.
        base: driver-specific base parameters, `(Q, n)`; None: `unseen_base` for every driver.
        unseen_base: base parameters of drivers of whom nothing is known, `(Q, n)`.
        pooled: pooled parameters, `(N, n)`; None if there are none.
        policy: what was learned.
    """

    context: ProtocolContext
    pairs: PairSet
    batch: PairBatch
    network: Tensor
    first: Tensor
    driver_specific: Tensor
    base: Tensor | None
    unseen_base: Tensor
    pooled: Tensor | None
    policy: Agent

    @property
    def combines(self) -> bool:
        """Whether driver-specific parameters drive beside the policy in the test part."""
        return self.policy.context_rule.combines

    @cached_property
    def past(self) -> PastErrors:
        """What the drivers' pasts say of the policy and of driver-specific parameters."""
        unknown = Followers(self.batch, self.network, self.unseen_base)
        return past_errors(self.context, self.policy, self.pairs, unknown, self.first)

    def evaluation(
        self, histories: Sequence[float] = (), *, fold: Tensor | None = None
    ) -> Evaluation:
        """Simulates all methods and compares them.

        Args:
            histories: s, other amounts of history to compare, for policies of offsets.
            fold: in which fold each pair is tested, `(Q,)`; None: there are none.
        """
        context = self.context
        methods = self.methods_without_history()
        loops = self._test_part(methods)
        tables = {}
        if self.policy.base is not None and histories:
            tables["history"] = self.history(histories, loops["driver_specific"])
        # A policy from elsewhere may know no drivers like these; their pasts say so.
        is_from_elsewhere = fold is None and self.policy.context_rule.history_s is None
        if self.combines or (is_from_elsewhere and self.policy.core.policy.trainable):
            tables["past"] = self._past_table(loops, fold)
        scopes = {"test": loops, "full_trajectory": self._full_trajectory(methods)}
        tested = ComparedPairs(self.pairs, self.batch, self.first, context.style, fold)
        platoon = self._platoons(methods)
        return replace(context.compared(tested, scopes, self.policy, platoon), tables=tables)

    def methods_without_history(self) -> dict[str, Agent]:
        """Returns the agents that need nothing of a test driver beforehand, by method."""
        context, networks = self.context, len(self.policy.names)
        default = context.defaults(self.driver_specific).expand(networks, -1)
        methods = {
            "default": context.agents.constant(DefaultPolicy(), default),
            "policy": self.policy,
        }
        if self.pooled is not None:
            methods["pooled"] = context.agents.constant(FixedPolicy(), self.pooled)
        return methods

    def _test_part(self, methods: Mapping[str, Agent]) -> dict[str, ClosedLoop]:
        """Simulates the test part by all methods."""
        context, rule = self.context, self.policy.context_rule
        loops = {}
        for name, agent in methods.items():
            followers = self._followers(rule.history_s)
            if name == "policy" and self.combines:
                followers = replace(followers, beside=self.past.together_with(self.driver_specific))
            loops[name] = context.simulated(agent, followers, self.first)
        loops["driver_specific"] = self._constant(self.driver_specific)
        if self.base is not None and self.policy.base is not None and rule.shrinkage > 0:
            loops["shrunk"] = self._constant(self.base)
        return loops

    def _followers(self, history: float | None) -> Followers:
        """Returns the drivers of whom this much history is known, s; None: all there is."""
        base = self.unseen_base if self.base is None else self.base
        return Followers(self.batch, self.network, base, history)

    def _past_table(self, loops: Mapping[str, ClosedLoop], fold: Tensor | None) -> pd.DataFrame:
        """Returns a row per driver: what their past says, and what came of it in `loops`."""
        context, past = self.context, self.past
        alone, share, expected = loops["policy"], np.ones_like(past.policy), np.sqrt(past.policy)
        if self.combines:
            share, expected = past.weight, past.both
            alone = context.simulated(self.policy, self._followers(None), self.first)
        loops = {
            "driver_specific": loops["driver_specific"],
            "alone": alone,
            "policy": loops["policy"],
        }
        table = pd.DataFrame(
            {
                "pair_id": self.pairs.ids,
                "driver": self.pairs.drivers,
                "share": share,
                "past_rmse_speed_driver_specific": np.sqrt(past.driver_specific),
                "past_rmse_speed_alone": np.sqrt(past.policy),
                "past_rmse_speed_policy": expected,
            }
        )
        for name, loop in loops.items():
            table[f"rmse_speed_{name}"], _ = closed_loop_errors(self.batch, self.first, loop)
        features = driver_features_of(self.policy, self.batch, self.first)
        if features is not None:
            away = unlikeness(self.policy, features, self.network).abs()
            names = np.array(self.policy.core.driver_features)
            table["unlike"] = away.max(1).values.cpu().numpy()
            table["unlike_in"] = np.where(
                table["unlike"].notna(), names[away.argmax(1).cpu().numpy()], ""
            )
        if fold is None:
            return with_bounds(table, self.policy.trained_on.expected_error)
        return with_bounds_of_other_folds(table, fold.cpu().numpy())

    def _constant(self, parameters: Tensor) -> ClosedLoop:
        """Simulates the test part with constant parameters of each driver, `(Q, n)`."""
        agent = self.context.agents.constant(FixedPolicy(), parameters)
        each = torch.arange(len(self.first), device=self.first.device)
        return self.context.simulated(agent, Followers(self.batch, each), self.first)

    def _full_trajectory(self, methods: Mapping[str, Agent]) -> dict[str, ClosedLoop]:
        """Simulates the test trajectories from their first frame on."""
        begin, followers = torch.zeros_like(self.first), Followers(self.batch, self.network)
        loops = {}
        for name, agent in methods.items():
            loops[name] = self.context.simulated(agent, followers, begin)
        return loops

    def _platoons(self, methods: Mapping[str, Agent]) -> Platoon | None:
        context = self.context
        agents: dict[str, tuple[Agent, Sequence[str]]] = {}
        for name, agent in methods.items():
            agents[name] = (agent, self.policy.names)
        default = context.agents.constant(
            DefaultPolicy(), context.defaults(self.driver_specific)[None]
        )
        agents["default"] = (default, ("any",))
        return measure_platoons(context.stepper.model, agents)

    def history(self, histories: Sequence[float], driver_specific: ClosedLoop) -> pd.DataFrame:
        """Simulates the test part after different amounts of history.

        Args:
            histories: s; besides them, all there is.
            driver_specific: the simulation with driver-specific parameters.
        """
        bases = {}
        if self.base is not None:
            bases["driver_specific"] = self.base
        bases["pooled"] = self.unseen_base
        error_of_driver_specific, _ = closed_loop_errors(self.batch, self.first, driver_specific)
        tables = []
        for name, values in bases.items():
            for amount in (*sorted(histories), None):
                table = self._after_history(values, amount, error_of_driver_specific)
                table.insert(2, "base", name)
                tables.append(table)
        return pd.concat(tables, ignore_index=True)

    def _after_history(
        self, base: Tensor, amount: float | None, error_of_driver_specific: np.ndarray
    ) -> pd.DataFrame:
        """Simulates the test part after one amount of history, s; None: all there is."""
        context = self.context
        followers = Followers(self.batch, self.network, base, amount)
        loop = context.simulated(self.policy, followers, self.first)
        speed, gap = closed_loop_errors(self.batch, self.first, loop)
        observed = self.first.cpu().numpy() * context.stepper.dt
        text = f"{100 * context.split:.0f} %"
        if amount is not None:
            observed = np.minimum(observed, amount)
            text = f"{amount:g} s"
        improvement = np.full_like(error_of_driver_specific, np.nan)
        np.divide(
            error_of_driver_specific - speed,
            error_of_driver_specific,
            out=improvement,
            where=error_of_driver_specific > 0,
        )
        return pd.DataFrame(
            {
                "pair_id": self.pairs.ids,
                "driver": self.pairs.drivers,
                "history_s": observed,
                "amount": text,
                "rmse_speed": speed,
                "rmse_gap": gap,
                "improvement": improvement,
            }
        )
