"""The driving models are SUMO's, wherever SUMO draws no random number: one step and whole drives
agree to 1e-9 m/s.

`pytest plugins/cfx-sumo/tests/test_sumo_parity.py -s` prints the largest difference of each model and case.
"""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfx.models.base import DrivingModel, Follower, Leader, bumper_gap
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.vtype import InSumo, VType
from cfx.models.w99 import W99
from cfx.simulation.rollout import simulate_follower
from cfx.simulation.trajectory import Start, Trajectory
from cfx_sumo.idm import IdmSumo
from cfx_sumo.krauss import KraussSumo
from tests.forks import Forks

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)

DT = 0.1
TOLERANCE = 1e-9  # m/s
Array = NDArray[np.float64]
Values = dict[str, float]

LARGEST: dict[str, dict[str, float]] = {}
"""Largest difference in m/s that was met, by model and case."""


@pytest.fixture(scope="module", autouse=True)
def table() -> Iterator[None]:
    yield
    cases = list(dict.fromkeys(case for row in LARGEST.values() for case in row))
    print(
        f"\n\nLargest difference to SUMO, m/s\n{'':32}" + "".join(f"{case:>18}" for case in cases)
    )
    for model, row in LARGEST.items():
        print(
            f"{model:32}"
            + "".join(f"{row[case]:18.1e}" if case in row else f"{'':18}" for case in cases)
        )


_processes: list[Forks] = []
"""What starts processes with SUMO in them."""


@pytest.fixture(scope="module", autouse=True)
def _with_sumo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with Forks("import libsumo", tmp_path_factory.mktemp("sumo")) as forks:
        _processes[:] = [forks]
        yield
        _processes.clear()


@dataclass(frozen=True)
class Drive:
    """One follower behind one leader, whose positions are Euler sums of its speeds, as in SUMO."""

    leader_speed: Array
    leader_acceleration: float
    leader_length: float
    gap: float
    speed: float
    acceleration: float
    parameters: Values


@dataclass(frozen=True)
class Twin:
    """A model of ours and SUMO's.

    Attributes:
        name: in the table.
        model: ours.
        draw: parameters for a number of drives.
        draws: SUMO's draws random numbers.
        same: states, of one step, in which the two are the same model; all of them by default.
        vtype: SUMO's, where the model does not say itself.
    """

    name: str
    model: DrivingModel
    draw: Callable[[np.random.Generator, int], list[Values]]
    draws: bool = False
    same: Callable[[Follower, Leader, Mapping[str, Tensor]], Tensor] = lambda follower, *_: (
        follower.speed >= 0
    )
    vtype: Callable[[Mapping[str, Tensor]], VType] | None = None

    def in_sumo(self, p: Values) -> VType:
        values = {name: torch.tensor(value, dtype=torch.float64) for name, value in p.items()}
        if self.vtype is not None:
            return self.vtype(values)
        assert isinstance(self.model, InSumo)
        return self.model.sumo_vtype(values)


def anywhere(
    model: DrivingModel, **constants: float
) -> Callable[[np.random.Generator, int], list[Values]]:
    """Draws every parameter within its bounds; the first set is the defaults."""

    def draw(rng: np.random.Generator, count: int) -> list[Values]:
        rows = [{p.name: p.default for p in model.space} | constants]
        return rows + [
            {p.name: float(rng.uniform(p.low, p.high)) for p in model.space} | constants
            for _ in range(count - 1)
        ]

    return draw


def krauss_parameters(rng: np.random.Generator, count: int) -> list[Values]:
    rows = [
        {"t_r": 1.0, "t_i": 0.0, "a": 2.6, "b": 4.5, "v_max": 55.0, "min_gap": gap, "b_max": 9.0}
        for gap in (0.0, 2.5)
    ]
    while len(rows) < count:
        b = float(rng.uniform(1.5, 7))
        own = {
            "t_r": float(rng.uniform(0.3, 4)),
            "a": float(rng.uniform(0.5, 5)),
            "v_max": float(rng.uniform(10, 55)),
        }
        own["min_gap"] = float(rng.choice([0.0, 2.5, rng.uniform(0, 5)]))
        rows.append({**own, "t_i": 0.0, "b": b, "b_max": b + float(rng.uniform(0, 6))})
    return rows


def krauss_radicand(follower: Follower, leader: Leader, p: Mapping[str, Tensor]) -> Tensor:
    """Where it is negative, KraussOrig1 has no number and SUMO ignores the leader."""
    gap, v_l = bumper_gap(follower, leader) - p["min_gap"], leader.speed
    return (p["b"] * p["t_r"]).square() + v_l.square() + 2 * p["b"] * gap >= 0


def sumos_krauss(rng: np.random.Generator, count: int) -> list[Values]:
    rows = anywhere(KraussSumo())(rng, count)
    return [row | {"emergencyDecel": max(row["emergencyDecel"], row["decel"])} for row in rows]


def published_idm() -> Twin:
    """Returns `idm`: no brake cap (lifted in SUMO here), and other gaps below 0.1 m."""
    names = {
        "v0": "maxSpeed",
        "T": "tau",
        "s0": "minGap",
        "a": "accel",
        "b": "decel",
        "delta": "delta",
    }

    def vtype(p: Mapping[str, Tensor]) -> VType:
        return VType(
            "IDM",
            {names[ours]: value for ours, value in p.items()}
            | {"emergencyDecel": torch.tensor(1e9)},
        )

    def same(follower: Follower, leader: Leader, p: Mapping[str, Tensor]) -> Tensor:
        return bumper_gap(follower, leader) >= 0.1

    return Twin("idm / IDM", IDM(limits=None), anywhere(IDM()), same=same, vtype=vtype)


KRAUSS = Krauss(limits=None, variant="sumo", parameters={"t_i": {"default": 0.0, "tuned": False}})
TWINS = [
    Twin("krauss, t_i = 0 / KraussOrig1", KRAUSS, krauss_parameters, same=krauss_radicand),
    Twin("krauss_sumo / Krauss", KraussSumo(limits=None), sumos_krauss),
    Twin("idm_sumo / IDM", IdmSumo(limits=None), anywhere(IdmSumo())),
    Twin("w99 / W99", W99(limits=None), anywhere(W99(), b=4.5, b_max=9.0, v_max=55.0), draws=True),
    published_idm(),
]
every_twin = pytest.mark.parametrize("twin", TWINS, ids=[twin.name for twin in TWINS])


def sumo(twin: Twin, drives: list[Drive]) -> list[dict[str, list[float]]]:
    """Returns SUMO's own trajectories, from a process and files of its own."""
    runs = []
    for drive in drives:
        kind = twin.in_sumo(drive.parameters)
        runs.append(
            {
                "model": kind.car_follow_model,
                "parameters": {name: float(value) for name, value in kind.attributes.items()},
                "leader": {name: float(value) for name, value in kind.leader.items()},
                "leader_speed": drive.leader_speed.tolist(),
                "leader_position": 200.0,
                "leader_acceleration": drive.leader_acceleration,
                "leader_length": drive.leader_length,
                "position": 200.0 - drive.leader_length - drive.gap,
                "speed": drive.speed,
                "acceleration": drive.acceleration,
            }
        )
    script = Path(__file__).with_name("sumo_reference.py")
    done = _processes[0].run([str(script)], Path.cwd(), json.dumps({"dt": DT, "runs": runs}))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["runs"]  # type: ignore[no-any-return]  # our own script's answer


def column(values: Iterable[float]) -> Tensor:
    return torch.tensor(list(values), dtype=torch.float64)


def ours(
    model: DrivingModel, cases: list[Drive], reference: list[dict[str, list[float]]]
) -> tuple[Trajectory, Leader]:
    """Simulates our model behind SUMO's leaders, at the very same positions, `(runs, time)`."""
    frames = max(len(drive.leader_speed) for drive in cases)

    def longest(rows: Iterable[Iterable[float]]) -> Tensor:
        return torch.tensor(
            [[*row, *[math.nan] * frames][:frames] for row in rows], dtype=torch.float64
        )

    speed = longest(drive.leader_speed for drive in cases)
    first = column(drive.leader_acceleration for drive in cases)[:, None]
    leader = Leader(
        longest(run["leader_position"] for run in reference),
        speed,
        torch.cat([first, speed.diff(dim=1) / DT], dim=1),
        column(drive.leader_length for drive in cases),
    )
    start = Start(
        column(run["position"][0] for run in reference),
        column(drive.speed for drive in cases),
        column(d.acceleration for d in cases),
    )
    with torch.no_grad():
        values = parameters(cases)
        return simulate_follower(model, values, leader, start, DT, outside="allow"), leader


def parameters(cases: list[Drive]) -> dict[str, Tensor]:
    return {name: column(drive.parameters[name] for drive in cases) for name in cases[0].parameters}


def undrawn(drive: Trajectory, leader: Leader) -> Tensor:
    """Returns the frames up to which W99 in SUMO draws no random number that matters.

    It does while closing in on a leader with a_l >= 1 m/s2.
    """
    draws = (drive.speed > leader.speed) & (leader.acceleration >= 1.0 - 1e-9)
    return (draws.cumsum(dim=1) - draws.long()) == 0


def chaotic(
    model: DrivingModel,
    cases: list[Drive],
    reference: list[dict[str, list[float]]],
    mine: Trajectory,
) -> Tensor:
    """Returns the frames from which on a thousandth of a nanometre, and so rounding, matters."""
    rng = np.random.default_rng(0)
    places = (
        [x + 1e-12 * float(rng.uniform(-1, 1)) for x in run["leader_position"]] for run in reference
    )
    other, _ = ours(
        model,
        cases,
        [run | {"leader_position": moved} for run, moved in zip(reference, places, strict=True)],
    )
    return ((other.speed - mine.speed).abs() > 0.1 * TOLERANCE).cumsum(dim=1) > 0


def same_so_far(twin: Twin, cases: list[Drive], drive: Trajectory, leader: Leader) -> Tensor:
    """Frames whose steps so far were all taken in states in which the two are the same model."""
    p = {name: value[:, None] for name, value in parameters(cases).items()}
    whole = leader._replace(length=leader.length[:, None])
    follower = Follower(drive.position, drive.speed, drive.speed, drive.speed[..., None])
    left = ~twin.same(follower, whole, p)
    return (left.cumsum(dim=1) - left.long()) == 0


def compare(twin: Twin, case: str, cases: list[Drive]) -> float:
    """Compares free rollouts; returns the share of frames that could be compared."""
    reference = sumo(twin, cases)
    mine, leader = ours(twin.model, cases, reference)
    there = leader.position.isfinite()
    # SUMO's vehicles lose a leader whom they have overtaken.
    counted = there & (mine.collided.cumsum(dim=1) == 0) & same_so_far(twin, cases, mine, leader)
    counted &= ~chaotic(twin.model, cases, reference, mine)
    if twin.draws:
        counted &= undrawn(mine, leader)
    for drive, own, run, valid in zip(cases, mine.speed, reference, counted, strict=True):
        theirs = torch.tensor(run["speed"], dtype=torch.float64)
        rounded = (theirs == 0) & (
            own[: len(theirs)] > 0
        )  # SUMO's 1e-5 m/s, which not everybody knows
        difference = (own[: len(theirs)] - theirs).abs()
        difference = difference[valid[: len(theirs)] & (rounded.cumsum(dim=0) == 0)]
        first = int((difference > TOLERANCE).long().argmax())
        assert difference.max() < TOLERANCE, (
            f"{drive.parameters} differs from SUMO at frame {first} of {len(difference)}"
        )
        note(twin.name, case, difference.max().item())
    return (counted.sum() / there.sum()).item()


def note(model: str, case: str, difference: float) -> None:
    row = LARGEST.setdefault(model, {})
    row[case] = max(row.get(case, 0.0), difference)


def synthetic(rng: np.random.Generator, count: int, gentle: float) -> Iterable[Array]:
    """Leaders that cruise, brake to a standstill, wait and drive off, as gently as `gentle`."""
    for _ in range(count):
        frames, speed = 500, float(rng.uniform(2, 25))
        v = [speed]
        target, rate = speed, 1.0
        while len(v) < frames:
            if rng.random() < 0.02:
                target = float(rng.choice([0.0, rng.uniform(0, 25)]))
                rate = float(rng.uniform(0.3, 4.0))
            step = np.clip(target - v[-1], -rate * DT, min(rate, gentle) * DT)
            v.append(max(0.0, v[-1] + float(step)))
        yield np.array(v)


def drives(
    leaders: Iterable[Array], rows: Iterable[Values], rng: np.random.Generator
) -> list[Drive]:
    made = []
    for speed, p in zip(leaders, rows, strict=True):
        fastest = next((p[name] for name in ("v_max", "maxSpeed", "v0") if name in p), 99.0)
        v = min(max(0.0, speed[0] + float(rng.uniform(-2, 2))), fastest)
        gap = float(rng.uniform(5, 20) + 1.5 * v)
        made.append(
            Drive(
                speed,
                float(rng.uniform(-0.9, 0.9)),
                float(rng.uniform(3.5, 12)),
                gap,
                v,
                float(rng.uniform(-1, 1)),
                p,
            )
        )
    return made


@pytest.fixture(scope="module")
def real_leaders(shared_data: Path) -> list[Array]:
    """The speeds of 20 recorded leaders, by position so that a replay is exact."""
    table = pd.read_parquet(
        shared_data / "i80_reconstructed_pairs.parquet", columns=["pair_id", "leader_position_m"]
    )
    groups = list(table.groupby("pair_id")["leader_position_m"])[::10][:20]
    speeds = [np.clip(np.diff(position.to_numpy()) / DT, 0, None) for _, position in groups]
    return [speed[:500] for speed in speeds]


@every_twin
def test_free_drives_behind_real_leaders(twin: Twin, real_leaders: list[Array]) -> None:
    rng = np.random.default_rng(1)
    assert len(real_leaders) >= 10
    cases = drives(real_leaders, twin.draw(rng, len(real_leaders)), rng)
    assert compare(twin, "real leaders", cases) > 0.5


@every_twin
def test_free_drives_behind_leaders_that_stop_and_go(twin: Twin) -> None:
    # Where SUMO draws numbers, leaders that accelerate by less than 1 m/s2: then none matters, and
    # whole drives are compared.
    rng = np.random.default_rng(2)
    leaders = synthetic(rng, 30, gentle=0.95 if twin.draws else 3.0)
    assert compare(twin, "stop and go", drives(leaders, twin.draw(rng, 30), rng)) > 0.7


@every_twin
def test_single_steps_from_random_states(twin: Twin) -> None:
    # States that a drive seldom visits: nearly touching, overlapping, standing, and every case of
    # the rules.
    rng = np.random.default_rng(5)
    cases = []
    for p in twin.draw(rng, 800):
        v_l = float(rng.choice([0.0, rng.uniform(0, 2), rng.uniform(0, 20)]))
        v = float(rng.choice([0.0, rng.uniform(0, 2), max(0.0, v_l + 2 * rng.normal())]))
        fastest = next((p[name] for name in ("v_max", "maxSpeed", "v0") if name in p), 99.0)
        gap = float(rng.choice([rng.uniform(-0.5, 3), rng.uniform(0, 1), rng.uniform(0, 60)]))
        steady = max(0.0, v_l + float(rng.uniform(-0.3, 0.09)))
        state = (5.0, gap, min(v, fastest), float(rng.uniform(-2, 2)))
        cases.append(Drive(np.array([v_l, steady]), float(rng.uniform(-4, 0.9)), *state, p))
    assert one_step(twin, cases) > 0.35


def one_step(twin: Twin, cases: list[Drive]) -> float:
    """Compares single steps; returns the share of states in which the two are the same model."""
    reference = sumo(twin, cases)
    mine, leader = ours(twin.model, cases, reference)
    theirs = column(run["speed"][1] for run in reference)
    same = same_so_far(twin, cases, mine, leader)[:, 1] & ~(
        (theirs == 0) & (mine.speed[:, 1] < 1e-5)
    )
    difference = (mine.speed[:, 1] - theirs).abs()[same]
    worst = int(((mine.speed[:, 1] - theirs).abs() * same).argmax())
    assert difference.max() < TOLERANCE, (
        f"{cases[worst]} differs: {mine.speed[worst, 1].item()} and {theirs[worst].item()}"
    )
    note(twin.name, "one step", difference.max().item())
    return same.double().mean().item()


def sumos_wiedemann(p: Mapping[str, Tensor]) -> VType:
    """SUMO's Wiedemann makes Wiedemann's parameters from two: security and estimation."""
    security = 0.5 * (p["ax_add"] - 1.0)
    estimation = p["cx"] / 25.0 - 1.0 - security
    accel = 5.0 * p["b_null"]
    own = {
        "security": security,
        "estimation": estimation,
        "accel": accel,
        "minGap": torch.tensor(0.0),
    }
    # While approaching SUMO brakes by at most the mean of the two.
    return VType("Wiedemann", own | {"decel": -p["b_min"], "emergencyDecel": -p["b_min"]})


def wiedemanns_case(follower: Follower, leader: Leader, p: Mapping[str, Tensor]) -> Tensor:
    """Says in which states `w74` and SUMO's Wiedemann decide alike: unconscious following while not
    opening, and approaching.

    Not alike are free driving (another rule), emergencies (SUMO brakes as hard as it can), and
    opening gaps (a random threshold).
    """
    v, v_l = follower.speed, leader.speed
    spacing, closing = leader.position - follower.position, v - v_l
    ax = leader.length + p["ax_add"]
    abx = ax + p["bx_add"] * v_l.sqrt()
    perceived = ((spacing - ax) / p["cx"]).square()
    patience = 2.0 - (p["cx"] / 25.0 - 1.0 - 0.5 * (p["ax_add"] - 1.0))  # Wiedemann's EX
    within = spacing < p["sdx_mult"] * abx
    following = within & (closing >= 0) & (closing <= perceived)
    approaching = (spacing < 150.0) & (
        closing > torch.where(within, perceived * patience.square(), perceived)
    )
    return (spacing > abx) & (v >= v_l) & (following | approaching)


def test_w74_takes_the_steps_of_sumos_wiedemann_where_both_follow_or_approach() -> None:
    w74 = pytest.importorskip("cfx_community.models.w74", reason="the model is cfx-community's")
    rng = np.random.default_rng(6)
    cases = []
    for _ in range(800):
        security, estimation = rng.uniform(0.05, 1, 2).tolist()
        v_l = float(rng.uniform(1, 20))
        v = v_l + float(rng.choice([rng.uniform(0, 0.3), rng.uniform(0, 6)]))
        ax, patience = 1.0 + 2.0 * security, 2.0 - estimation
        bx = (1.0 + 7.0 * security) * math.sqrt(
            v
        )  # SUMO takes the follower's speed, w74 the slower one's
        abx = 5.0 + ax + bx
        sdx = 5.0 + ax + patience * bx  # in w74 a multiple of ABX
        p = {
            "ax_add": ax,
            "bx_add": bx / math.sqrt(v_l),
            "sdx_mult": sdx / abx,
            "cx": 25.0 * (1 + security + estimation),
        }
        p |= {
            "opdv_add": 1.5,
            "b_max": 2.6,
            "v_desired": 50.0,
            "b_null": float(rng.uniform(0.1, 1)),
            "b_min": -9.0,
        }
        gap = abx - 5.0 + float(rng.choice([rng.uniform(0.5, 5), rng.uniform(0, 60)]))
        cases.append(Drive(np.array([v_l, v_l]), 0.0, 5.0, gap, v, 0.5, p))
    twin = Twin(
        "w74 / Wiedemann, two cases",
        w74.W74(limits=None),
        lambda *_: [],
        same=wiedemanns_case,
        vtype=sumos_wiedemann,
    )
    assert one_step(twin, cases) > 0.5
