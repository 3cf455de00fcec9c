from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import cfx_sumo
from cfx.data.pairs import PairBatch
from cfx.data.style import StyleResult, StyleSettings, measure_style
from cfx.errors import DataError, ParameterError, SumoError
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.evaluation.evaluate import ComparedPairs, evaluate
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.constant import ConstantNetwork, DefaultPolicy, FixedPolicy
from cfx.policies.context import ContextRule
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler
from cfx.policies.heads.base import DirectHead
from cfx.policies.heads.offset import shrunk
from cfx.policies.population import DriverPopulation
from cfx.policies.row_choice import DriverRows, RowChoice
from cfx.policies.valid_range import ValidRange
from cfx.simulation.rollout import MemoryStepper
from cfx_sumo.demo.motorway import read_motorway
from cfx_sumo.demo.simulated import FinishedJob, PolicyKnowledge, simulate_in_sumo
from cfx_sumo.live.braking import needed_deceleration
from cfx_sumo.live.draws import standard_normal
from cfx_sumo.live.driver import Driver
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.live.surroundings import Seen
from tests.agents import adaptive
from tests.drives import wavy_pairs
from tests.road import Car, Road, platoon

pytest.importorskip("traci", reason="needs the extra sumo")


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Returns a list that grows by the number of drivers at each call of the policy."""
    calls: list[int] = []
    original = RowChoice.act

    def act(self: RowChoice, drivers: DriverRows, rows: Tensor, noise: Any = None) -> None:
        calls.append(len(rows))
        original(self, drivers, rows, noise)

    monkeypatch.setattr(RowChoice, "act", act)
    return calls


def test_all_vehicles_are_one_call_of_the_policy_and_windows_are_each_vehicles_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    road = platoon(300)
    late = [f"v{i}" for i in range(200, 300)]
    driver = Driver(adaptive({"name": "w99"}))
    calls = counted(monkeypatch)
    for k in range(11):
        driver.step(
            road, [name for name in road.cars if name != "lead" and (k >= 2 or name not in late)]
        )
        road.advance()
    assert calls == [200, 100, 200, 100, 200], "at steps 0, 2, 5, 7, 10"
    assert all(
        len(road.cars[name].told) == (9 if name in late else 11)
        for name in road.cars
        if name != "lead"
    )


def test_many_at_once_drive_as_one_by_one() -> None:
    together, alone = platoon(7), platoon(7)
    for road, groups in (
        (together, [[f"v{i}" for i in range(7)]]),
        (alone, [f"v{i}" for i in range(7)]),
    ):
        driver = Driver(adaptive({"name": "krauss"}))
        for _ in range(12):
            for group in groups:
                driver.step(road, group)
            road.advance()
    for name in together.cars:
        assert together.cars[name].told == pytest.approx(alone.cars[name].told, abs=1e-12)


def test_a_vehicle_that_leaves_is_forgotten_and_its_place_is_used_again() -> None:
    road = platoon(20)
    driver = Driver(adaptive({"name": "krauss"}))
    driver.step(road, [name for name in road.cars if name != "lead"])
    for k in range(50):
        road.advance()
        del road.cars[f"v{k}"]
        road.cars[f"v{k + 20}"] = Car(leader="lead")
        driver.step(road, [name for name in road.cars if name != "lead"])
        assert set(driver.vehicles) == set(road.cars) - {"lead"}
    assert len(driver._vehicles.table.time) <= 64
    assert driver.parameters("v3") == {}


def test_without_a_leader_the_policys_own_model_drives_and_a_new_leader_begins_anew() -> None:
    road = platoon(1)
    car = road.cars["v0"]
    driver = Driver(adaptive({"name": "krauss"}), look_ahead=100, speed_mode=0)
    driver.step(road, "v0")
    assert driver.follows("v0")
    before = driver.parameters("v0")
    road.advance()
    car.gap = 101.0
    driver.step(road, "v0")
    assert driver.drives("v0")
    assert not driver.follows("v0")
    assert car.told[-1] == pytest.approx(8.0 + 0.26), "as fast as it may"
    assert driver.parameters("v0") == pytest.approx(
        dict(zip(Krauss().space.names, Krauss().space.defaults().tolist(), strict=True))
    )
    car.leader, car.speed, car.allowed = None, 13.8, 13.9
    road.advance()
    driver.step(road, "v0")
    assert car.told[-1] == 13.9, "to the lane's limit"
    assert driver.counts.free == 2
    assert driver.counts.steps == 1
    car.leader, car.gap, car.speed, car.allowed = "lead", 15.0, 8.0, 60.0
    road.advance()
    driver.step(road, "v0")
    assert driver.parameters("v0") == pytest.approx(before), "as at the very first"
    assert car.mode == 0
    driver.release(road, "v0")
    assert car.told[-1] == -1
    assert car.mode == 31


def test_a_free_road_is_driven_with_the_base_that_a_vehicle_has() -> None:
    policy = adaptive({"name": "idm"}, offsets=True)
    driver = Driver(policy)
    base = dict(zip(policy.space.names, policy.space.defaults().tolist(), strict=True))
    driver.assign("v1", base=base | {"v0": 20.0})
    road = Road(v0=Car(), v1=Car())
    driver.step(road, ["v0", "v1"])
    assert driver.parameters("v1")["v0"] == pytest.approx(20.0)
    assert driver.parameters("v0") != driver.parameters("v1")
    assert road.cars["v0"].told != road.cars["v1"].told
    constant = Driver.constant(Krauss(), {"t_r": 2.0})
    constant.step(road, "v0")
    assert constant.parameters("v0")["t_r"] == pytest.approx(2.0)


def test_nothing_jumps_where_a_leader_comes_within_sight() -> None:
    """The acceleration with a residual head just within the look-ahead and just beyond."""
    policy = adaptive({"name": "idm"}, residual=True)
    accelerations = []
    for gap in (199.0, 201.0):
        road = Road(
            lead=Car(speed=14.0), v0=Car(speed=14.0, acceleration=0.7, gap=gap, leader="lead")
        )
        Driver(policy).step(road, "v0")
        accelerations.append((road.cars["v0"].told[0] - 14.0) / 0.1)
    assert accelerations[0] == pytest.approx(accelerations[1], abs=0.2)


def test_a_leader_that_traci_makes_up_is_none() -> None:
    road = platoon(1)
    driver = Driver(adaptive({"name": "krauss"}), look_ahead=100, speed_mode=0)
    road.cars["v0"].gap = -1.8e308
    driver.step(road, "v0")
    assert not driver.follows("v0")
    road.advance()
    road.cars["v0"].gap = 20.0
    driver.step(road, "v0")
    assert driver.follows("v0")


@pytest.mark.parametrize("look_ahead", [-5.0, 0.0, float("nan")])
def test_a_distance_that_is_none_is_refused(look_ahead: float) -> None:
    with pytest.raises(DataError, match="give a distance above 0 m"):
        Driver(adaptive({"name": "krauss"}), look_ahead=look_ahead)


def test_a_change_of_leader_begins_nothing_and_a_missed_step_begins_anew() -> None:
    road = platoon(1)
    road.cars["other"] = Car(speed=3.0)
    driver = Driver(adaptive({"name": "krauss"}))
    first = None
    for k in range(6):
        driver.step(road, ["v0"])
        first = first or driver.parameters("v0")
        road.advance()
        road.cars["v0"].leader = "other" if k >= 2 else "lead"
    assert driver.parameters("v0") != first, "the second window saw the slow leader"
    road.cars["v0"].leader = "lead"
    road.advance()
    driver.step(road, ["v0"])
    assert driver.parameters("v0") == pytest.approx(first)


def test_a_vehicle_that_takes_the_id_of_one_that_has_gone_begins_anew() -> None:
    road = platoon(1)
    fleet = Fleet(
        {"calm": Driver(adaptive({"name": "krauss"})), "hasty": Driver(adaptive({"name": "w99"}))}
    )
    fleet.step(road)
    first = fleet.driver("v0").parameters("v0")
    road.advance()
    road.cars["lead"].speed = 3.0
    fleet.step(road)
    road.advance()
    road.cars["lead"] = Car()
    road.cars["v0"] = Car(speed=8.0, gap=15.0, leader="lead", mode=7)
    road.departed = ["v0"]
    fleet.step(road)
    fleet.step(road)  # once an instant
    assert fleet.driver("v0").parameters("v0") == pytest.approx(first), "the slow leader is not its"
    fleet.driver("v0").release(road, "v0")
    assert road.cars["v0"].mode == 7
    road.advance()
    road.cars["v0"] = Car(speed=8.0, gap=15.0, leader="lead", kind="hasty")
    fleet.step(road)
    assert fleet.vehicles["v0"] == "hasty"


def test_stepping_twice_at_one_instant_is_stepping_once() -> None:
    road = platoon(3)
    driver = Driver(adaptive({"name": "w99"}))
    for _ in range(6):
        for vehicles in (["v0", "v1"], "v1", ["v0", "v1", "v2"]):
            driver.step(road, vehicles)
        road.advance()
    once = platoon(3)
    other = Driver(adaptive({"name": "w99"}))
    for _ in range(6):
        other.step(once, ["v0", "v1", "v2"])
        once.advance()
    assert [road.cars[v].told for v in ("v0", "v1", "v2")] == [
        once.cars[v].told for v in ("v0", "v1", "v2")
    ]


def test_the_speed_limit_holds_as_around_sumos_own_models() -> None:
    road = Road(
        lead=Car(speed=30),
        v0=Car(speed=20, gap=90, leader="lead", allowed=20.1),
        v1=Car(speed=20, gap=90, leader="lead"),
    )
    road.cars["v2"] = Car(speed=20, gap=90, leader="lead", allowed=10)
    Driver(adaptive({"name": "krauss"})).step(road, ["v0", "v1", "v2"])
    told = [road.cars[name].told[0] for name in ("v0", "v1", "v2")]
    assert told == pytest.approx([20.1, 20.26, 20 - 0.45]), (
        "the limit; the model; not harder than decel for a limit"
    )


def test_a_constant_driver_takes_parameters_by_name() -> None:
    road = platoon(1)
    driver = Driver.constant(W99(), {"cc1": 2.0})
    driver.step(road, "v0")
    assert driver.parameters("v0")["cc1"] == pytest.approx(2.0)
    assert driver.parameters("v0")["cc2"] == pytest.approx(8.0)
    with pytest.raises(ParameterError, match="'cc11' is no tuned parameter"):
        Driver.constant(W99(), {"cc11": 2.0})
    with pytest.raises(ParameterError, match="base: give a value for each of t_r, t_i"):
        Driver(adaptive({"name": "krauss"}, offsets=True)).assign("v0", base={"t_r": 1.0})


def test_driver_features_are_given_by_name() -> None:
    found = []
    for driver_features in (None, {"time_gap": 0.5, "acceleration": -1.0}):
        driver = Driver(adaptive({"name": "krauss"}, driver_features=("acceleration", "time_gap")))
        driver.assign("v0", driver_features=driver_features)
        driver.step(platoon(1), "v0")
        found.append(driver.parameters("v0")["t_r"])
    assert found[0] != pytest.approx(found[1], rel=1e-3)
    with pytest.raises(
        ParameterError,
        match="driver_features: give a value for each of acceleration, time_gap, and nothing else",
    ):
        driver.assign("v0", driver_features={"time_gap": 0.5})
    with pytest.raises(
        ParameterError,
        match="driver_features: this policy was trained to read none",
    ):
        Driver(adaptive({"name": "krauss"})).assign("v0", driver_features={"time_gap": 0.5})


def test_a_drivers_own_parameters_are_shrunk_towards_the_default_as_in_training() -> None:
    plain = adaptive({"name": "krauss"}, offsets=True)
    own, found = torch.tensor([[4.0, 1.0]], dtype=torch.float64), []
    middle = shrunk(plain.space, own, 0.5)[0].tolist()
    for policy, values in (
        (replace(plain, context_rule=ContextRule(shrinkage=0.5)), own[0].tolist()),
        (plain, middle),
        (plain, own[0].tolist()),
    ):
        driver = Driver(policy)
        driver.assign("v0", base=dict(zip(plain.space.names, values, strict=True)))
        driver.step(platoon(1), "v0")
        found.append(driver.parameters("v0")["t_r"])
    assert found[0] == pytest.approx(found[1], rel=1e-9)
    assert found[0] != pytest.approx(found[2], rel=1e-3)


def test_what_cannot_be_driven_is_one_sentence(tmp_path: Path) -> None:
    policy = adaptive({"name": "krauss"})
    driver = Driver(policy, source="outputs/job")
    with pytest.raises(
        SumoError,
        match=r"steps by 2 s; the policy of outputs/job drives in steps of 0.01 to 1 s, and best in"
        " the 0.1 s that it was trained at: start SUMO with --step-length 0.1",
    ):
        driver.step(Road(dt=2.0), [])
    ballistic = platoon(1)
    ballistic.options["step-method.ballistic"] = "true"
    with pytest.raises(SumoError, match=r"start SUMO without --step-method\.ballistic"):
        Driver(policy).step(ballistic, "v0")
    with pytest.raises(
        SumoError, match=r"vehicle 'v0' acts every 1 s \(actionStepLength\) in steps of 0.1 s"
    ):
        Driver(policy).step(platoon(1, acts_every=1.0), "v0")
    with pytest.raises(
        SumoError, match=r"vehicle 'gone' cannot be driven \(Vehicle 'gone' is not known"
    ):
        driver.step(platoon(1), ["gone"])
    with pytest.raises(
        DataError, match=r"no network of this policy was assigned to vehicle 'v0'; call assign"
    ):
        Driver(policy, network=None).step(platoon(1), "v0")
    node = {
        "name": "sumo_vtype",
        "car_follow_model": "EIDM",
        "parameters": {"tau": {"low": 0.5, "high": 3, "default": 1}},
    }
    plain = adaptive(node)
    with pytest.raises(DataError, match="SUMO alone drives"):
        Driver(plain)
    checkpoint.save_agent(adaptive({"name": "krauss"}, ("p1", "p2")), tmp_path / "policy")
    with pytest.raises(
        DataError,
        match=r"has 2 networks, each for one driver \(p1, \.\.\.\), and none for unseen drivers",
    ):
        Driver.load(tmp_path)
    with pytest.raises(DataError, match=r"has no network 'p3'; it has p1, p2"):
        Driver.load(tmp_path, network="p3")
    with pytest.raises(DataError, match=r"was trained for model=krauss, not for model=w99"):
        Driver.load(tmp_path, network="p1", model="w99")
    description = json.loads((tmp_path / "policy" / "policy.json").read_text())
    (tmp_path / "policy" / "policy.json").write_text(
        json.dumps(description | {"parameters": ["t_r", "other"]})
    )
    with pytest.raises(
        DataError, match=r"with the parameters t_r, other, but model=krauss here has t_r, t_i"
    ):
        Driver.load(tmp_path, network="p1")
    (tmp_path / "policy" / "policy.safetensors").unlink()
    with pytest.raises(DataError, match="holds no policy"):
        Driver.load(tmp_path, network="p1")


def seen(**values: float) -> Seen:
    """Returns one vehicle at 20 m/s, 30 m behind a leader as fast as itself, or as said."""
    usual = {
        "speed": 20.0,
        "acceleration": 0.0,
        "gap": 30.0,
        "leader_speed": 20.0,
        "leader_acceleration": 0.0,
        "allowed": 60.0,
        "min_gap": 0.0,
    }
    columns = {}
    for name, value in (usual | values).items():
        columns[name] = torch.tensor([value], dtype=torch.float64)
    return Seen(**columns)


def test_the_needed_deceleration_just_avoids_the_leader() -> None:
    assert float(needed_deceleration(seen())) == 0.0
    # A leader 6 m/s slower: the gap is used up as the speeds meet.
    slower = seen(leader_speed=14.0)
    assert float(needed_deceleration(slower)) == pytest.approx(36.0 / 60.0)
    # A leader who brakes at 9 m/s2 to a standstill 22.2 m farther on.
    braking = seen(leader_acceleration=-9.0)
    needed = float(needed_deceleration(braking))
    assert 400.0 / (2.0 * needed) == pytest.approx(30.0 + 400.0 / 18.0)
    assert float(needed_deceleration(seen(gap=-1.0, speed=10.0, leader_speed=0.0))) == 250.0
    # minGap stays as the speeds meet.
    kept = seen(leader_speed=14.0, gap=12.0, min_gap=2.5)
    assert float(needed_deceleration(kept)) == pytest.approx(36.0 / 19.0)


def test_a_live_vehicle_brakes_comfortably_unless_it_must_brake_harder() -> None:
    """The policy's Krauss wants to stop at once in a gap that is gone."""
    node = {"name": "krauss"}
    for gap, leader_speed, hardest in ((8.0, 10.0, 4.5), (10.5, 2.0, 6.0), (3.0, 0.0, 9.0)):
        road = Road(lead=Car(speed=leader_speed), v=Car(speed=10.0, gap=gap, leader="lead"))
        driver = Driver(adaptive(node), speed_mode=31)
        driver.step(road, "v")
        told = road.cars["v"].told[-1]
        assert told == pytest.approx(10.0 - 0.1 * hardest)
        assert road.cars["v"].decel == pytest.approx(max(4.5, hardest))
    road.cars["v"].gap, road.cars["v"].speed = 80.0, 0.0
    road.advance()
    driver.step(road, "v")
    assert road.cars["v"].decel == 4.5, "SUMO's own bound is restored"
    assert road.cars["v"].kind == "calm", "and its vType"
    exact = Driver(adaptive(node), speed_mode=0)
    road = Road(lead=Car(speed=10.0), v=Car(speed=10.0, gap=1.0, leader="lead"))
    exact.step(road, "v")
    assert road.cars["v"].told[-1] == pytest.approx(10.0 - 0.1 * 9.0), "the guard holds always"


def test_a_vehicle_that_leaves_its_driver_has_its_own_bound_again() -> None:
    road = Road(lead=Car(speed=0.0), v=Car(speed=10.0, gap=3.0, leader="lead"))
    driver = Driver(adaptive({"name": "krauss"}), speed_mode=31)
    driver.step(road, "v")
    assert road.cars["v"].decel > 4.5
    driver.release(road, "v")
    assert road.cars["v"].decel == 4.5
    assert road.cars["v"].mode == 31


RED = ("after", False, False, False, ":light_0", "r", "s", 10.0)
"""A red light at the end of the lane, as SUMO describes links."""


def test_a_raised_bound_stays_while_a_light_needs_it() -> None:
    """7 m before a red light at 9.3 m/s SUMO has planned to brake by 6.2 m/s2."""
    road = Road(lead=Car(speed=0.0), v=Car(speed=9.3, gap=9.0, leader="lead"))
    driver = Driver(adaptive({"name": "krauss"}))
    driver.step(road, "v")
    raised = road.cars["v"].decel
    assert raised > 6.2
    road.cars["v"].leader, road.links = None, [RED]
    for speed, decel in ((9.3, raised), (8.1, raised), (7.8, 4.5)):
        road.advance()
        road.cars["v"].speed = speed
        driver.step(road, "v")
        assert road.cars["v"].decel == decel, f"{speed**2 / 14:.2f} m/s2 are needed"
    assert road.cars["v"].kind == "calm"


def test_a_vehicle_that_is_given_back_before_a_light_keeps_the_bound_that_it_needs() -> None:
    road = Road(lead=Car(speed=0.0), v=Car(speed=9.3, gap=9.0, leader="lead"), w=Car(leader="lead"))
    driver = Driver(adaptive({"name": "krauss"}))
    driver.step(road, ["v", "w"])
    road.links = [RED]
    driver.release(road, "v")
    assert (road.cars["v"].told[-1], road.cars["v"].mode) == (-1, 31)
    assert road.cars["v"].decel > 6.2
    road.advance()
    road.cars["v"].speed = 7.0
    driver.step(road, "w")
    assert (road.cars["v"].decel, road.cars["v"].kind) == (4.5, "calm")


def test_nobody_brakes_harder_than_their_vtypes_emergency_decel() -> None:
    road = Road(lead=Car(speed=0.0), v=Car(speed=10.0, gap=3.0, leader="lead", emergency_decel=7.0))
    Driver(adaptive({"name": "krauss"})).step(road, "v")
    assert road.cars["v"].told[-1] == pytest.approx(10.0 - 0.7)
    assert road.cars["v"].decel == pytest.approx(7.0)


def test_a_vehicle_that_is_not_given_any_more_is_sumos_again_at_once() -> None:
    road = platoon(3, mode=23)
    driver = Driver(adaptive({"name": "krauss"}))
    driver.step(road, ["v0", "v1", "v2"])
    road.advance()
    driver.step(road, ["v0", "v2"])
    assert road.cars["v1"].told[-1] == -1
    assert road.cars["v1"].mode == 23
    assert driver.vehicles == ("v0", "v2")
    road.advance()
    driver.step(road, [])
    assert [road.cars[name].told[-1] for name in ("v0", "v2")] == [-1, -1]
    assert road.cars["v1"].told.count(-1) == 1


def test_in_several_calls_an_instant_a_vehicle_is_given_back_at_the_next_instant() -> None:
    road = platoon(3)
    driver = Driver(adaptive({"name": "krauss"}))
    for given in (("v0", "v1", "v2"), ("v0", "v1", "v2"), ("v0", "v1"), ("v0", "v1")):
        for name in given:
            driver.step(road, name)
        road.advance()
    assert road.cars["v2"].told[-1] == -1
    assert all(-1 not in road.cars[name].told for name in ("v0", "v1"))
    assert driver.vehicles == ("v0", "v1")


def test_a_model_without_limits_does_not_go_live() -> None:
    unbounded = adaptive({"name": "krauss", "limits": None})
    with pytest.raises(DataError, match="neither limits nor a brake cap"):
        Driver(unbounded)
    Driver(adaptive({"name": "krauss", "limits": None, "variant": "sumo"}))


def test_steps_outside_the_valid_range_and_at_limits_are_counted() -> None:
    rows = torch.randn((500, 5), generator=torch.Generator().manual_seed(0)).double()
    narrow = ValidRange.of([rows * 0.5 + torch.tensor([5.0, 0.0, 0.0, 0.0, 2.5])])
    driver = Driver(replace(adaptive({"name": "krauss"}), valid_range=narrow), speed_mode=0)
    road = platoon(4)
    for _ in range(3):
        driver.step(road, ["v0", "v1", "v2", "v3"])
        road.advance()
    assert driver.counts.steps == 12
    assert driver.counts.outside > 0
    assert "% of steps outside what the policy has learned (" in driver.outside_in_words()
    assert driver.counts.limited > 0
    assert len(driver.time_gaps(["v0", "v1"])) == 2
    assert Driver(adaptive({"name": "krauss"})).outside_in_words() == ""


def test_a_stochastic_policy_draws_live_with_a_seed() -> None:
    told: dict[int | None, list[list[float]]] = {}
    policy = adaptive({"name": "krauss"}, stochastic=True)
    for seed in (0, 1, None):
        told[seed] = []
        for _ in range(2):
            road = platoon(2)
            road.cars["v1"].speed, road.cars["v1"].gap = road.cars["v0"].speed, road.cars["v0"].gap
            driver = Driver(policy, seed=seed)
            for _ in range(4):
                driver.step(road, ["v0", "v1"])
                road.advance()
            told[seed].append([*road.cars["v0"].told, *road.cars["v1"].told])
    for twice in told.values():
        assert twice[0] == twice[1], "the same seed, the same drive"
    assert told[0][0] != told[1][0] != told[None][0]
    assert told[0][0][:4] != told[0][0][4:], "equal vehicles differ"
    assert told[None][0][:4] == told[None][0][4:]


def drawn_speeds(
    driver: Driver, vehicles: Sequence[str], steps: int = 12
) -> dict[str, list[float]]:
    """Returns what vehicles of a new road are told, in the order in which they are named."""
    road = platoon(5)
    for _ in range(steps):
        driver.step(road, vehicles)
        road.advance()
    return {name: road.cars[name].told for name in vehicles}


def test_what_is_drawn_for_a_vehicle_depends_on_no_other_vehicle() -> None:
    policy = adaptive({"name": "krauss"}, stochastic=True)
    alone = drawn_speeds(Driver(policy), ["v0", "v1"])
    reversed_order = drawn_speeds(Driver(policy), ["v1", "v0"])
    more = drawn_speeds(Driver(policy), ["v4", "v0", "v3", "v1"])
    for name in ("v0", "v1"):
        assert reversed_order[name] == alone[name]
        assert more[name] == pytest.approx(alone[name], abs=1e-12)
    other = drawn_speeds(Driver(policy, seed=1), ["v0", "v1"])
    assert other["v0"] != alone["v0"]


def test_the_factor_that_widens_forecasts_does_not_drive() -> None:
    policy = adaptive({"name": "krauss"}, stochastic=True)
    wide = replace(policy, dispersion=torch.tensor([3.0]))
    assert drawn_speeds(Driver(wide), ["v0", "v1"]) == drawn_speeds(Driver(policy), ["v0", "v1"])


def test_a_driver_begins_anew_where_time_goes_back() -> None:
    driver = Driver(adaptive({"name": "krauss"}, stochastic=True))
    first = drawn_speeds(driver, ["v0", "v1"], 7)
    assert drawn_speeds(driver, ["v0", "v1"], 7) == first


def test_random_numbers_of_vehicles_are_standard_normal_and_independent() -> None:
    names = [f"v{number}" for number in range(4000)]
    drawn = torch.cat([standard_normal(0, names, now, 3) for now in (0.0, 0.1)], 1)
    mean, correlation = drawn.mean(0), torch.corrcoef(drawn.T) - torch.eye(6)
    assert float(mean.abs().max()) < 0.06
    assert float((drawn.std(0) - 1.0).abs().max()) < 0.05
    assert float(correlation.abs().max()) < 0.06
    assert float((drawn < -1.645).double().mean()) == pytest.approx(0.05, abs=0.01)


def test_a_network_may_be_named_behind_the_run(tmp_path: Path) -> None:
    checkpoint.save_agent(adaptive({"name": "krauss"}, ("p1", "p2")), tmp_path / "policy")
    fleet = Fleet.load({"calm": f"{tmp_path}#p2"})
    road = platoon(1)
    fleet.step(road)
    one = Driver.load(tmp_path, network="p2")
    other = platoon(1)
    one.step(other, "v0")
    assert road.cars["v0"].told == other.cars["v0"].told
    with pytest.raises(DataError, match=r"--drivers TYPE=.*#p1"):
        Fleet.load({"calm": tmp_path})


def test_a_fleet_drives_each_type_by_its_own_and_finds_who_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, model in (("calm", "krauss"), ("hasty", "w99")):
        checkpoint.save_agent(adaptive({"name": model}), tmp_path / name / "policy")
    fleet = Fleet.load(
        {"calm": tmp_path / "calm", "normal": tmp_path / "calm", "hasty": tmp_path / "hasty"}
    )
    assert fleet.drivers["calm"] is fleet.drivers["normal"], "types of one run are one batch"
    road = platoon(9)
    road.cars["lead"].kind = "other"
    for i, kind in enumerate(
        ["calm", "normal", "hasty", "calm@v3", "other", "hasty", "normal", "calm", "calm"]
    ):
        road.cars[f"v{i}"].kind = kind
    calls = counted(monkeypatch)
    fleet.step(road)
    assert sorted(calls) == [2, 6]
    assert {name for name, kind in fleet.vehicles.items() if kind == "calm"} == {
        "v0",
        "v3",
        "v7",
        "v8",
    }
    assert {name for name, kind in fleet.vehicles.items() if kind == "hasty"} == {"v2", "v5"}
    assert len(fleet.vehicles) == 8
    assert set(fleet.driver("v2").parameters("v2")) == set(W99().space.names)
    road.advance()
    del road.cars["v0"]
    road.cars["new"] = Car(leader="lead", kind="hasty")
    fleet.step(road)
    assert "v0" not in fleet.vehicles
    assert fleet.drivers["hasty"].drives("new")
    assert road.cars["v4"].told == road.cars["lead"].told == []


def test_the_package_gives_the_driver_and_imports_no_sumo() -> None:
    assert cfx_sumo.Driver is Driver, "also after a plain `import cfx`"
    assert cfx_sumo.Fleet is Fleet
    with pytest.raises(AttributeError, match="no attribute 'Rider'"):
        _ = cfx_sumo.Rider


def _baseline(policy: Agent, component: Any, pairs: int) -> Agent:
    space = policy.core.head.model_space
    unit = space.to_unit(space.defaults()).expand(pairs, -1)
    blank = torch.zeros((pairs, 1)).double()
    names = tuple(str(i) for i in range(pairs))
    return Agent(
        core=AgentCore(
            component, ConstantNetwork(unit), Scaler(blank, blank + 1), DirectHead(space)
        ),
        model_node=policy.model_node,
        policy_node={"name": "default"},
        windows=policy.windows,
        dt=policy.dt,
        names=names,
    )


def style_of(pairs: Sequence[Any]) -> StyleResult:
    return measure_style(pairs, StyleSettings())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("node", "length", "frames", "history", "driver_features", "residual"),
    [
        pytest.param({"name": "krauss"}, 5, 250, 5.3, (), False, marks=pytest.mark.slow),
        ({"name": "w99"}, 5, 250, 5.3, (), True),
        ({"name": "krauss"}, 5, 250, 17.3, ("acceleration", "time_gap"), False),
        pytest.param(
            {"name": "w99"}, 8, 500, None, ("time_headway",), False, marks=pytest.mark.slow
        ),
    ],
    ids=[
        "offsets from own parameters, after 5 s",
        "with a residual acceleration, after 5 s",
        "with driver features, after 17 s",
        "parameters and driver features, after all there is",
    ],
)
def test_in_sumo_a_policy_drives_as_in_memory(
    node: dict[str, Any],
    length: int,
    frames: int,
    history: float | None,
    driver_features: tuple[str, ...],
    residual: bool,
    tmp_path: Path,
) -> None:
    """Behind replayed leaders in libsumo, across edges and junctions, to 1e-9."""
    model = {"krauss": Krauss, "w99": W99}[node["name"]]()
    low, high = model.space.bounds()
    true = (
        model.space.defaults() + 0.1 * (high - low) * torch.linspace(-1, 1, 4).double()[:, None]
    ).clamp(low, high)
    pairs = wavy_pairs(model, true, frames=frames)
    batch = PairBatch.of(pairs)
    policy = adaptive(
        node,
        tuple(pair.pair_id for pair in pairs),
        length=length,
        offsets=history is not None,
        residual=residual,
        driver_features=driver_features,
    )
    checkpoint.save_agent(policy, tmp_path / "policy")
    first, own = torch.tensor([0, 215, 100, frames - 100]), torch.arange(4)
    stepper, base = MemoryStepper(model, 0.1), model.space.defaults().expand(4, -1)
    loops = {
        "policy": simulate_closed_loop(
            stepper, policy, Followers(batch, own, base=base, history=history), first
        ),
        "default": simulate_closed_loop(
            stepper, _baseline(policy, DefaultPolicy(), 4), Followers(batch, own), first
        ),
        "driver_specific": simulate_closed_loop(
            stepper, _baseline(policy, FixedPolicy(), 4), Followers(batch, own), first
        ),
    }
    evaluation = evaluate(
        ComparedPairs(pairs, batch, first, style_of(pairs)), {"test": loops}, model.space
    )
    knowledge = PolicyKnowledge("driver_specific", history)
    job = FinishedJob(pairs, policy, evaluation, tmp_path / "policy", knowledge)
    shown = simulate_in_sumo(job, read_motorway(None, tmp_path), 4)
    assert {one.pair.pair_id: one.first for one in shown} == {
        f"p{i}": int(first[i]) for i in range(4)
    }
    for one in shown:
        assert one.table["difference_speed"].max() < 1e-9
        assert one.table["difference_gap"].max() < 1e-9
        memory = one.trajectory.parameters["policy"][1:]
        chosen = one.parameters[one.first : one.first + len(memory)]
        assert chosen == pytest.approx(memory, abs=1e-9)
        assert memory.std(axis=0).max() > 1e-3, "the policy changes what it chooses"
        assert one.gap["real"] == pytest.approx(one.pair.gap, abs=1e-9)
        assert one.speed["real"] == pytest.approx(one.pair.follower_speed, abs=1e-12)


def fleet_of_three(**options: Any) -> Driver:
    """Returns a driver whose policy knows three drivers, who have other time headways."""
    drivers = DriverPopulation(torch.tensor([[0.1], [8.0], [16.0]]).double(), torch.ones(3) / 3)
    policy = adaptive({"name": "krauss"}, driver_features=("time_headway",))
    policy = replace(policy, trained_on=replace(policy.trained_on, drivers=drivers))
    return Driver(policy, **options)


def chosen_by(driver: Driver, names: Sequence[str]) -> dict[str, float]:
    """Returns the first t_r of vehicles that are named in this order."""
    road = Road(lead=Car(), **{name: Car(leader="lead") for name in names})
    driver.step(road, list(names))
    return {name: driver.parameters(name)["t_r"] for name in names}


def test_each_vehicle_of_a_fleet_draws_a_recorded_driver() -> None:
    """By its id and the seed alone: another order, other vehicles beside it change nobody's."""
    names = [f"car{number}" for number in range(12)]
    chosen = chosen_by(fleet_of_three(), names)
    assert len(set(chosen.values())) == 3
    again = chosen_by(fleet_of_three(), [*reversed(names), "late"])
    assert {name: again[name] for name in names} == chosen
    assert chosen_by(fleet_of_three(seed=1), names) != chosen
    average = chosen_by(fleet_of_three(average=True), names)
    assert len(set(average.values())) == 1
    told = fleet_of_three()
    told.assign("car0", driver_features={"time_headway": 4.0})
    assert chosen_by(told, names)["car0"] not in chosen.values()
