"""What traffic a driver makes: measured on simulated roads, beside what is usual.

A model that follows one leader well may still fill a road wrongly. So many vehicles drive by one
driver, and what they make together is measured:

- Equilibrium: behind a leader of constant speed, from time gaps of 1 and 2.5 s. A driver has one
  equilibrium, whatever it began with.
- Capacity: the largest flow of a ring, over its density.
- A dip of the leader's speed, along a platoon of 25 vehicles.
- Sugiyama's ring: 22 vehicles on 230 m (Y. Sugiyama et al., 2008, *Traffic jams without
  bottlenecks*, New Journal of Physics 10, 033001).

Usual values: Transportation Research Board (2016), *Highway Capacity Manual*; M. Treiber and A.
Kesting (2013), *Traffic Flow Dynamics*.

Shapes: S speeds, T time gaps at the start, D vehicles, W stored frames.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from cfx.core.registry import create
from cfx.data.steady import VEHICLE_M, Floats, GapRelation, flow, relation_from
from cfx.errors import DataError
from cfx.evaluation import roads
from cfx.evaluation.waves import ring_waves
from cfx.models.base import DrivingModel
from cfx.policies.agent import Agent, AgentState
from cfx.policies.context import UNSEEN, DriverContext

__all__ = [
    "DIP_MPS",
    "FLEET_SHARES",
    "FLEET_SPEEDS_MPS",
    "FLOW_TOLERANCE",
    "PLATOON",
    "SPEEDS_MPS",
    "TIME_GAPS_S",
    "USUAL",
    "DriverTraffic",
    "Measure",
    "RecordedFlows",
    "Usual",
    "driver_traffic",
    "fleet_time_gaps",
    "recorded_flows",
    "settled_gaps",
    "table_of",
]
"""What plugins may use, as `cfx.plugin.traffic`."""

SPEEDS_MPS = (2.0, 4.5, 7.5, 10.5, 14.0, 18.0, 22.5, 27.5, 32.0)
"""m/s: speeds of the leaders behind whom equilibria are measured."""

TIME_GAPS_S = (1.0, 2.5)
"""s: time gaps at which vehicles begin."""

EQUILIBRIUM_S = 240.0
"""s: after which the gap is measured."""

FLEET_SPEEDS_MPS = (10.0, 15.0, 25.0)
"""m/s: speeds at which time gaps of a fleet are measured."""

FLEET_SHARES = (0.25, 0.5, 0.75)
"""Shares of drivers whose time gaps are shorter."""

_FLEET_DRIVERS = 60
"""Drivers of the population, evenly over it."""

_DENSITIES = tuple(float(density) for density in range(10, 66, 4))
_RING_VEHICLES, _RING_S = 20, 600.0
"""Vehicles/km, vehicles and duration of the rings on which capacity is measured."""

_SETTLED = 0.6
"""Share of the time after which rings are measured."""

PLATOON = 25
"""Vehicles behind the leader."""

DIP_MPS = 5.0
"""m/s: how deep the dip of a platoon's leader is."""

_DIP_FROM_MPS, _DIP_MPS2, _DIP_S = 15.0, 1.0, 5.0
"""Speed before the dip, how hard the leader changes speed, how long it stays slow."""

_DIP_BEGINS_S, _DIP_LASTS_S = 300.0, 200.0
"""How long the platoon settles before the dip, and how long vehicles are watched from then on."""

_AVERAGED_S = 10.0
"""Over so long speeds and gaps of settled vehicles are averaged, s."""

_SUGIYAMA, _SUGIYAMA_M, _SUGIYAMA_S = 22, 230.0, 600.0
_PERTURBATION = 0.1
"""Vehicles, circumference (m) and duration (s); the share of gaps by which starts are shifted."""

REFERENCES = Path(__file__).with_name("recorded_flows.json")
"""Relations of speed and gap of recorded drivers, and the command that measured them."""


class Usual(NamedTuple):
    """What values of a measure are usual.

    Attributes:
        low, high: least and greatest; infinity where there is none.
        below, above: one word for a value outside.
    """

    low: float
    high: float
    below: str = "low"
    above: str = "high"


UNLIMITED = math.inf
USUAL = {
    "capacity": Usual(2050.0, 2400.0),
    "dip_last": Usual(0.0, DIP_MPS + 0.2, above="grows"),
    "ring_speed_std": Usual(0.5, 4.0, "calm", "violent"),
    "ring_wave_speed": Usual(-20.0, -15.0, "fast", "slow"),
    "least_gap": Usual(0.5, UNLIMITED, below="close"),
    "starts_differ": Usual(0.0, 3.0, above="several"),
    "saturation_flow": Usual(1700.0, 1950.0),
    "start_up_lost_time": Usual(1.5, 2.5, "short", "long"),
    "discharge": Usual(1800.0, 2000.0),
    "town_throughput": Usual(0.95, 1.1),
}
"""Usual values by measure; `flow_at_...` are compared with recordings."""

FLOW_TOLERANCE = 0.1
"""Share by which an equilibrium's flow may differ from the recorded one."""

_TITLES = {
    "capacity": ("capacity on rings", "vehicles/h"),
    "dip_last": ("dip of 5 m/s at the 25th vehicle", "m/s"),
    "ring_speed_std": ("Sugiyama's ring: standard deviation of speeds", "m/s"),
    "ring_wave_speed": ("Sugiyama's ring: speed of waves", "km/h"),
    "least_gap": ("least gap on rings and in platoons", "m"),
    "starts_differ": ("equilibria from 1 s and 2.5 s differ by", "%"),
    "saturation_flow": ("saturation flow at a light", "vehicles/h"),
    "start_up_lost_time": ("start-up lost time", "s"),
    "discharge": ("discharge behind a lane drop", "vehicles/h, lane"),
    "town_throughput": ("arrivals in a town over SUMO's Krauss with tau=1.4", ""),
}


class Measure(NamedTuple):
    """One measured value beside what is usual.

    Attributes:
        name: such as `capacity`, or `flow_at_10.5` for an equilibrium.
        value: NaN where there was nothing to measure.
        step: time step of the simulation, s.
        low, high: usual values; NaN where none are known.
        word: says how the value is outside; "" where it is not.
    """

    name: str
    value: float
    step: float
    low: float
    high: float
    word: str

    @classmethod
    def of(cls, name: str, value: float, step: float) -> Measure:
        """Returns a measure that `USUAL` has."""
        usual = USUAL[name]
        verdict = ""
        if value < usual.low:
            verdict = usual.below
        elif value > usual.high:
            verdict = usual.above
        return cls(name, value, step, usual.low, usual.high, verdict)

    @classmethod
    def of_flow(cls, speed: float, flows: Floats, recorded: float, step: float) -> Measure:
        """Returns the flow of an equilibrium, vehicles/h, in the mean over starts.

        Args:
            speed: m/s.
            flows: from each start, `(T,)`; each of them has to be as recorded.
            recorded: NaN where nothing was.
            step: s.
        """
        low, high = (1.0 - FLOW_TOLERANCE) * recorded, (1.0 + FLOW_TOLERANCE) * recorded
        words = []
        if flows.min() < low:
            words.append("low")
        if flows.max() > high:
            words.append("high")
        mean = float(flows.mean())
        return cls(f"flow_at_{speed:g}", mean, step, low, high, " and ".join(words))

    @property
    def title(self) -> str:
        """What people call it."""
        if self.name in _TITLES:
            return _TITLES[self.name][0]
        return f"equilibrium flow at {self.name.removeprefix('flow_at_')} m/s"

    @property
    def unit(self) -> str:
        """Of the value."""
        if self.name in _TITLES:
            return _TITLES[self.name][1]
        return "vehicles/h"

    @property
    def usual(self) -> str:
        """The usual values in words; "" where none are known."""
        if math.isnan(self.low):
            return ""
        if math.isinf(self.high):
            return f"at least {self._text(self.low)}"
        if self.low == 0.0:
            return f"at most {self._text(self.high)}"
        return f"{self._text(self.low)} to {self._text(self.high)}"

    @property
    def text(self) -> str:
        """The value with as many digits as mean something."""
        if math.isnan(self.value):
            return "none"
        return self._text(self.value)

    def _text(self, value: float) -> str:
        if self.unit.startswith("vehicles"):
            return f"{value:,.0f}"
        if self.name == "town_throughput":
            return f"{value:.3f}"
        return f"{value:.1f}"


@dataclass(frozen=True)
class DriverTraffic:
    """What traffic one driver makes.

    Attributes:
        equilibrium: flow at each of `SPEEDS_MPS` from each of `TIME_GAPS_S`, `(S, T)`, vehicles/h.
        ring: density and flow of each ring, vehicles/km and vehicles/h, `(R, 2)`.
        dips: how much each vehicle of the platoon slows down, the leader first, m/s, `(26,)`.
        time_gaps: quantiles (`FLEET_SHARES`) of the time gaps at which vehicles of a fleet settle
            at `FLEET_SPEEDS_MPS`, `(3, 3)`, s; NaN for a policy that knows no drivers.
        measures: the values, beside what is usual.
    """

    equilibrium: Floats
    ring: Floats
    dips: Floats
    time_gaps: Floats
    measures: tuple[Measure, ...]


class RecordedFlows(NamedTuple):
    """A recorded relation of speed and flow.

    Attributes:
        of: whose it is.
        relation: of speed and gap.
    """

    of: str
    relation: GapRelation

    def at(self, speeds: Floats) -> Floats:
        """Returns flows at speeds, vehicles/h; NaN where nothing was recorded."""
        return flow(speeds, self.relation.gap_at(speeds))

    def time_gaps(self) -> Floats:
        """Returns quantiles of drivers' time gaps as `DriverTraffic.time_gaps` has them."""
        speeds, columns = np.array(FLEET_SPEEDS_MPS), []
        for gap in (self.relation.low, self.relation.median, self.relation.high):
            gaps = np.interp(speeds, self.relation.speed, gap, left=np.nan, right=np.nan)
            columns.append(gaps / speeds)
        return np.stack(columns, -1)


def recorded_flows(reference: str | Path) -> RecordedFlows:
    """Reads recorded flows.

    Args:
        reference: `human` or `acc`, which come with cfx, or a file that `cfx data flows` wrote, of
            which the type with most drivers counts, or the one that `#TYPE` behind it names.

    Raises:
        DataError: there is no such file, or it holds no flows.
    """
    tables = json.loads(REFERENCES.read_text(encoding="utf-8"))["relations"]
    name = str(reference)
    if name in tables:
        return RecordedFlows(name, relation_from(tables[name]))
    place, _, kind = name.partition("#")
    try:
        tables = json.loads(Path(place).expanduser().read_text(encoding="utf-8"))["relations"]
        relations = {each: relation_from(table) for each, table in tables.items()}
        if not kind:
            kind = max(relations, key=lambda each: int(relations[each].drivers.sum()))
        return RecordedFlows(kind or place, relations[kind])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{reference} holds no recorded flows ({error}); write human, acc, or a file that"
            " 'cfx data flows RECORDING --output FILE' wrote, with #TYPE behind it for one of its"
            " types of drivers"
        ) from None


def driver_traffic(
    agent: Agent,
    model: DrivingModel | None = None,
    recorded: RecordedFlows | None = None,
    seed: int = 0,
) -> DriverTraffic:
    """Measures the traffic of one driver, without SUMO, at the driver's own time step.

    What a stochastic policy leaves to chance is drawn on rings and in platoons. Equilibria are
    those of its centre.

    Args:
        agent: drives every vehicle, by its network for unseen drivers.
        model: what it drives; None: the policy's own.
        recorded: flows to compare equilibria with; None: none.
        seed: of starts, and of what is drawn.
    """
    agent = agent.for_unseen_drivers().for_live_driving()
    if model is None:
        model = cast(DrivingModel, create("model", agent.model_node))
    flows = equilibrium_flows(agent, model)
    ring, gap_on_rings = _rings(agent, model, seed)
    dips, gap_in_platoon = _dips(agent, model, seed)
    sugiyama = _sugiyama(agent, model, seed)
    step, measures = agent.dt, []
    usual = np.full(len(SPEEDS_MPS), np.nan)
    if recorded is not None:
        usual = recorded.at(np.array(SPEEDS_MPS))
    for speed, of_speed, usual_flow in zip(SPEEDS_MPS, flows, usual, strict=True):
        measures.append(Measure.of_flow(speed, of_speed, float(usual_flow), step))
    differ = float(100.0 * (flows.max(1) / flows.min(1) - 1.0).max())
    measures.append(Measure.of("starts_differ", differ, step))
    measures.append(Measure.of("capacity", float(ring[:, 1].max()), step))
    measures.append(Measure.of("dip_last", float(dips[-1]), step))
    measures.append(Measure.of("ring_speed_std", sugiyama.speed_std, step))
    measures.append(Measure.of("ring_wave_speed", sugiyama.wave_speed, step))
    least = min(gap_on_rings, gap_in_platoon, sugiyama.least_gap)
    measures.append(Measure.of("least_gap", least, step))
    return DriverTraffic(flows, ring, dips, fleet_time_gaps(agent, model), tuple(measures))


def fleet_time_gaps(agent: Agent, model: DrivingModel) -> Floats:
    """Returns quantiles of the time gaps of a fleet, as `DriverTraffic.time_gaps` has them."""
    drivers = agent.trained_on.drivers
    if drivers is None:
        return np.full((len(FLEET_SPEEDS_MPS), len(FLEET_SHARES)), np.nan)
    even = (torch.arange(_FLEET_DRIVERS, dtype=torch.float64) + 0.5) / _FLEET_DRIVERS
    # By the first feature, so that no kind of driver is left out by chance.
    order = drivers.features[:, 0].argsort()
    sorted_drivers = drivers._replace(
        features=drivers.features[order], weight=drivers.weight[order]
    )
    features = sorted_drivers.drawn(even).repeat(len(FLEET_SPEEDS_MPS), 1)
    speed = torch.tensor(FLEET_SPEEDS_MPS, dtype=torch.float64).repeat_interleave(_FLEET_DRIVERS)
    start = torch.full_like(speed, float(np.mean(TIME_GAPS_S)))
    context = DriverContext(driver_features=features)
    gaps = settled_gaps(agent, model, speed, start, context)
    time_gaps = (gaps / speed).view(len(FLEET_SPEEDS_MPS), -1).numpy()
    quantiles: Floats = np.quantile(time_gaps, FLEET_SHARES, axis=1).T
    return quantiles


def equilibrium_flows(agent: Agent, model: DrivingModel) -> Floats:
    """Returns the flow of each speed of `SPEEDS_MPS` and start of `TIME_GAPS_S`, `(S, T)`."""
    speeds = torch.tensor(SPEEDS_MPS, dtype=torch.float64)
    starts = torch.tensor(TIME_GAPS_S, dtype=torch.float64)
    gaps = settled_gaps(
        agent,
        model,
        speeds.repeat_interleave(len(starts)),
        starts.repeat(len(speeds)),
    )
    settled = gaps.view(len(speeds), len(starts)).numpy()
    return flow(speeds.numpy()[:, None], settled)


def settled_gaps(
    agent: Agent,
    model: DrivingModel,
    speed: Tensor,
    time_gap: Tensor,
    context: DriverContext = UNSEEN,
) -> Tensor:
    """Returns gaps after `EQUILIBRIUM_S` behind leaders of constant speed, `(D,)`, m.

    Args:
        agent: with one network.
        model: what it drives.
        speed: of each leader, `(D,)`, m/s.
        time_gap: at which each vehicle begins, `(D,)`, s.
        context: of the D drivers.
    """
    lanes = _pairs_of(speed, speed * time_gap)
    followers = torch.arange(1, len(lanes), 2)
    state = _begin(agent, len(lanes), context, followers)
    driven = roads.simulate_roads(model, agent, state, lanes, EQUILIBRIUM_S)
    frames = max(1, round(_AVERAGED_S / driven.interval))
    position = driven.position[:, -frames:]
    return (position[0::2] - VEHICLE_M - position[1::2]).mean(-1)


def _begin(
    agent: Agent, vehicles: int, context: DriverContext = UNSEEN, driven: Tensor | None = None
) -> AgentState:
    """Returns the state of vehicles, of which some are drivers with a context.

    Args:
        agent: with one network.
        vehicles: how many.
        context: of E drivers.
        driven: which vehicles these are, `(E,)`; None: all.
    """
    if driven is not None:
        columns: list[Tensor | None] = []
        for values in context:
            if values is None:
                columns.append(None)
                continue
            # The other vehicles keep their speed, whoever drives them.
            row = torch.zeros(vehicles, dtype=torch.int64)
            row[driven] = torch.arange(len(driven))
            columns.append(values[row])
        context = DriverContext(*columns)
    return agent.begin(torch.zeros(vehicles, dtype=torch.int64), context)


def _pairs_of(speed: Tensor, gap: Tensor) -> roads.Lanes:
    """Returns a road for each of E leaders, `(E,)`, with one vehicle behind; leaders first."""
    count = len(speed)
    first = torch.arange(0, 2 * count, 2)
    position = torch.zeros(2 * count, dtype=torch.float64)
    position[1::2] = -(gap + VEHICLE_M)
    steady = torch.zeros(2 * count, dtype=torch.bool)
    steady[first] = True
    ahead = torch.arange(2 * count)
    ahead[1::2] = first
    offset = torch.where(steady, roads.FREE_M + VEHICLE_M, 0.0).double()
    all_roads = []
    for number, value in enumerate(speed.tolist()):
        vehicles = slice(2 * number, 2 * number + 2)
        all_roads.append(roads.Road("platoon", value, 0, vehicles))
    return roads.Lanes(
        roads=tuple(all_roads),
        position=position,
        speed=speed.repeat_interleave(2),
        ahead=ahead,
        offset=offset,
        steady=steady,
        entry=torch.full_like(position, torch.inf),
        has_bottleneck=torch.zeros_like(steady),
        bottleneck=roads.Bottleneck(),
        length=VEHICLE_M,
    )


def _drawing(agent: Agent, seed: int) -> torch.Generator | None:
    """Returns what a stochastic policy draws from; None for another policy."""
    if not agent.core.head.is_stochastic:
        return None
    return torch.Generator().manual_seed(seed)


def _rings(agent: Agent, model: DrivingModel, seed: int) -> tuple[Floats, float]:
    """Returns density and flow of rings, and the least gap, m, of all whose vehicles have room."""
    generator = torch.Generator().manual_seed(seed)
    lanes = roads.ring_roads(_DENSITIES, _RING_VEHICLES, 1, VEHICLE_M, _PERTURBATION, generator)
    state = _begin(agent, len(lanes))
    driven = roads.simulate_roads(model, agent, state, lanes, _RING_S, _drawing(agent, seed))
    settled = driven.speed[:, int(_SETTLED * driven.speed.shape[1]) :].mean(1)
    rows = []
    for road in lanes.roads:
        rows.append((road.level, 3.6 * road.level * float(settled[road.vehicles].mean())))
    return np.array(rows), float(driven.min_gap.min())


def _dips(agent: Agent, model: DrivingModel, seed: int) -> tuple[Floats, float]:
    """Returns how much each vehicle of a platoon slows down, m/s, and the least gap, m."""
    lanes = roads.platoons([_DIP_FROM_MPS], PLATOON + 1, 1, VEHICLE_M)
    steps = round((_DIP_BEGINS_S + _DIP_LASTS_S) / agent.dt)
    time = agent.dt * torch.arange(1, steps + 1, dtype=torch.float64) - _DIP_BEGINS_S
    change = DIP_MPS / _DIP_MPS2
    falling = (time / change).clamp(0.0, 1.0)
    rising = ((time - change - _DIP_S) / change).clamp(0.0, 1.0)
    pace = -DIP_MPS * (falling - rising)
    driven = roads.simulate_roads(
        model,
        agent,
        _begin(agent, len(lanes)),
        lanes,
        _DIP_BEGINS_S + _DIP_LASTS_S,
        _drawing(agent, seed),
        pace,
    )
    begins = round(_DIP_BEGINS_S / driven.interval)
    averaged = round(_AVERAGED_S / driven.interval)
    before = driven.speed[:, begins - averaged : begins].mean(1)
    lowest = driven.speed[:, begins:].amin(1)
    return (before - lowest).numpy(), float(driven.min_gap.min())


class _Sugiyama(NamedTuple):
    """Sugiyama's ring: deviation of speeds (m/s), speed of waves (km/h), least gap (m)."""

    speed_std: float
    wave_speed: float
    least_gap: float


def _sugiyama(agent: Agent, model: DrivingModel, seed: int) -> _Sugiyama:
    generator = torch.Generator().manual_seed(seed)
    density = 1000.0 * _SUGIYAMA / _SUGIYAMA_M
    lanes = roads.ring_roads([density], _SUGIYAMA, 1, VEHICLE_M, _PERTURBATION, generator)
    state = _begin(agent, len(lanes))
    driven = roads.simulate_roads(model, agent, state, lanes, _SUGIYAMA_S, _drawing(agent, seed))
    settled = slice(driven.speed.shape[1] // 2, None)
    position, speed = driven.position[:, settled], driven.speed[:, settled]
    waves = ring_waves(position, speed, _SUGIYAMA_M, driven.interval)
    return _Sugiyama(float(speed.std()), 3.6 * waves.speed, float(driven.min_gap.min()))


def table_of(measures: Sequence[Measure]) -> list[dict[str, object]]:
    """Returns a row for each measure, for a table."""
    rows: list[dict[str, object]] = []
    for measure in measures:
        rows.append(
            {
                "measure": measure.name,
                "meaning": measure.title,
                "unit": measure.unit,
                "step_s": measure.step,
                "value": measure.value,
                "usual_low": measure.low,
                "usual_high": measure.high,
                "outside": measure.word,
            }
        )
    return rows
