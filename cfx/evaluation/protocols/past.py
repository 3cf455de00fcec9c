"""What drivers' pasts say of a policy and of driver-specific parameters.

The past of each driver, up to the test part, is split once more. On the first 60 % of it
driver-specific parameters are calibrated, and the policy observes it; the rest is simulated with
each of the two, and neither has seen it. Of the errors of speed e_constant(t) and e_policy(t) there
follows the policy's share where both drive together (`cfx.models.composed`): that of the mean which
errs least, and not far from a half,

    minimise over w   sum (w e_policy + (1 - w) e_constant)^2 + S (w - 1/2)^2

with S the mean of the two sums of squares. Without correlation that lies between a half and the
weight of J. M. Bates and C. W. J. Granger (1969); C. W. J. Granger and R. Ramanathan (1984),
*Improved methods of combining forecasts*, J. Forecasting 3(2), have the regression, whose weights
vary much where the past is short, so it is shrunk here. In the test, driver-specific parameters are
those calibrated on all of the past.

Shapes: D drivers, K + 1 frames, n tuned parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.data.pairs import PairBatch, PairSet
from cfx.evaluation.closed_loop import ClosedLoop, Followers, ParametersBeside
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.evaluation.result import Array
from cfx.policies.agent import Agent
from cfx.policies.constant import FixedPolicy
from cfx.policies.context import ExpectedError, conformal_bound
from cfx.policies.known_drivers import base_of

EARLIER = 0.6
"""Share of the past on which driver-specific sets are calibrated, to be tested on the rest."""

SHORTEST_S = 3.0
"""s: a past of which either part is shorter says nothing."""


@dataclass(frozen=True)
class PastErrors:
    """Errors of speed over the last part of D drivers' pasts; NaN where the past is too short.

    Attributes:
        beside: mean square of parameters calibrated on the part before, which start as the policy
            does: with the driver's acceleration if its head has a residual, `(D,)`, m2/s2.
        policy: of the policy that has observed the part before, `(D,)`, m2/s2.
        product: mean product of the two errors, `(D,)`, m2/s2.
        driver_specific: mean square of the same parameters without that start, as the method
            `driver_specific`.
    """

    beside: Array
    policy: Array
    product: Array
    driver_specific: Array

    @property
    def weight(self) -> Array:
        """The policy's share, `(D,)`; 1 where the past says nothing."""
        pull = (self.beside + self.policy) / 2.0
        apart = self.beside + self.policy - 2.0 * self.product + pull
        best = self.beside - self.product + pull / 2.0
        share = np.divide(best, apart, out=np.full_like(apart, 0.5), where=apart != 0)
        return np.where(np.isfinite(apart), share.clip(0.0, 1.0), 1.0)

    @property
    def both(self) -> Array:
        """RMSE of the weighted mean of the two simulations, `(D,)`, m/s."""
        weight = self.weight
        squares = weight**2 * self.policy + (1.0 - weight) ** 2 * self.beside
        squared_error = squares + 2.0 * weight * (1.0 - weight) * self.product
        return np.sqrt(np.maximum(squared_error, 0.0))

    def together_with(self, values: Tensor) -> ParametersBeside:
        """Returns the driver-specific parameters that drive beside the policy.

        Args:
            values: calibrated on all of the past, `(D, n)`, SI units.
        """
        return ParametersBeside(values, torch.as_tensor(self.weight).to(values))


def past_errors(
    context: ProtocolContext,
    policy: Agent,
    pairs: PairSet,
    followers: Followers,
    first: Tensor,
) -> PastErrors:
    """Simulates the last part of D drivers' pasts with the policy and with driver-specific sets.

    Args:
        context: what the protocol composes.
        policy: the policy.
        pairs: the drivers' D pairs.
        followers: the same, with the base parameters of drivers of whom nothing is known.
        first: the last frame of each driver's past, `(D,)`.
    """
    stride, batch = context.windows.stride, followers.batch
    cut = (EARLIER * first).long() // stride * stride
    shortest = round(SHORTEST_S / batch.dt)
    long_enough = (cut >= shortest) & (first - cut >= shortest)
    errors_by_method = np.full((4, len(first)), np.nan)
    if bool(long_enough.any()):
        rows = long_enough.nonzero()[:, 0]
        numbers = rows.tolist()
        pairs = pairs.take(numbers)
        first, cut, network = first[rows], cut[rows], followers.network[rows]
        assert followers.base is not None
        base, batch = followers.base[rows], batch[rows].until(first)
        early = context.calibrator.driver_specific(pairs, batch, cut.cpu()).to(base)
        if policy.base is not None and policy.context_rule.driver_specific:
            base = base_of(policy, early)[:, : early.shape[1]]
        each = torch.arange(len(rows), device=rows.device)
        model = context.stepper.model
        residual = policy.core.head.driven_model(model) is not model

        def errors(agent: Agent, followers: Followers) -> Tensor:
            return _speed_errors(context.simulated(agent, followers, cut), batch, cut)

        of_policy = errors(policy, Followers(batch, network, base))
        of_driver_specific = errors(
            context.agents.constant(FixedPolicy(), early), Followers(batch, each)
        )
        of_start = of_driver_specific
        if residual:
            start = context.agents.constant(FixedPolicy(residual=True), early)
            of_start = errors(start, Followers(batch, each))
        frames = (first - cut).to(of_start)
        products = (
            of_start * of_start,
            of_policy * of_policy,
            of_start * of_policy,
            of_driver_specific * of_driver_specific,
        )
        for row, product in zip(errors_by_method, products, strict=True):
            row[numbers] = (product.sum(1) / frames).cpu().numpy()
    return PastErrors(*errors_by_method)


def expected_error(table: pd.DataFrame, fold: NDArray[np.int64]) -> ExpectedError:
    """Returns by what factors errors in the past bound those of the test.

    Args:
        table: a row per driver, with `rmse_speed_METHOD` and `past_rmse_speed_METHOD`, m/s, of
            `policy` and `driver_specific`.
        fold: in which fold each was tested, `(D,)`; each fold counts once.
    """
    factors = []
    for method in ("policy", "driver_specific"):
        past = table[f"past_rmse_speed_{method}"]
        growth = table[f"rmse_speed_{method}"] / past.where(past > 0)
        factors.append(conformal_bound(growth.to_numpy(dtype=np.float64), fold))
    return ExpectedError(*factors)


def expected_of_unseen(
    speed: pd.DataFrame, fold: NDArray[np.int64], expected: ExpectedError
) -> ExpectedError:
    """Returns expected errors completed by those of drivers without any history.

    Args:
        speed: RMSE of speed over full trajectories, m/s: a row per driver, a column per method.
        fold: in which fold each was tested, `(D,)`; each fold counts once.
        expected: errors of drivers with history.
    """
    if not {"policy", "pooled"} <= set(speed):
        return expected
    policy = conformal_bound(speed["policy"].to_numpy(dtype=np.float64), fold)
    constant = conformal_bound(speed["pooled"].to_numpy(dtype=np.float64), fold)
    return replace(expected, unseen=policy, unseen_constant=constant)


def with_bounds(table: pd.DataFrame, expected: ExpectedError | None) -> pd.DataFrame:
    """Adds what 90 % of drivers' errors stay below, m/s.

    The columns are `bound_policy` and `bound_driver_specific`.

    Args:
        table: as of `expected_error`.
        expected: of the policy; None: it is not known.
    """
    expected = expected or ExpectedError()
    bounds = {}
    for method, factor in (("policy", expected.policy), ("driver_specific", expected.own)):
        times = math.nan if factor is None else factor
        bounds[f"bound_{method}"] = times * table[f"past_rmse_speed_{method}"]
    return table.assign(**bounds)


def with_bounds_of_other_folds(table: pd.DataFrame, fold: NDArray[np.int64]) -> pd.DataFrame:
    """Adds bounds to each driver that errors of the other folds' drivers give."""
    parts = []
    for number in np.unique(fold):
        others = fold != number
        parts.append(with_bounds(table[~others], expected_error(table[others], fold[others])))
    return pd.concat(parts).sort_index()


def _speed_errors(loop: ClosedLoop, batch: PairBatch, first: Tensor) -> Tensor:
    """Returns simulated minus measured speed, `(D, K + 1)`, m/s; 0 where no frame counts."""
    frames = first[:, None] + torch.arange(loop.speed.shape[1], device=first.device)
    measured = batch.follower_speed.gather(1, frames.clamp(max=batch.mask.shape[1] - 1))
    return torch.where(loop.counted, loop.speed - measured, 0.0).double()
