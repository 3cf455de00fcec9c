"""Unseen drivers, forecast from every moment of their trajectories."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
import pandas as pd
import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from cfx.errors import ConfigError, DataError
from cfx.plugin import (
    Agent,
    FixedPolicy,
    FoldsOrFinished,
    FoldsOrFinishedSettings,
    Followers,
    HeldOut,
    ProtocolContext,
    ProtocolResult,
    Settings,
    base_of,
    forecasts,
    in_text,
)
from cfx_forecasts.distributions import Recorded, score_distributions
from cfx_forecasts.errors import forecast_errors, forecast_values, kinematic_paths
from cfx_forecasts.noise import can_drive, constant_with_noise, residual_noise

log = logging.getLogger(__name__)


def _in_order(horizons: tuple[float, ...]) -> tuple[float, ...]:
    if not all(horizon > 0 for horizon in horizons):
        raise ValueError("horizons are seconds greater than 0")
    return tuple(sorted(set(horizons)))


class ForecastSettings(FoldsOrFinishedSettings):
    """Settings of `forecast`."""

    horizons: Annotated[tuple[float, ...], AfterValidator(_in_order)] = Field(
        (0.5, 1.0, 2.0, 3.0, 5.0, 10.0),
        min_length=1,
        description="s: how far ahead errors are measured",
    )
    stride: float = Field(0.5, gt=0, description="s between the origins of a driver")
    min_history: float | None = Field(
        None,
        gt=0,
        description="s of measured history before a driver's first origin, on which driver-specific"
        " parameters are calibrated; null: the share `split` of the trajectory",
    )
    leader: forecasts.LeaderFuture = Field(
        "given",
        description="what is known of the leader after an origin: given: what they did;"
        " constant_speed, constant_acceleration: they go on as at the origin",
    )
    samples: int = Field(
        0,
        ge=0,
        le=1000,
        description="paths sampled from each origin, of a stochastic policy and of constant"
        " parameters with auto-regressive noise, for scores of distributions; 0: none",
    )


class Forecast(FoldsOrFinished):
    """From every moment, knowing the past: where will a driver be in 0.5 to 10 s?

    Folds, calibration and training are those of `across_drivers`, and so is the test part; with
    `run` they are those of `transfer`, and nothing is trained. Beyond it, each test driver is
    forecast from *origins*, one every `stride` s. At an origin all that was measured up to it may
    be read, nothing of the follower after it, and of the leader after it what `leader` says. From
    there all methods are simulated for the longest horizon:

    - `constant_speed`, `constant_acceleration`: the driver goes on as at the origin;
    - `default`: the model's default parameters;
    - `pooled`: pooled parameters, calibrated on the drivers of the other folds;
    - `driver_specific`: driver-specific parameters, calibrated on the driver's trajectory up to
      their first origin: what every origin may read, and nothing after it;
    - `pooled_residual`, `driver_specific_residual`: the same with a residual: they start with the
      acceleration and the jerk at the origin, from which the model takes over within seconds
      (`cfx.models.composed`);
    - `policy`: observes all history up to each origin (`history` bounds it) and drives on from
      there, seeing the simulated follower.

    With `samples` there are also paths that are sampled from each origin (scores of them:
    `cfx_forecasts.distributions`): of a stochastic policy (`learner.head=stochastic`), and
    `pooled_ar`, `driver_specific_ar`, constant parameters with AR(1) noise on the acceleration,
    measured on drivers of the other folds (with `run`, on all test drivers) or on the driver's own
    history, before the first origin.

    Errors of speed and position at each horizon are the RMSE over the origins of a driver, then the
    mean over drivers, with an interval over drivers: origins of one driver overlap and are
    not independent. ADE and FDE are the mean absolute error of position over the way to a horizon,
    and at it. A horizon counts the origins whose recording lasts that long.

    The first origin is where the first part of the trajectory ends (`split`), or after
    `min_history`. With a small `min_history` the table says too how errors depend on the length of
    history; driver-specific parameters then come from that much.

    Differences from the paper: it has no such experiment; it tests from one moment.
    """

    schema: ClassVar[type[Settings]] = ForecastSettings
    settings: ForecastSettings
    trial: ClassVar[Mapping[str, Any]] = {"folds": 3, "horizons": (0.5, 1.0), "histories": ()}

    def run(self, context: ProtocolContext) -> ProtocolResult:
        self._check(context)
        trained = self.trained(context)
        test = trained.test
        evaluation = test.evaluation(self.settings.histories, fold=trained.fold)
        tables = self._forecasts(test)
        values = [in_text(evaluation.values), forecast_values(tables["forecasts"])]
        return replace(
            trained.result(evaluation),
            evaluation=replace(
                evaluation,
                values=pd.concat(values, ignore_index=True),
                tables={**evaluation.tables, **tables},
            ),
            notes={**trained.notes, "forecasts": self._described(tables["forecasts"])},
        )

    def _check(self, context: ProtocolContext) -> None:
        """Checks settings in seconds against the time step.

        Raises:
            ConfigError: one of them is no whole number of steps.
        """
        dt = context.stepper.dt
        named = [("stride", self.settings.stride)]
        named += [("horizons", horizon) for horizon in self.settings.horizons]
        if self.settings.min_history is not None:
            named.append(("min_history", self.settings.min_history))
        for name, seconds in named:
            steps = seconds / dt
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-3:
                raise ConfigError(
                    f"protocol.{name}: {seconds:g} s is no whole number of steps of {dt:g} s; give"
                    f" a multiple of {dt:g}"
                )

    def _forecasts(self, test: HeldOut) -> dict[str, pd.DataFrame]:
        """Forecasts the test drivers by all methods; returns the tables of it by name.

        Raises:
            DataError: no trajectory is long enough for a single forecast.
        """
        s, batch = self.settings, test.batch
        dt = batch.dt
        test = self._from_history(test)
        shortest = round(s.horizons[0] / dt)
        origins = forecasts.Origins.every(
            round(s.stride / dt), test.first, batch.lengths - 1 - shortest
        )
        if len(origins) == 0:
            raise DataError(
                "no trajectory goes on for protocol.horizons after its first origin; lower"
                " protocol.min_history, split or protocol.horizons, or use longer trajectories"
            )
        steps = round(s.horizons[-1] / dt)
        measured, recorded = forecasts.measured_paths(batch, origins, steps)
        self._say_who_is_forecast(test, origins)
        paths = self._paths(test, origins, steps)
        about = (test.pairs, origins)
        table = forecast_errors(*about, paths, measured, recorded, s.horizons, dt)
        tables = {"forecasts": table}
        if s.samples > 0:
            happened = Recorded.of(batch, origins, measured, recorded.cpu())
            paths |= self._sampled(test, origins, steps)
            tables["distributions"] = score_distributions(*about, paths, happened, s.horizons, dt)
        return tables

    def _described(self, table: pd.DataFrame) -> dict[str, Any]:
        """Returns what `data.json` says of the forecasts."""
        of_one = table[table["method"] == table["method"].iloc[0]]
        counts = of_one.groupby("horizon_s").size()
        return {
            "leader": self.settings.leader,
            "horizons_s": list(self.settings.horizons),
            "origins": {f"{horizon:g}": int(count) for horizon, count in counts.items()},
            "history_s": [float(of_one["history_s"].min()), float(of_one["history_s"].max())],
        }

    def _say_who_is_forecast(self, test: HeldOut, origins: forecasts.Origins) -> None:
        """Logs how many drivers there are forecasts of, and horizons that few or none reach."""
        drivers = np.asarray([pair.driver for pair in test.pairs], dtype=object)
        left = test.batch.lengths[origins.pair] - 1 - origins.frame
        all_drivers = len(set(drivers))
        counts = {}
        for horizon in self.settings.horizons:
            reached = left >= round(horizon / test.batch.dt)
            counts[horizon] = len(set(drivers[origins.pair[reached].cpu().numpy()]))
        log.info(
            "Forecasts from %d origins of %d drivers",
            len(origins),
            counts[self.settings.horizons[0]],
        )
        short = [
            f"{horizon:g} s ({count})" for horizon, count in counts.items() if count < all_drivers
        ]
        if short:
            log.info(
                "The recordings of some of the %d drivers end before these horizons (drivers that"
                " count): %s. A smaller split or protocol.min_history leaves more to forecast",
                all_drivers,
                ", ".join(short),
            )

    def _from_history(self, test: HeldOut) -> HeldOut:
        """Returns the test with driver-specific parameters of the history before first origins."""
        seconds = self.settings.min_history
        if seconds is None:
            return test
        context = test.context
        first = torch.full_like(test.first, round(seconds / test.batch.dt))
        first = torch.minimum(first, test.batch.lengths - 2)
        recalibrated = context.calibrator.driver_specific(test.pairs, test.batch, first.cpu())
        base = test.base
        if base is not None:
            base = base_of(test.policy, recalibrated)
        return replace(test, first=first, driver_specific=recalibrated, base=base)

    def _paths(
        self, test: HeldOut, origins: forecasts.Origins, steps: int
    ) -> dict[str, forecasts.Paths]:
        """Returns the paths of all methods."""
        batch, context = test.batch, test.context
        paths = {
            "constant_speed": kinematic_paths(batch, origins, steps, accelerates=False),
            "constant_acceleration": kinematic_paths(batch, origins, steps, accelerates=True),
        }
        each = torch.arange(len(batch), device=origins.pair.device)
        agents = {}
        for name, agent in test.methods_without_history().items():
            agents[name] = (agent, test.network)
        agents["driver_specific"] = (
            context.agents.constant(FixedPolicy(), test.driver_specific),
            each,
        )
        residual = {"driver_specific_residual": (test.driver_specific, each)}
        if test.pooled is not None:
            residual["pooled_residual"] = (test.pooled, test.network)
        for name, (parameters, network) in residual.items():
            agent = context.agents.constant(FixedPolicy(residual=True), parameters)
            if can_drive(context.stepper, agent):
                agents[name] = (agent, network)
        for name, (agent, network) in agents.items():
            simulated = self._from_origins(test, agent, origins, steps, network, (None,))
            paths[name] = forecasts.Paths(simulated.speed[0], simulated.travelled[0])
        return paths

    def _sampled(
        self, test: HeldOut, origins: forecasts.Origins, steps: int
    ) -> dict[str, forecasts.Paths]:
        """Returns sampled paths `(S, Q, K + 1)` of the methods that leave something to chance."""
        context, each = test.context, torch.arange(len(test.batch), device=origins.pair.device)
        agents = {}
        for name, parameters in _constants(test).items():
            noise = residual_noise(test, parameters, of_driver=name == "driver_specific")
            agent = constant_with_noise(context, parameters, *noise)
            if can_drive(context.stepper, agent):
                agents[f"{name}_ar"] = (agent, each)
        if test.policy.core.head.is_stochastic:
            agents["policy"] = (test.policy, test.network)
        paths = {}
        for name, (agent, network) in agents.items():
            generators = []
            for number in range(self.settings.samples):
                seed = context.seed * 1_000_003 + number
                generators.append(torch.Generator().manual_seed(seed))
            log.info("Sampling %d paths of %s", len(generators), name)
            paths[name] = self._from_origins(test, agent, origins, steps, network, generators)
        return paths

    def _from_origins(
        self,
        test: HeldOut,
        agent: Agent,
        origins: forecasts.Origins,
        steps: int,
        network: Tensor,
        generators: Sequence[torch.Generator | None],
    ) -> forecasts.Paths:
        """Returns paths `(S, Q, K + 1)` of an agent."""
        base: Tensor | None = test.unseen_base if test.base is None else test.base
        if agent is not test.policy:
            base = None  # it has a base for each driver, or needs none
        return forecasts.sample_from_origins(
            test.context.stepper,
            agent,
            Followers(test.batch, network, base, test.policy.context_rule.history_s),
            origins,
            steps,
            generators,
            leader=self.settings.leader,
        )


def _constants(test: HeldOut) -> dict[str, Tensor]:
    """Returns constant parameters of each test driver, `(P, n)`, that a residual can go with."""
    if test.context.stepper.model.needs_simulator:
        return {}
    parameters = {"driver_specific": test.driver_specific}
    if test.pooled is not None:
        parameters["pooled"] = test.pooled[test.network]
    return parameters
