"""Traffic of sampled drivers: does it come out as on real roads?"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, NamedTuple

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from cfx.errors import ConfigError
from cfx.plugin import (
    ANY_DRIVER,
    Agent,
    AgentState,
    FixedPolicy,
    FoldsOrFinished,
    FoldsOrFinishedSettings,
    Followers,
    HeldOut,
    MemoryStepper,
    ProtocolContext,
    ProtocolResult,
    Settings,
    burnt_in,
    measured_history,
    require_memory,
    roads,
)
from cfx_forecasts.noise import can_drive, constant_with_noise, residual_noise
from cfx_forecasts.traffic.measure import UPSTREAM_M, Measured, traffic_of

log = logging.getLogger(__name__)

_DRAWN = 7_919
"""Keeps the random numbers of roads and drivers apart from those of other parts of a job."""

_COPIES = 8
"""Signals of all vehicles at all frames that are in memory at once, about."""


def _rising(levels: tuple[float, ...]) -> tuple[float, ...]:
    if not all(level > 0 for level in levels):
        raise ValueError("levels are greater than 0")
    return tuple(sorted(set(levels)))


Levels = Annotated[tuple[float, ...], AfterValidator(_rising)]


class TrafficSettings(FoldsOrFinishedSettings):
    """Settings of `traffic`."""

    densities: Levels = Field(
        (15.0, 25.0, 35.0, 45.0, 55.0, 65.0, 80.0, 100.0),
        min_length=1,
        description="vehicles/km of the ring roads; the circumference follows",
    )
    vehicles: int = Field(40, ge=2, le=2000, description="vehicles of each ring road")
    repetitions: int = Field(
        2,
        ge=1,
        le=100,
        description="ring roads of each density and platoons behind each leader, with other"
        " drivers on each",
    )
    perturbation: float = Field(
        0.1,
        ge=0,
        lt=0.5,
        description="how far each vehicle of a ring may be from its even place at the start, as a"
        " share of the mean gap",
    )
    demands: Levels = Field(
        (900.0, 1300.0, 1700.0, 2100.0),
        description="vehicles/h that enter the open roads; empty: there are none",
    )
    entry_speed: float = Field(
        15.0, gt=0, le=100, description="m/s: with which vehicles enter open roads"
    )
    bottleneck_speed: float = Field(
        6.0, gt=0, le=100, description="m/s: speed limit in the bottleneck of open roads"
    )
    bottleneck: tuple[float, float] = Field(
        (1000.0, 1500.0),
        description="m from the entry at which the bottleneck begins and ends",
    )
    leader_speeds: Levels = Field(
        (4.0, 7.0, 10.0, 14.0),
        description="m/s: constant speeds of the leaders of platoons; empty: there are none",
    )
    platoon: int = Field(25, ge=2, le=2000, description="vehicles of each platoon with its leader")
    noise: tuple[float, float] | None = Field(
        None,
        description="time constant, s, and standard deviation, m/s2, of the noise on the"
        " acceleration of constant parameters; null: as measured on each driver",
    )
    duration: float = Field(600.0, gt=0, description="s: how long all roads are simulated")
    settle: float = Field(
        300.0, ge=0, description="s from the start that do not count, in which traffic settles"
    )

    @model_validator(mode="after")
    def _in_order(self) -> TrafficSettings:
        if self.settle >= self.duration:
            raise ValueError(
                f"settle={self.settle:g} s leaves nothing of duration={self.duration:g} s; give a"
                " longer duration"
            )
        begin, end = self.bottleneck
        if self.noise is not None and not (self.noise[0] > 0 and self.noise[1] >= 0):
            raise ValueError("noise is a time constant in s above 0 and a deviation of 0 or more")
        if not 0 < begin < end:
            raise ValueError(f"bottleneck=[{begin:g}, {end:g}] has to begin after 0 and end later")
        return self


class _Kind(NamedTuple):
    """Who drives: an agent, where each of the P recorded drivers stands, and whether it draws."""

    agent: Agent
    state: AgentState
    draws: bool


class TrafficProtocol(FoldsOrFinished):
    """Does traffic come out right if all vehicles are driven by what was calibrated or learned?

    Folds, calibration, training and the test part are those of `across_drivers`; with `run` they
    are those of `transfer`, and nothing is trained. Beyond it, test drivers are set on roads, all
    at once (`cfx.evaluation.roads`): on ring roads of each density, on open roads with a
    bottleneck at each demand, and in platoons behind leaders that keep their speed. Each vehicle is
    a test driver, drawn with replacement; every method has the same drivers at the same places:

    - `pooled`: pooled parameters of all drivers, the same for every vehicle;
    - `driver_specific`: the driver-specific parameters of the vehicle's driver;
    - `pooled_ar`, `driver_specific_ar`: the same with AR(1) noise on the acceleration, measured on
      all drivers, or on the driver, or as `noise` says;
    - `policy`: the policy, driven at its centre where it is stochastic;
    - `policy_sampled`: the same, drawn with the job's seed, of a stochastic policy.

    Before the start a policy has observed the first part of the driver's trajectory, as before the
    test part (`history` bounds it), and it drives with the network of the driver's fold, which has
    learned nothing from them. On the road it sees nothing but the simulation.

    The result is compared with the recording where pairs can say something: flow against density,
    how much speeds vary, and how fast waves travel from leaders to followers.

    Differences from the paper: it has no such experiment.
    """

    schema: ClassVar[type[Settings]] = TrafficSettings
    settings: TrafficSettings
    trial: ClassVar[Mapping[str, Any]] = {
        "folds": 3,
        "histories": (),
        "densities": (30.0,),
        "vehicles": 5,
        "demands": (900.0,),
        "leader_speeds": (8.0,),
        "platoon": 3,
        "duration": 10.0,
        "settle": 5.0,
    }

    def run(self, context: ProtocolContext) -> ProtocolResult:
        length = float(context.batch.leader_length.mean())
        lanes = self._lanes(context, length)
        trained = self.trained(context)
        test = trained.test
        evaluation = test.evaluation(self.settings.histories, fold=trained.fold)
        traffic = self._traffic(test, lanes)
        notes = {**trained.notes, "traffic": self._described(lanes, traffic)}
        tables = {**evaluation.tables, **traffic.tables}
        return ProtocolResult(
            replace(evaluation, tables=tables),
            test.policy,
            trained.curves,
            trained.labels,
            notes,
            calibration=trained.calibration,
        )

    def _lanes(self, context: ProtocolContext, length: float) -> roads.Lanes:
        """Returns all roads.

        Raises:
            ConfigError: a setting does not fit the vehicles or the model, which is known before any
                work begins.
        """
        s, model = self.settings, context.stepper.model
        if model.needs_simulator:
            raise ConfigError(
                f"protocol=traffic: model={context.model_node['name']} has equations in"
                f" {model.needs_simulator} only, and cfx simulates the roads itself; choose a model"
                " that cfx has, such as krauss or idm"
            )
        self._check(length, context.windows.stride * context.stepper.dt)
        generator = torch.Generator().manual_seed(context.seed * _DRAWN + 1)
        parts = [
            roads.ring_roads(
                s.densities, s.vehicles, s.repetitions, length, s.perturbation, generator
            )
        ]
        if s.demands:
            bottleneck = roads.Bottleneck(*s.bottleneck, s.bottleneck_speed)
            parts.append(roads.open_roads(s.demands, s.entry_speed, s.duration, bottleneck, length))
        if s.leader_speeds:
            parts.append(roads.platoons(s.leader_speeds, s.platoon, s.repetitions, length))
        return roads.joined(parts).to(context.batch.lengths.device)

    def _check(self, length: float, interval: float) -> None:
        """Checks whether vehicles of this length, m, fit on the roads and into the memory.

        Args:
            length: m.
            interval: s between the frames that are kept.

        Raises:
            ConfigError: they do not.
        """
        s = self.settings
        of_rings = len(s.densities) * s.repetitions * s.vehicles
        of_platoons = len(s.leader_speeds) * s.repetitions * s.platoon
        vehicles = of_rings + of_platoons + sum(s.demands) * s.duration / 3600.0
        require_memory(
            _COPIES * 8.0 * vehicles * s.duration / interval,
            f"protocol.duration={s.duration:g} of {vehicles:.0f} vehicles",
        )
        most = 1000.0 / (length + 0.5)
        if s.densities[-1] > most:
            raise ConfigError(
                f"protocol.densities: {s.densities[-1]:g} vehicles/km do not fit, as vehicles are"
                f" {length:.1f} m long; give at most {most:.0f}"
            )
        spacing = length + 0.5
        if s.demands and s.entry_speed * 3600.0 / s.demands[-1] < spacing:
            raise ConfigError(
                f"protocol.demands: {s.demands[-1]:g} vehicles/h do not fit at"
                f" protocol.entry_speed={s.entry_speed:g} m/s; give at most"
                f" {s.entry_speed * 3600.0 / spacing:.0f}"
            )

    def _traffic(self, test: HeldOut, lanes: roads.Lanes) -> Measured:
        """Lets all kinds of drivers drive on all roads, and measures."""
        s, context = self.settings, test.context
        generator = torch.Generator().manual_seed(context.seed * _DRAWN + 2)
        drivers = torch.randint(len(test.pairs), (len(lanes),), generator=generator)
        drivers = drivers.to(lanes.position.device)
        driven: dict[str, roads.Driven] = {}
        for method, kind in self._kinds(test).items():
            log.info(
                "Traffic: %d vehicles on %d roads for %g s, driven by %s",
                len(lanes),
                len(lanes.roads),
                s.duration,
                method,
            )
            chance = None
            if kind.draws:
                chance = torch.Generator().manual_seed(context.seed * _DRAWN + 3)
            state = kind.state.of(drivers)
            driven[method] = roads.simulate_roads(
                context.stepper.model, kind.agent, state, lanes, s.duration, chance
            )
        return traffic_of(driven, lanes, s.settle, test.batch)

    def _kinds(self, test: HeldOut) -> dict[str, _Kind]:
        """Returns who drives, by method."""
        s, context = self.settings, test.context
        kinds: dict[str, _Kind] = {}
        if context.stepper.model.has_constant_baseline:
            constants = {"driver_specific": test.driver_specific}
            pooled = _pooled(test)
            if pooled is not None:
                constants = {"pooled": pooled, **constants}
            for name, parameters in constants.items():
                kinds |= _constant_kinds(test, name, parameters, s.noise)
        if context.policy.adapts or not kinds:
            state = _observed(test, test.policy, test.network)
            kinds["policy"] = _Kind(test.policy, state, draws=False)
            if test.policy.core.head.is_stochastic:
                kinds["policy_sampled"] = _Kind(test.policy, state, draws=True)
        return kinds

    def _described(self, lanes: roads.Lanes, traffic: Measured) -> dict[str, Any]:
        """Returns what `data.json` says of the traffic."""
        speed = traffic.real_wave_speed
        return {
            "vehicles": len(lanes),
            "roads": len(lanes.roads),
            "vehicle_length_m": lanes.length,
            "duration_s": self.settings.duration,
            "settle_s": self.settings.settle,
            "upstream_m": UPSTREAM_M,
            "recorded_pairs_with_waves": traffic.real_waves,
            "recorded_wave_speed_kmh": speed if math.isfinite(speed) else None,
        }


def _pooled(test: HeldOut) -> Tensor | None:
    """Returns the pooled parameters of all drivers for each test driver, `(P, n)`; None: none."""
    if test.pooled is None:
        return None
    if ANY_DRIVER not in test.policy.names:
        return test.pooled[test.network]
    number = test.policy.names.index(ANY_DRIVER)
    return test.pooled[number].expand(len(test.pairs), -1)


def _constant_kinds(
    test: HeldOut, name: str, parameters: Tensor, noise: tuple[float, float] | None
) -> Mapping[str, _Kind]:
    """Returns constant parameters of each test driver, `(P, n)`, without and with noise."""
    context = test.context
    each = torch.arange(len(test.pairs), device=parameters.device)
    agent = context.agents.constant(FixedPolicy(), parameters)
    kinds = {name: _Kind(agent, agent.begin(each), draws=False)}
    if noise is None:
        time, scale = residual_noise(test, parameters, of_driver=name == "driver_specific")
        log.info(
            "Noise of %s_ar as measured: %.2f m/s2 that lasts %.1f s",
            name,
            float(scale.square().mean().sqrt()),
            float(time.mean()),
        )
    else:
        ones = torch.ones_like(parameters[:, 0])
        time, scale = noise[0] * ones, noise[1] * ones
    noisy = constant_with_noise(context, parameters, time, scale)
    if can_drive(MemoryStepper(context.stepper.model, noisy.dt), noisy):
        kinds[f"{name}_ar"] = _Kind(noisy, noisy.begin(each), draws=True)
    return kinds


def _observed(test: HeldOut, agent: Agent, network: Tensor) -> AgentState:
    """Returns where an agent stands with each test driver when the test part begins.

    It has observed the history before and has chosen the parameters of the first window of the test
    part, as when it drives there.
    """
    base = test.unseen_base if test.base is None else test.base
    followers = Followers(test.batch, network, base, agent.context_rule.history_s)
    state = burnt_in(agent, followers, test.first, agent.dt)
    pairs = torch.arange(len(test.batch), device=test.first.device)
    now = measured_history(test.batch, pairs, test.first, agent.windows.length)
    _, state = agent.act(now, state)
    return state
