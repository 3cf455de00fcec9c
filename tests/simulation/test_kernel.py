"""Kernels: losses summed up in compiled code are those of trajectories simulated by PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective
from cfx.calibration.rmse import SpeedRmse
from cfx.core import registry, threads
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.composed import WithResidual
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.base import Stepper
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import literal
from cfx.simulation.kernel.run import KernelKey, accumulate
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.step import advance_vehicle
from cfx.simulation.trajectory import ComponentKey, Segments, Start, Terms

DT = 0.1
PROBLEMS, CANDIDATES, STEPS = 5, 70, 40

pytestmark = pytest.mark.skipif(compiler.find_compiler() is None, reason="there is no C++ compiler")


def with_equations() -> list[str]:
    """Returns the names of all models that have equations."""
    names = []
    for name in registry.names("model"):
        model = registry.get("model", name)
        assert issubclass(model, DrivingModel)
        if not model.needs_simulator:
            names.append(name)
    return names


def made_up_segments(dtype: torch.dtype = torch.float64) -> Segments:
    """Returns segments of different lengths behind leaders who brake, stop and start again."""
    generator = torch.Generator().manual_seed(1)
    time = torch.arange(STEPS + 1, dtype=torch.float64)[:, None] * DT
    phase = torch.rand(PROBLEMS, generator=generator, dtype=torch.float64) * 6.0
    speed = (8.0 + 9.0 * torch.sin(time + phase)).clamp(min=0.0)
    position = 40.0 + (speed * DT).cumsum(0)
    acceleration = torch.diff(speed, dim=0, append=speed[-1:]) / DT
    length = torch.full((PROBLEMS,), 4.5, dtype=torch.float64)
    rear = position[1:] - length
    measured = (speed[1:] - 0.5).clamp(min=0.0)
    ends = torch.tensor([STEPS, STEPS - 1, 7, 1, 23])
    counted = (torch.arange(STEPS)[:, None] < ends).double()
    counted[3] = 0.0  # a frame in the middle that does not count
    values = Segments(
        leader_position=position[:-1],
        leader_speed=speed[:-1],
        leader_acceleration=acceleration[:-1],
        leader_rear=rear,
        measured_speed=measured,
        measured_gap=rear - (measured * DT).cumsum(0),
        counted=counted,
        leader_length=length,
        position=torch.zeros(PROBLEMS, dtype=torch.float64),
        speed=measured[0],
        acceleration=torch.zeros(PROBLEMS, dtype=torch.float64),
    )
    return Segments(*(value.to(dtype) for value in values))


def candidates_of(model: DrivingModel, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Returns random parameters of each problem within the bounds, and the model's constants."""
    generator = torch.Generator().manual_seed(2)
    shape = (PROBLEMS, CANDIDATES, len(model.space.names))
    unit = torch.rand(shape, generator=generator, dtype=torch.float64)
    return model.space.unpack(model.space.from_unit(unit.to(dtype)))


def simulated(
    stepper: Stepper, objective: Objective, segments: Segments, p: Mapping[str, Tensor]
) -> Tensor:
    """Returns losses `(P, q)` of trajectories."""
    shape = (PROBLEMS, CANDIDATES)
    start = Start(
        segments.position[:, None].expand(shape),
        segments.speed[:, None].expand(shape),
        segments.acceleration[:, None].expand(shape),
    )
    leader = Leader(
        segments.leader_position[..., None],
        segments.leader_speed[..., None],
        segments.leader_acceleration[..., None],
        segments.leader_length[..., None],
    )
    _, position, speed = stepper.advance(stepper.begin(start), leader, p)
    frames = FrameValues(
        speed=speed,
        gap=segments.leader_rear[..., None] - position,
        measured_speed=segments.measured_speed[..., None],
        measured_gap=segments.measured_gap[..., None],
        dt=DT,
    )
    return objective(frames, segments.counted[..., None])


def summed_up(
    stepper: Stepper, objective: Objective, segments: Segments, p: Mapping[str, Tensor]
) -> Tensor | None:
    """Returns losses `(P, q)` from sums; None where the stepper has none."""
    sums = stepper.accumulate(segments, p, terms_of(objective))
    if sums is None:
        return None
    return objective.finish(sums, segments.counted.sum(0).clamp(min=1)[:, None])


def terms_of(objective: Objective) -> Terms:
    def of_frame(*signals: Tensor) -> tuple[Tensor, ...]:
        speed, gap, measured_speed, measured_gap = signals
        return objective.terms(FrameValues(speed, gap, measured_speed, measured_gap, DT))

    return Terms(of_frame, f"{type(objective).__name__} {objective.settings!r}")


@pytest.mark.parametrize("name", with_equations())
def test_every_model_has_a_kernel_with_the_losses_of_its_trajectories(
    name: str,
) -> None:
    model = registry.create("model", {"name": name})
    objective = registry.create("objective", {"name": "mixed"})
    assert isinstance(model, DrivingModel)
    assert isinstance(objective, Objective)
    segments, p = made_up_segments(), candidates_of(model)
    found = summed_up(MemoryStepper(model, DT, compile="always"), objective, segments, p)
    wanted = simulated(MemoryStepper(model, DT, compile="never"), objective, segments, p)
    assert found is not None
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", registry.names("objective"))
def test_every_objective_is_summed_up_as_it_is_computed(name: str) -> None:
    check_sums_of({"name": name})


def test_an_objectives_setting_is_in_its_sums() -> None:
    check_sums_of({"name": "speed_huber", "delta": 0.1})


def check_sums_of(node: Mapping[str, Any]) -> None:
    model = Krauss()
    objective = registry.create("objective", node)
    assert isinstance(objective, Objective)
    segments, p = made_up_segments(), candidates_of(model)
    found = summed_up(MemoryStepper(model, DT, compile="always"), objective, segments, p)
    wanted = simulated(MemoryStepper(model, DT, compile="never"), objective, segments, p)
    assert found is not None
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def squares(speed: Tensor, gap: Tensor, measured: Tensor, measured_gap: Tensor) -> tuple[Tensor]:
    return ((speed - measured).square(),)


def test_single_precision_stays_single_and_close() -> None:
    model = Krauss()
    single = accumulate(
        model,
        DT,
        made_up_segments(torch.float32),
        candidates_of(model, torch.float32),
        Terms(squares, "single"),
    )
    double = accumulate(
        model, DT, made_up_segments(), candidates_of(model), Terms(squares, "double")
    )
    assert single is not None
    assert double is not None
    assert single[0].dtype == torch.float32
    torch.testing.assert_close(single[0].double(), double[0], rtol=1e-3, atol=1e-3)


def test_the_number_of_cores_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    model, segments = Krauss(), made_up_segments()
    p = {}
    for name, value in candidates_of(model).items():
        p[name] = value if value.dim() == 0 else value.repeat(1, 100)
    monkeypatch.setattr(threads, "cores", lambda: 1)
    alone = accumulate(model, DT, segments, p, Terms(squares, "cores"))
    monkeypatch.setattr(threads, "cores", lambda: 4)
    shared = accumulate(model, DT, segments, p, Terms(squares, "cores"))
    assert alone is not None
    assert shared is not None
    assert torch.equal(alone[0], shared[0])


def test_candidates_that_all_problems_share_need_no_copy() -> None:
    model, segments = Krauss(), made_up_segments()
    shared, copied = {}, {}
    for name, value in candidates_of(model).items():
        shared[name] = value if value.dim() == 0 else value[:1]
        copied[name] = value if value.dim() == 0 else value[:1].repeat(PROBLEMS, 1)
    one = accumulate(model, DT, segments, shared, Terms(squares, "shared"))
    other = accumulate(model, DT, segments, copied, Terms(squares, "shared"))
    assert one is not None
    assert other is not None
    assert torch.equal(one[0], other[0])


def test_nan_in_a_parameter_stays_nan_and_harms_no_other_candidate() -> None:
    model, segments = Krauss(), made_up_segments()
    p = candidates_of(model)
    p["t_r"] = p["t_r"].clone()
    healthy = accumulate(model, DT, segments, p, Terms(squares, "nan"))
    p["t_r"][2, 5] = torch.nan
    found = accumulate(model, DT, segments, p, Terms(squares, "nan"))
    assert found is not None
    assert healthy is not None
    expected = healthy[0].clone()
    expected[2, 5] = torch.nan
    torch.testing.assert_close(found[0], expected, equal_nan=True, rtol=0, atol=0)


class Branches(Krauss):
    """Asks for a value, as no elementwise function can."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        if bool((follower.speed > 3.0).any()):
            return follower.speed
        return super().next_speed(follower, leader, p, dt)


class MixesVehicles(Krauss):
    """Lets each vehicle see all others: nothing that a loop over candidates can do."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        return follower.speed - follower.speed.mean()


class RemembersMuch(Krauss):
    """Has a memory that is too wide for a thread's stack."""

    memory_size = 100_000


class TakesOneVehiclesSpeed(Krauss):
    """Lets all vehicles drive as the first one does."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        return follower.speed[0].expand_as(follower.speed)


class LooksUpWhatIsComputed(Krauss):
    """Chooses a column of values that no memory holds."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        both = torch.stack([follower.speed, follower.speed + 1.0], -1)
        index = (follower.speed > 3.0).long()[..., None]
        return both.gather(-1, index)[..., 0]


@pytest.mark.parametrize(
    "model",
    [
        Branches(),
        MixesVehicles(),
        RemembersMuch(),
        TakesOneVehiclesSpeed(),
        LooksUpWhatIsComputed(),
    ],
)
def test_a_model_that_is_not_elementwise_is_left_to_pytorch(model: DrivingModel) -> None:
    p = candidates_of(model)
    assert accumulate(model, DT, made_up_segments(), p, Terms(squares, "squares")) is None


def hyperbolic(
    speed: Tensor, gap: Tensor, measured_speed: Tensor, measured_gap: Tensor
) -> tuple[Tensor]:
    return (torch.cosh(speed - measured_speed),)


class Hyperbolic(SpeedRmse):
    """An objective with an operation that has no C++ counterpart."""


@pytest.mark.parametrize(
    ("model", "terms", "named"),
    [
        (Krauss(), Terms(hyperbolic, ComponentKey(Hyperbolic, "")), "Hyperbolic"),
        (Branches(), Terms(squares, ComponentKey(SpeedRmse, "")), "Branches"),
    ],
)
def test_what_has_no_kernel_is_named(
    model: DrivingModel, terms: Terms, named: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"):
        assert accumulate(model, DT, made_up_segments(), candidates_of(model), terms) is None
    assert f"{named} has no compiled kernel" in caplog.text


class Remembers(Krauss):
    """Drives with the mean of its speeds: a memory that begins with the first one, and counts."""

    memory_size = 2

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        mean = follower.memory[..., 0] / follower.memory[..., 1]
        return 0.5 * (mean + super().next_speed(follower, leader, p, dt))

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        return follower.memory + torch.stack([speed, torch.ones_like(speed)], -1)

    def initial_memory(self, speed: Tensor) -> Tensor:
        return torch.stack([speed, torch.ones_like(speed)], -1)


class RemembersFrames(Krauss):
    """Drives at the speed of five frames ago; the memory's frames move on in each step."""

    memory_size = 5

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        return 0.5 * (follower.memory[..., -1] + super().next_speed(follower, leader, p, dt))

    def next_memory(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float, speed: Tensor
    ) -> Tensor:
        return torch.cat([speed[..., None], follower.memory[..., :-1]], -1)


@pytest.mark.parametrize("model", [Remembers(), RemembersFrames(), WithResidual(Krauss())])
def test_a_memory_begins_with_the_start_and_goes_on_from_step_to_step(model: DrivingModel) -> None:
    objective = registry.create("objective", {"name": "mixed"})
    assert isinstance(objective, Objective)
    segments, p = made_up_segments(), candidates_of(model)
    found = summed_up(MemoryStepper(model, DT, compile="always"), objective, segments, p)
    wanted = simulated(MemoryStepper(model, DT, compile="never"), objective, segments, p)
    assert found is not None
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def test_small_work_is_not_worth_a_kernel() -> None:
    model = Krauss()
    stepper = MemoryStepper(model, DT)
    assert (
        stepper.accumulate(made_up_segments(), candidates_of(model), Terms(squares, "small"))
        is None
    )


def test_a_library_is_built_once_and_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CFX_KERNEL_CACHE", str(tmp_path / "kernels"))
    compiler.cache_folder.cache_clear()
    compiler.build_library.cache_clear()
    source = 'extern "C" long answer() { return 42; }\n'
    library = compiler.build_library(source)
    assert library is not None
    assert library.answer() == 42
    files = list((tmp_path / "kernels").iterdir())
    assert [path.suffix for path in files] == [".so"]
    written = files[0].stat().st_mtime_ns
    compiler.build_library.cache_clear()
    assert compiler.build_library(source) is not None
    assert files[0].stat().st_mtime_ns == written
    compiler.cache_folder.cache_clear()


def test_a_cache_that_others_may_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("CFX_KERNEL_CACHE", str(shared))
    compiler.cache_folder.cache_clear()
    assert compiler.cache_folder() != shared
    compiler.cache_folder.cache_clear()


def test_source_that_does_not_compile_gives_no_library() -> None:
    assert compiler.build_library("this is no C++") is None


@pytest.mark.parametrize("value", [0.1, -1e-300, 3.0, float("inf"), True])
def test_numbers_are_written_exactly(value: float) -> None:
    text = literal(value)
    if isinstance(value, bool):
        assert text == "true"
    elif value == float("inf"):
        assert text == "real(INFINITY)"
    else:
        assert float.fromhex(text.removeprefix("real(").removesuffix(")")) == value


def test_a_recorded_step_is_remembered_under_the_code_that_it_came_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CFX_KERNEL_CACHE", str(tmp_path / "kernels"))
    compiler.cache_folder.cache_clear()
    calls = []

    def make() -> str:
        calls.append(None)
        return "source"

    assert [compiler.remembered("key", make) for _ in range(2)] == ["source", "source"]
    assert len(calls) == 1
    assert [compiler.remembered(None, make) for _ in range(2)] == ["source", "source"]
    assert len(calls) == 3
    compiler.cache_folder.cache_clear()


def key_of(model: type, settings: str = "{}", temperature: float = 0.0) -> KernelKey:
    return KernelKey(
        model=ComponentKey(model, settings),
        temperature=temperature,
        terms=ComponentKey(SpeedRmse, "{}"),
        dt=DT,
        parameters=(("t_r", True),),
        dtype=torch.float64,
    )


def test_what_a_kernel_depends_on_is_in_its_key() -> None:
    keys = {
        key_of(Krauss).lasting(),
        key_of(W99).lasting(),
        key_of(Krauss, '{"variant": "sumo"}').lasting(),
        key_of(Krauss, temperature=0.5).lasting(),
        key_of(Branches).lasting(),
    }
    assert None not in keys
    assert len(keys) == 5
    assert key_of(Krauss).lasting() == key_of(Krauss).lasting()


def test_a_class_made_in_a_function_is_known_to_its_process_alone() -> None:
    class Here(Krauss):
        pass

    assert key_of(Here).lasting() is None
    assert key_of(Krauss)._replace(terms="a name").lasting() is None


@pytest.mark.parametrize("every", [1, 7])
def test_terms_of_single_frames_are_those_of_trajectories(every: int) -> None:
    model, segments = Krauss(), made_up_segments()
    p, terms = candidates_of(model), terms_of(SpeedRmse())
    stepper = MemoryStepper(model, DT, compile="always")
    found = stepper.accumulate(segments, p, terms, every)
    sums = stepper.accumulate(segments, p, terms)
    assert found is not None
    assert sums is not None
    assert found[0].shape == (STEPS // every, PROBLEMS, CANDIDATES)
    single = stepper.accumulate(segments, p, terms, 1)
    assert single is not None
    torch.testing.assert_close(found[0], single[0][every - 1 :: every], rtol=0, atol=0)
    torch.testing.assert_close(single[0].sum(0), sums[0], rtol=1e-12, atol=1e-12)


class AddsScaled(Krauss):
    """Adds a multiple in one operation, which is not plain addition."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        speed = super().next_speed(follower, leader, p, dt)
        return torch.sub(torch.add(speed, p["t_i"], alpha=0.5), p["t_i"], alpha=3)


class SplitsAlike(Krauss):
    """Cuts columns into some of one width."""

    def next_speed(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor], dt: float
    ) -> Tensor:
        both = torch.stack([super().next_speed(follower, leader, p, dt), follower.speed], -1)
        return both.split(1, dim=-1)[0][..., 0]


@pytest.mark.parametrize("model", [AddsScaled(), SplitsAlike()])
def test_operations_with_options_have_a_kernel_with_the_losses_of_pytorch(
    model: DrivingModel,
) -> None:
    segments, p, objective = made_up_segments(), candidates_of(model), SpeedRmse()
    losses = summed_up(MemoryStepper(model, DT, compile="always"), objective, segments, p)
    expected = simulated(MemoryStepper(model, DT, compile="never"), objective, segments, p)
    assert losses is not None
    torch.testing.assert_close(losses, expected, rtol=1e-9, atol=1e-9)


def test_states_that_are_corrected_are_those_of_steps_one_by_one() -> None:
    model, segments, every = W99(), made_up_segments(), 5
    p, terms = candidates_of(model), terms_of(SpeedRmse())
    gain = torch.linspace(0.0, 1.0, CANDIDATES, dtype=torch.float64).expand(PROBLEMS, -1)
    stepper = MemoryStepper(model, DT, compile="always")
    found = stepper.accumulate(segments, p, terms, every, gain)
    assert found is not None
    shape = (PROBLEMS, CANDIDATES)
    begin = (segments.position, segments.speed, segments.acceleration)
    follower = stepper.begin(Start(*(value[:, None].expand(shape) for value in begin)))
    for step in range(STEPS):
        leader = Leader(
            segments.leader_position[step, :, None],
            segments.leader_speed[step, :, None],
            segments.leader_acceleration[step, :, None],
            segments.leader_length[:, None],
        )
        follower = advance_vehicle(model, follower, leader, p, DT)
        if (step + 1) % every:
            continue
        number = (step + 1) // every
        error = follower.speed - segments.measured_speed[step, :, None]
        expected = error.square() * segments.counted[step, :, None]
        torch.testing.assert_close(found[0][number - 1], expected, rtol=1e-9, atol=1e-12)
        share = gain + (1.0 - gain) / (number + 1)
        measured = (segments.leader_rear - segments.measured_gap)[step, :, None]
        follower = follower._replace(
            position=follower.position + share * (measured - follower.position),
            speed=follower.speed - share * error,
        )
