from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.errors import ParameterError
from cfx.models.base import DrivingModel, Leader
from cfx.models.idm import IDM
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation import rollout
from cfx.simulation.rollout import MemoryStepper, can_compile, simulate_follower
from cfx.simulation.trajectory import Start, Trajectory

DT = 0.1
MODELS = [Krauss(), W99(), IDM()]
each_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: type(model).__name__)


def wavy_leader(
    pairs: int, frames: int, dtype: torch.dtype = torch.float64, device: str = "cpu"
) -> Leader:
    time = torch.arange(frames, dtype=torch.float64) * DT
    phase = torch.arange(pairs, dtype=torch.float64)[:, None]
    speed = (8 + 7 * torch.sin(0.4 * time + phase)).clamp(min=0.0)
    speed = torch.where(speed < 3.0, 0.0, speed)
    position = 30.0 + torch.cumsum(speed * DT, dim=1)
    acceleration = torch.diff(speed, dim=1, prepend=speed[:, :1]) / DT
    tensors = position, speed, acceleration, torch.full((pairs,), 5.0, dtype=torch.float64)
    return Leader(*(x.to(device=device, dtype=dtype) for x in tensors))


def start_of(
    batch: tuple[int, ...], dtype: torch.dtype = torch.float64, device: str = "cpu"
) -> Start:
    zero = torch.zeros(batch, dtype=dtype, device=device)
    return Start(zero, zero + 8.0, zero)


def candidates(
    model: DrivingModel, *batch: int, seed: int = 0, dtype: torch.dtype = torch.float64
) -> Tensor:
    unit = torch.rand(
        (*batch, len(model.space)),
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.float64,
    )
    return model.space.from_unit(unit).to(dtype)


def assert_same(one: Trajectory, other: Trajectory, tolerance: float = 1e-9) -> None:
    torch.testing.assert_close(one.speed, other.speed, rtol=0, atol=tolerance)
    torch.testing.assert_close(one.gap, other.gap, rtol=0, atol=10 * tolerance)
    assert torch.equal(one.collided, other.collided)


@each_model
def test_it_integrates_by_forward_euler(model: DrivingModel) -> None:
    leader = wavy_leader(2, 40)
    out = simulate_follower(model, None, leader, start_of((2,)), DT)
    assert out.speed.shape == (2, 40)
    torch.testing.assert_close(out.position[:, 1:], out.position[:, :-1] + out.speed[:, 1:] * DT)
    torch.testing.assert_close(out.gap, leader.position - 5.0 - out.position)


@each_model
def test_a_batch_equals_the_loop(model: DrivingModel) -> None:
    leader, p = wavy_leader(3, 60), candidates(model, 3, 4)
    wide = Leader(*(x[:, None] for x in leader))
    together = simulate_follower(model, p, wide, start_of((3, 4)), DT)
    for i in range(3):
        alone_behind = Leader(*(x[i] for x in leader))
        for k in range(4):
            alone = simulate_follower(model, p[i, k], alone_behind, start_of(()), DT)
            assert_same(Trajectory(*(x[i, k] for x in together)), alone)


@each_model
def test_leading_dimensions_broadcast(model: DrivingModel) -> None:
    p = candidates(model, 4)
    leader = wavy_leader(1, 30)
    out = simulate_follower(model, p, Leader(*(x[0] for x in leader)), start_of(()), DT)
    assert out.speed.shape == (4, 30)
    full = simulate_follower(
        model, p, Leader(*(x.expand(4, *x.shape[1:]) for x in leader)), start_of((4,)), DT
    )
    assert_same(out, full)


@each_model
def test_parameters_per_window(model: DrivingModel) -> None:
    leader, windows = wavy_leader(2, 24), 4
    p = candidates(model, 2, windows)
    out = simulate_follower(model, p, leader, start_of((2,)), DT, window=5)
    stepper = MemoryStepper(model, DT, compile="never")
    follower, speeds = stepper.begin(start_of((2,))), []
    for k in range(23):  # the last window's parameters are kept for the rest
        at = Leader(*(x.T[k : k + 1] for x in leader[:3]), leader.length)
        follower, _, speed = stepper.advance(
            follower, at, model.space.unpack(p[:, min(k // 5, windows - 1)])
        )
        speeds.append(speed)
    torch.testing.assert_close(out.speed[:, 1:], torch.cat(speeds).T)
    same = p[:, :1].expand(2, windows, -1)
    assert_same(
        simulate_follower(model, same, leader, start_of((2,)), DT, window=5),
        simulate_follower(model, p[:, 0], leader, start_of((2,)), DT),
    )


def test_parameters_by_name_leave_the_others_at_their_defaults() -> None:
    model, leader = Krauss(), wavy_leader(2, 30)
    defaults = simulate_follower(model, None, leader, start_of((2,)), DT)
    assert_same(simulate_follower(model, {"t_r": 1.5}, leader, start_of((2,)), DT), defaults)
    assert_same(
        simulate_follower(model, model.space.defaults(), leader, start_of((2,)), DT), defaults
    )
    each = simulate_follower(
        model, {"t_r": torch.tensor([1.5, 3.0], dtype=torch.float64)}, leader, start_of((2,)), DT
    )
    torch.testing.assert_close(each.speed[0], defaults.speed[0])
    assert (each.speed[1] - defaults.speed[1]).abs().max() > 0.1


def test_a_user_s_mistakes_are_named() -> None:
    model, leader, start = Krauss(), wavy_leader(2, 10), start_of((2,))
    with pytest.raises(ParameterError, match=r"unknown parameter 'tr'. Did you mean 't_r'"):
        simulate_follower(model, {"tr": 1.0}, leader, start, DT)
    with pytest.raises(ParameterError, match="expected 2 parameters"):
        simulate_follower(model, torch.ones(2, 3), leader, start, DT)
    with pytest.raises(ParameterError, match="window=0"):
        simulate_follower(model, candidates(model, 2, 3), leader, start, DT, window=0)
    with pytest.raises(ParameterError, match="got no window"):
        simulate_follower(model, torch.ones(2, 0, 2), leader, start, DT, window=5)


def ragged(lengths: tuple[int, ...]) -> PairSet:
    leader = wavy_leader(len(lengths), max(lengths))
    pairs = []
    for i, count in enumerate(lengths):
        position, speed, acceleration = (x[i, :count].numpy() for x in leader[:3])
        zero = np.zeros(count)
        pairs.append(
            Pair(
                f"p{i}",
                "r",
                "1",
                str(i),
                0,
                DT,
                5.0,
                1e5 + position,
                speed,
                acceleration,
                zero + 1e5,
                zero + 8.0,
                zero,
            )
        )
    return PairSet(tuple(pairs), "made up")


@each_model
def test_ragged_pairs_drive_as_if_alone_within_the_mask(model: DrivingModel) -> None:
    pairs = ragged((40, 17, 1, 29))
    batch = PairBatch.of(pairs)
    whole = drive(model, batch)
    assert whole.speed.isfinite().all()
    for i, pair in enumerate(pairs):
        alone = drive(model, PairBatch.of([pair]))
        torch.testing.assert_close(whole.speed[i][batch.mask[i]], alone.speed[0], rtol=0, atol=1e-9)


def drive(model: DrivingModel, batch: PairBatch) -> Trajectory:
    leader = Leader(
        batch.leader_position, batch.leader_speed, batch.leader_acceleration, batch.leader_length
    )
    first = (
        batch.follower_position[:, 0],
        batch.follower_speed[:, 0],
        batch.follower_acceleration[:, 0],
    )
    return simulate_follower(model, None, leader, Start(*first), batch.dt)


@each_model
def test_single_precision_stays_near_double(model: DrivingModel) -> None:
    double = simulate_follower(model, candidates(model, 3), wavy_leader(3, 60), start_of((3,)), DT)
    single = simulate_follower(
        model,
        candidates(model, 3, dtype=torch.float32),
        wavy_leader(3, 60, torch.float32),
        start_of((3,), torch.float32),
        DT,
    )
    assert single.speed.dtype == torch.float32
    # Thresholds amplify the last bit for a while; over six seconds it stays far below measurement
    # noise.
    assert (single.speed.double() - double.speed).abs().max() < 0.1


def test_collisions_are_reported_and_the_drive_goes_on() -> None:
    leader = Leader(
        *(torch.tensor([x], dtype=torch.float64).expand(1, 30) for x in (12.0, 0.0, 0.0)),
        torch.tensor([5.0]).double(),
    )
    zero = torch.zeros(1, dtype=torch.float64)
    out = simulate_follower(IDM(), None, leader, Start(zero, zero + 20.0, zero), DT)
    assert not out.collided[0, 0]
    assert out.collided[0, -1]
    assert torch.equal(out.collided, out.gap < 0)
    assert out.gap.min() < 0
    assert out.speed.isfinite().all()


@each_model
def test_nan_parameters_do_not_reach_the_neighbours(model: DrivingModel) -> None:
    p, leader = candidates(model, 3), wavy_leader(3, 30)
    clean = simulate_follower(model, p, leader, start_of((3,)), DT)
    p[1] = torch.nan
    out = simulate_follower(model, p, leader, start_of((3,)), DT)
    assert_same(Trajectory(*(x[[0, 2]] for x in out)), Trajectory(*(x[[0, 2]] for x in clean)))


def test_a_recording_of_one_frame_is_its_start() -> None:
    out = simulate_follower(Krauss(), None, wavy_leader(2, 1), start_of((2,)), DT)
    assert out.speed.tolist() == [[8.0], [8.0]]


def test_gradients_flow_through_the_drive() -> None:
    model, leader = Krauss(), wavy_leader(2, 12)

    near = start_of((2,))._replace(position=leader.position[:, 0] - 12.0)

    def final(p: Tensor) -> Tensor:
        return simulate_follower(model, p, leader, near, DT, window=4).speed

    p = (
        torch.tensor([[0.8, 0.2], [1.2, 0.1], [2.0, 0.4]], dtype=torch.float64)
        .expand(2, 3, 2)
        .clone()
        .requires_grad_()
    )
    assert torch.autograd.gradcheck(final, (p,))
    assert torch.autograd.grad(final(p).sum(), p)[0].abs().sum() > 0


@pytest.mark.parametrize("model", [W99(), IDM()], ids=lambda model: type(model).__name__)
def test_gradients_stay_finite_through_standstill_and_contact(model: DrivingModel) -> None:
    leader = Leader(*(x[:, None] for x in wavy_leader(3, 50)))
    zero = torch.zeros((3, 4), dtype=torch.float64)
    gaps = torch.tensor([-2.0, 0.0, 0.5, 20.0], dtype=torch.float64)
    start = Start(
        leader.position[..., 0] - 5.0 - gaps, zero + torch.tensor([0.0, 0.0, 3.0, 12.0]), zero
    )
    p = candidates(model, 3, 4).requires_grad_()
    speed = simulate_follower(model, p, leader, start, DT).speed
    assert torch.autograd.grad(speed.square().sum(), p)[0].isfinite().all()


@each_model
@pytest.mark.parametrize("batch", [(7,), (1, 5), (5, 1), (3, 11), (2, 3, 4), ()], ids=str)
def test_shards_change_nothing(
    model: DrivingModel, batch: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    leader = wavy_leader(batch[0] if batch else 1, 13)
    sensitivity = (..., *[None] * (len(batch) - 1), slice(None))
    leader = Leader(
        *(x[sensitivity] if batch else x[0] for x in leader[:3]),
        leader.length[sensitivity[:-1]] if batch else leader.length[0],
    )
    p = candidates(model, *batch)
    whole = simulate_follower(model, p, leader, start_of(batch), DT)
    monkeypatch.setattr(rollout, "shard_size", lambda speed: 4)
    in_shards = simulate_follower(model, p, leader, start_of(batch), DT)
    assert all(torch.equal(a, b) for a, b in zip(whole, in_shards, strict=True))


class Remembers(Krauss):
    """Its memory counts the steps."""

    memory_size = 2

    def next_memory(self, follower, leader, p, dt, speed):  # type: ignore[no-untyped-def]  # as in the base class
        return follower.memory + torch.stack([torch.ones_like(speed), speed], dim=-1)


def test_memory_is_carried_through_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    stepper, leader = MemoryStepper(Remembers(), DT), wavy_leader(3, 8)
    monkeypatch.setattr(rollout, "shard_size", lambda speed: 4)
    in_time = Leader(*(x.T[:, :, None] for x in leader[:3]), leader.length[:, None])
    p = Krauss().space.unpack(candidates(Krauss(), 3, 5))
    end, _, speed = stepper.advance(stepper.begin(start_of((3, 5))), in_time, p)
    torch.testing.assert_close(
        end.memory,
        torch.stack([torch.full((3, 5), 8.0, dtype=torch.float64), speed.sum(0)], dim=-1),
    )


@pytest.fixture
def fresh_compiler() -> Iterator[None]:
    if not can_compile(torch.device("cpu")):
        pytest.skip("there is no C++ compiler here")
    torch.compiler.reset()
    torch._dynamo.utils.counters.clear()
    rollout._COMPILED.clear()
    yield
    torch.compiler.reset()
    rollout._COMPILED.clear()


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_compiler")
def test_compiled_equals_eager_and_shapes_do_not_recompile(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Krauss()
    monkeypatch.setattr(rollout, "shard_size", lambda speed: 64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # PyTorch's advice to take a newer Python than 3.13.0.
        warnings.filterwarnings("ignore", "Guards may run slower", RuntimeWarning)
        # The shapes of a job: windows of many candidates, one candidate for each window, last
        # shards, whole drives.
        for batch, frames in (
            ((16, 128), 6),
            ((300, 1), 6),
            ((7, 128), 6),
            ((1, 99), 6),
            ((300,), 8),
            ((3, 40), 24),
            ((1,), 6),
        ):
            leader, p = wavy_leader(batch[0], frames), candidates(model, *batch)
            if len(batch) == 2:
                leader = Leader(*(x[:, None] for x in leader))
            eager = simulate_follower(model, p, leader, start_of(batch), DT, compile="never")
            compiled = simulate_follower(Krauss(), p, leader, start_of(batch), DT, compile="always")
            assert_same(eager, compiled)
    assert len(rollout._COMPILED) == 2, (
        "one function for a block of five steps, one for the steps left over"
    )
    counters = torch._dynamo.utils.counters
    assert counters["stats"]["unique_graphs"] == 2, "a job's shapes must share their compiled code"


def test_gradients_bypass_the_compiler() -> None:
    p = candidates(Krauss(), 2).requires_grad_()
    out = simulate_follower(Krauss(), p, wavy_leader(2, 8), start_of((2,)), DT, compile="always")
    assert out.speed.requires_grad
    assert not rollout._COMPILED


def test_without_pythons_headers_nothing_is_compiled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Debian's Python has none unless python3-dev is installed."""
    monkeypatch.setattr(rollout, "find_compiler", lambda: "/usr/bin/g++")
    monkeypatch.setattr(rollout.sysconfig, "get_path", lambda name: str(tmp_path))
    assert not can_compile(torch.device("cpu"))
    (tmp_path / "Python.h").touch()
    assert can_compile(torch.device("cpu"))


def test_without_a_compiler_it_runs_eagerly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "find_compiler", lambda: None)
    assert not can_compile(torch.device("cpu"))
    out = simulate_follower(Krauss(), None, wavy_leader(2, 8), start_of((2,)), DT, compile="always")
    assert_same(
        out,
        simulate_follower(Krauss(), None, wavy_leader(2, 8), start_of((2,)), DT, compile="never"),
    )
    assert not rollout._COMPILED


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device here")
@each_model
def test_cuda_agrees_with_the_cpu(model: DrivingModel) -> None:
    leader, p = wavy_leader(3, 60), candidates(model, 3)
    cpu = simulate_follower(model, p, leader, start_of((3,)), DT)
    cuda = simulate_follower(
        model, p.cuda(), wavy_leader(3, 60, device="cuda"), start_of((3,), device="cuda"), DT
    )
    assert cuda.speed.device.type == "cuda"
    torch.testing.assert_close(cuda.speed.cpu(), cpu.speed, rtol=0, atol=1e-6)


@pytest.mark.parametrize("parameters", [{"cc4": 0.5}, {"b_max": 25.0}])
def test_parameters_outside_their_bounds_are_refused_unless_asked_for(
    parameters: dict[str, float],
) -> None:
    """There W99 departs from SUMO: its signs mean something else."""
    position = torch.linspace(30.0, 60.0, 31, dtype=torch.float64)
    speed = torch.full_like(position, 10.0)
    leader = Leader(position, speed, speed * 0, torch.tensor(4.5))
    start = Start(*(torch.tensor(value, dtype=torch.float64) for value in (0.0, 10.0, 0.0)))
    with pytest.raises(ParameterError, match="is outside its bounds"):
        simulate_follower(W99(), parameters, leader, start, 0.1)
    allowed = simulate_follower(W99(), parameters, leader, start, 0.1, outside="allow")
    assert bool(allowed.speed.isfinite().all())
    values = W99().space.defaults(dtype=torch.float64)
    values[4] = 0.5
    outside = r"cc4=0\.5 is outside its bounds, -2 to -0\.01 m/s"
    for of_drivers in (values, torch.stack([values, values])):
        with pytest.raises(ParameterError, match=outside):
            simulate_follower(W99(), of_drivers, leader, start, 0.1)
    bounds = W99().space.bounds(dtype=torch.float64)
    for edge in bounds:
        simulate_follower(W99(), edge, leader, start, 0.1)
