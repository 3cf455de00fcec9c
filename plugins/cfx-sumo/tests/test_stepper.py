"""`SumoStepper` takes the steps of the models' own equations, and says where it cannot."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

import cfx
from cfx.errors import ConfigError, SumoError
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.plugin import DrivingModel, Follower, Leader, Start
from cfx.simulation.rollout import MemoryStepper
from cfx_contracts import check_contract
from cfx_sumo.simulation.simulator import SumoSimulator
from cfx_sumo.simulation.stepper import require_in_sumo
from cfx_sumo.vtype import SumoVType
from tests.evaluation.test_platoon import Linear

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("libsumo") is None,
    reason="SUMO is not here; pip install 'cfx-driving[sumo]'",
)

STEPS, PAIRS, DT = 60, 9, 0.1
IDM_SUMO = cfx.get("model", "idm_sumo")
KRAUSS_SUMO = cfx.get("model", "krauss_sumo")
KRAUSS = Krauss(limits=None, variant="sumo", parameters={"t_i": {"default": 0.0, "tuned": False}})
TAU = {"low": 0.5, "high": 3.0, "default": 1.0}
EIDM = SumoVType(parameters={"tau": TAU})


@pytest.fixture(scope="module")
def sumo() -> SumoSimulator:
    """Returns one for all statements: a SUMO process takes a second to start."""
    return SumoSimulator(workers=1)


def test_contract(sumo: SumoSimulator) -> None:
    check_contract(sumo)


class Case:
    """Followers behind leaders whose signals do not quite agree, as those of recordings."""

    def __init__(self) -> None:
        self.draw = torch.Generator().manual_seed(4)
        first = self.uniform(3, 20, PAIRS)
        acceleration = (self.uniform(-1, 1, STEPS, PAIRS).cumsum(0) * 0.2).clamp(-2.0, 0.9)
        speed = (first + acceleration.cumsum(0) * DT).clamp(min=0.0)
        position = 50.0 + (speed * DT).cumsum(0) + self.uniform(-0.2, 0.2, STEPS, PAIRS)
        self.leader = Leader(
            position,
            speed,
            acceleration + self.uniform(-0.05, 0.05, STEPS, PAIRS),
            self.uniform(4, 9, PAIRS),
        )
        own = (first + self.uniform(-2, 2, PAIRS)).clamp(min=0.0)
        behind = position[0] - self.leader.length - 3.0 - self.uniform(0.5, 2, PAIRS) * own
        self.start = Start(behind, own, self.uniform(-1, 1, PAIRS))

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self.draw, dtype=torch.float64)

    def parameters(self, model: DrivingModel) -> dict[str, Tensor]:
        return model.space.unpack(
            model.space.from_unit(self.uniform(0, 1, PAIRS, len(model.space)))
        )

    def part(self, first: int, last: int) -> Leader:
        return Leader(*(signal[first:last] for signal in self.leader[:3]), self.leader.length)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


def in_sumo(model: DrivingModel, **settings: int) -> Iterator[object]:
    from cfx_sumo.simulation.stepper import SumoStepper

    stepper = SumoStepper(model, DT, **({"workers": 1} | settings))
    yield stepper
    stepper.close()


@pytest.fixture(scope="module")
def eidm() -> Iterator[object]:
    yield from in_sumo(EIDM)


@pytest.mark.parametrize(
    "model",
    [KRAUSS, KRAUSS_SUMO(limits=None), IDM_SUMO(limits=None), W99(limits=None)],
    ids=lambda model: type(model).__name__,
)
def test_drives_in_sumo_are_drives_in_memory(model: DrivingModel, case: Case) -> None:
    memory, p = MemoryStepper(model, DT), case.parameters(model)
    for sumo in in_sumo(model, workers=2, followers=4):
        expected = memory.advance(memory.begin(case.start), case.leader, p)
        found = sumo.advance(sumo.begin(case.start), case.leader, p)
        for theirs, ours in zip(
            [*found[0], *found[1:]], [*expected[0], *expected[1:]], strict=True
        ):
            torch.testing.assert_close(theirs, ours, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    "model",
    [KRAUSS_SUMO(limits=None), IDM_SUMO(limits=None)],
    ids=lambda model: type(model).__name__,
)
@pytest.mark.parametrize("dt", [0.2, 0.5, 1.0])
def test_longer_time_steps_are_sumos_too(model: DrivingModel, dt: float, case: Case) -> None:
    from cfx_sumo.simulation.stepper import SumoStepper

    p, memory, sumo = (
        case.parameters(model),
        MemoryStepper(model, dt),
        SumoStepper(model, dt, workers=1),
    )
    far = Start(case.start.position - 20.0, case.start.speed, case.start.acceleration)
    expected = memory.advance(memory.begin(far), case.part(0, 12), p)[2]
    torch.testing.assert_close(
        sumo.advance(sumo.begin(far), case.part(0, 12), p)[2], expected, rtol=0.0, atol=1e-9
    )
    sumo.close()


@pytest.mark.parametrize("model", [KRAUSS_SUMO, IDM_SUMO, W99])
@pytest.mark.parametrize(
    "changed", ["response_time=0.3", "acceleration=1.5", "emergency_deceleration=6"]
)
def test_limits_that_sumo_does_not_keep_to_are_refused(
    model: type[DrivingModel], changed: str
) -> None:
    name, value = changed.split("=")
    with pytest.raises(ConfigError, match=rf"knows nothing of model\.limits\.{changed}"):
        require_in_sumo(model(limits={name: float(value)}))
    require_in_sumo(model(limits={"comfortable_deceleration": 3.0}))


def test_a_leader_of_length_0_is_where_its_rear_bumper_is(case: Case) -> None:
    model = IDM_SUMO(limits=None)
    p = case.parameters(model)
    rear = case.leader.position - case.leader.length
    net = Leader(rear, case.leader.speed, case.leader.acceleration, torch.zeros(PAIRS).double())
    for sumo in in_sumo(model):
        expected = sumo.advance(sumo.begin(case.start), case.leader, p)[2]
        found = sumo.advance(sumo.begin(case.start), net, p)[2]
        torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-9)


def test_a_drive_in_parts_is_the_drive_in_one(case: Case) -> None:
    model = KRAUSS_SUMO()
    p = case.parameters(model)
    for sumo in in_sumo(model):
        follower, parts = sumo.begin(case.start), []
        for first in range(0, STEPS, 25):
            follower, _, speed = sumo.advance(follower, case.part(first, first + 25), p)
            parts.append(speed)
        whole = sumo.advance(sumo.begin(case.start), case.leader, p)[2]
        torch.testing.assert_close(torch.cat(parts), whole, rtol=0.0, atol=1e-9)


def test_what_a_model_remembers_is_kept_while_its_parameters_are(case: Case) -> None:
    model = SumoVType(car_follow_model="CACC", parameters={"tau": TAU})
    p = {"tau": case.uniform(0.6, 2.5, PAIRS)}
    parts, forgetful = [], []
    for sumo in in_sumo(model):
        whole = sumo.advance(sumo.begin(case.start), case.leader, p)[2]
        anew = follower = sumo.begin(case.start)
        for first in range(0, STEPS, 5):
            follower, _, speed = sumo.advance(follower, case.part(first, first + 5), p)
            anew, _, other = sumo.advance(Follower(*anew), case.part(first, first + 5), p)
            parts.append(speed)
            forgetful.append(other)
    assert torch.equal(torch.cat(parts), whole)
    assert (torch.cat(forgetful) - whole).abs().max() > 1e-3  # else the model would not need it


def test_a_follower_whose_parameters_change_begins_anew_and_the_others_do_not(
    eidm: object, case: Case
) -> None:
    before = {"tau": torch.full((PAIRS,), 1.5, dtype=torch.float64)}
    after = {"tau": before["tau"].clone().index_fill_(0, torch.tensor([2]), 0.8)}
    follower, *_ = eidm.advance(eidm.begin(case.start), case.part(0, 30), before)
    steady, _, speed = eidm.advance(follower, case.part(30, 60), after)
    whole = eidm.advance(eidm.begin(case.start), case.leader, before)[2][30:]
    fresh = eidm.advance(Follower(*follower), case.part(30, 60), after)[2]
    others = torch.arange(PAIRS) != 2
    torch.testing.assert_close(speed[:, others], whole[:, others], rtol=0.0, atol=1e-12)
    torch.testing.assert_close(speed[:, 2], fresh[:, 2], rtol=0.0, atol=1e-12)
    last = eidm.advance(steady, case.part(0, 5), after)[2]
    assert bool(last.isfinite().all())


def test_leaders_and_parameters_broadcast_and_single_precision_stays(case: Case) -> None:
    model = IDM_SUMO()
    memory = MemoryStepper(model, DT)
    leader = Leader(*(x.float()[..., None] for x in case.leader))
    start = Start(*(x.float()[:, None].expand(PAIRS, 3) for x in case.start))
    p = {
        name: value.float()
        for name, value in model.space.unpack(
            model.space.from_unit(case.uniform(0, 1, 3, 5))
        ).items()
    }
    for sumo in in_sumo(model, followers=10):
        expected = memory.advance(memory.begin(start), leader, p)
        found = sumo.advance(sumo.begin(start), leader, p)
        assert found[2].dtype == torch.float32
        torch.testing.assert_close(found[2], expected[2], rtol=0.0, atol=1e-3)


def test_a_follower_who_collides_stays_and_has_a_negative_gap() -> None:
    steps = 30
    position = 50.0 + torch.arange(steps, dtype=torch.float64)[:, None].repeat(1, 3)
    position[10:, 0] -= 45.0  # it jumps behind its follower
    leader = Leader(
        position,
        torch.full_like(position, 10.0),
        torch.zeros_like(position),
        torch.full((3,), 5.0).double(),
    )
    zero = torch.zeros(3, dtype=torch.float64)
    start = Start(
        torch.tensor([30.0, 47.0, 70.0], dtype=torch.float64), zero + 10.0, zero
    )  # 2 m too near; ahead of its leader
    model = KRAUSS_SUMO()
    p = model.space.unpack(model.space.defaults().expand(3, -1))
    for sumo in in_sumo(model):
        _, place, speed = sumo.advance(sumo.begin(start), leader, p)
    gap = leader.position - leader.length - torch.cat([start.position[None], place[:-1]])
    assert bool(speed.isfinite().all())
    assert gap[15, 0] < 0
    torch.testing.assert_close(place.diff(dim=0), speed[1:] * DT, rtol=0.0, atol=1e-9)
    assert speed[0, 1] == pytest.approx(10.0 - 0.9), "it brakes as hard as it can"
    assert speed[-1, 1] > 5.0, "and goes on once its leader is away"
    assert speed[-1, 2] == pytest.approx(10.0 + 2.6 * DT * steps), "with nobody ahead it drives on"


def test_the_same_request_gives_the_same_drives_whatever_came_before(case: Case) -> None:
    model = SumoVType(car_follow_model="Krauss", parameters={"tau": TAU}, attributes={"sigma": 0.5})
    p = {"tau": torch.tensor(1.0, dtype=torch.float64)}
    for sumo in in_sumo(model):
        first, again = (sumo.advance(sumo.begin(case.start), case.leader, p)[2] for _ in range(2))
    for sumo in in_sumo(model, seed=1):
        other = sumo.advance(sumo.begin(case.start), case.leader, p)[2]
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_settings_that_change_drives_are_part_of_what_caches_see(eidm: object) -> None:
    from cfx_sumo.simulation.stepper import SumoStepper

    assert SumoStepper(EIDM, DT, workers=3).identity() == eidm.identity()
    assert (
        SumoStepper(EIDM, DT, seed=1).identity()
        != eidm.identity()
        != MemoryStepper(EIDM, DT).identity()
    )


def test_gradients_are_refused(eidm: object, case: Case) -> None:
    assert not eidm.differentiable
    assert MemoryStepper(KRAUSS_SUMO(), DT).differentiable
    p = {"tau": torch.tensor(1.0, dtype=torch.float64, requires_grad=True)}
    with pytest.raises(
        SumoError,
        match="SUMO gives no gradients: learn with learner=imitation, or drive with simulator=mem",
    ):
        eidm.advance(eidm.begin(case.start), case.leader, p)


def test_nobody_or_no_time_is_no_drive(eidm: object, case: Case) -> None:
    p = {"tau": torch.tensor(1.0, dtype=torch.float64)}
    follower, position, speed = eidm.advance(eidm.begin(case.start), case.part(0, 0), p)
    assert position.shape == speed.shape == (0, PAIRS)
    assert torch.equal(follower.speed, case.start.speed)


@pytest.mark.parametrize(
    ("model", "dt", "sentence"),
    [
        (
            Linear(),
            DT,
            "SUMO has no car-following model Linear; choose model=krauss_sumo, idm_sumo, w99, krauss"
            " or sumo_vtype",
        ),
        (Krauss(), DT, "only without a brake build-up time; add model.variant=sumo"),
        (
            IDM_SUMO(),
            1 / 30,
            "SUMO counts in milliseconds, so it cannot take the recording's steps of 0.0333333 s",
        ),
        (
            SumoVType(car_follow_model="EIDN", parameters={"tau": TAU}),
            DT,
            "no such car-following model. Did you mean 'EIDM'",
        ),
        (
            SumoVType(parameters={"tua": TAU}),
            DT,
            "SUMO's EIDM reads no attribute 'tua'. Did you mean 'tau'",
        ),
        (SumoVType(parameters={"cc1": TAU}), DT, "SUMO's EIDM reads no attribute 'cc1'"),
        (
            SumoVType(parameters={"tau": TAU}, attributes={"nonsense": 1}),
            DT,
            "SUMO's EIDM reads no attribute 'nonsense'",
        ),
    ],
)
def test_what_sumo_cannot_drive_is_refused_before_any_work(
    model: DrivingModel, dt: float, sentence: str
) -> None:
    from cfx_sumo.simulation.stepper import SumoStepper

    with pytest.raises(ConfigError) as error:
        SumoStepper(model, dt)
    assert sentence in str(error.value)


def test_a_value_that_sumo_refuses_is_told_in_its_own_words(case: Case) -> None:
    model = SumoVType(parameters={"tau": {"low": -1.0, "high": 3.0, "default": 1.0}})
    for sumo in in_sumo(model):
        with pytest.raises(
            SumoError, match=r"^SUMO refuses the vehicles: .*tau\. Must be greater than 0$"
        ):
            sumo.advance(
                sumo.begin(case.start),
                case.leader,
                {"tau": torch.tensor(-1.0, dtype=torch.float64)},
            )
