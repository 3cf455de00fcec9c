from __future__ import annotations

import copy
import math
from collections.abc import Generator, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cfx.calibration.botorch import BotorchOptimizer
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.gradient_search import GradientSearch
from cfx.calibration.huber import SpeedHuber
from cfx.calibration.mixed import Mixed
from cfx.calibration.objectives import Objective
from cfx.calibration.optimizers import CandidateLosses, Optimizer
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.rmse import GapRmse, SpeedRmse
from cfx.calibration.shade import ShadeSearch
from cfx.calibration.shards import CalibrationShard, Solver
from cfx.calibration.theil_u import TheilInequality
from cfx.core import threads
from cfx.core.engine import Engine, Report
from cfx.data.pairs import PairBatch, PairSet
from cfx.errors import ConfigError, OutputError
from cfx.models.base import DrivingModel
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.windows import Windows, WindowSettings
from tests.drives import straight_pairs, wavy_pairs

SETTINGS = WindowSettings()
TRUE = torch.tensor([[1.2, 0.1], [2.0, 0.4], [3.0, 0.8]], dtype=torch.float64)


# Only what a trajectory excites can be found: the gap kept, not thresholds that were never crossed.
QUIET_W99 = W99(
    parameters={name: {"tuned": False} for name in ("cc3", "cc4", "cc5", "cc6", "cc7", "cc9")}
)
QUIET_TRUE = torch.tensor([[2.0, 1.0, 6.0, 2.0], [3.0, 1.5, 4.0, 3.0]], dtype=torch.float64)


class Counting(RandomSearch):
    """Counts the problems it is given, and may be interrupted."""

    def __init__(self, samples: int = 64, stop_after: int = 10**9) -> None:
        super().__init__(samples=samples)
        self.solved = 0
        self.stop_after = stop_after

    def solve(
        self, objective: CandidateLosses, guesses: Tensor, *, seed: int
    ) -> tuple[Tensor, Tensor]:
        if self.solved + len(guesses) > self.stop_after:
            raise KeyboardInterrupt
        self.solved += len(guesses)
        return super().solve(objective, guesses, seed=seed)


def calibrator(
    optimizer: Optimizer,
    folder: Path | None = None,
    model: DrivingModel | None = None,
    **changes: Any,
) -> Calibrator:
    of_solver: dict[str, Any] = {"seed": 0, "memory": 1 << 28}
    for name in ("seed", "memory", "objective", "prior", "pooled_segment_s"):
        if name in changes:
            of_solver[name] = changes.pop(name)
    solver = Solver(MemoryStepper(model or Krauss(), 0.1), optimizer, **of_solver)
    return Calibrator(solver, cache=Cache(folder), **changes)


def everything(tool: Calibrator, pairs: PairSet) -> tuple[Tensor, Tensor]:
    batch = PairBatch.of(pairs)
    last = torch.full((len(pairs),), 200)
    fixed = tool.driver_specific(pairs, batch, last)
    windows = Windows.of(torch.full((len(pairs),), 40), SETTINGS)
    return fixed, tool.labels(pairs, batch, windows, fixed).parameters


@pytest.mark.parametrize(
    ("model", "true", "tolerance"),
    [
        # The brake build-up time acts only while the leader brakes: it is found, but less sharply.
        (Krauss(), TRUE, {"t_r": 0.01, "t_i": 0.1}),
        (QUIET_W99, QUIET_TRUE, {"cc1": 0.04}),
    ],
    ids=["krauss", "w99"],
)
def test_constant_true_parameters_are_recovered(
    model: DrivingModel, true: Tensor, tolerance: dict[str, float]
) -> None:
    pairs = wavy_pairs(model, true, frames=400)
    tool = calibrator(RandomSearch(samples=4096), model=model)
    fixed = tool.driver_specific(pairs, PairBatch.of(pairs), torch.full((len(pairs),), 320))
    low, high = model.space.bounds()
    error = dict(
        zip(model.space.names, ((fixed - true).abs() / (high - low)).amax(0).tolist(), strict=True)
    )
    assert all(error[name] < limit for name, limit in tolerance.items()), error


def test_ends_are_not_apart_where_drivers_are_followed_exactly() -> None:
    pairs, last = wavy_pairs(Krauss(), TRUE, frames=400), torch.full((3,), 390)
    tool = calibrator(ShadeSearch())
    batch = PairBatch.of(pairs)
    found = tool.driver_specific(pairs, batch, last)
    assert float((found[:, 0] - TRUE[:, 0]).abs().max()) < 1e-3
    assert max(tool.apart(pairs, last)) < 0.01


def test_pooled_parameters_are_those_of_segments_of_the_length_that_is_asked(
    tmp_path: Path,
) -> None:
    # What a noisy speed says of t_r depends on how long an error may grow.
    pairs = wavy_pairs(Krauss(), TRUE, frames=300)
    batch, last = PairBatch.of(pairs), torch.full((len(pairs),), 240)
    noise = torch.randn(batch.follower_speed.shape, generator=torch.Generator().manual_seed(0))
    batch = replace(batch, follower_speed=(batch.follower_speed + 0.5 * noise).clamp(min=0.0))
    members = torch.ones((1, len(pairs)), dtype=torch.bool)
    found = {}
    for length in (None, 24.0, 5.0, 0.5):
        tool = calibrator(RandomSearch(samples=256), tmp_path, pooled_segment_s=length)
        found[length] = tool.pooled(pairs, batch, last, members)
    assert torch.equal(found[24.0], found[None])  # they last 24 s
    assert not torch.equal(found[5.0], found[None])
    assert not torch.equal(found[0.5], found[5.0])
    tool = calibrator(RandomSearch(samples=256), pooled_segment_s=0.04)
    with pytest.raises(ConfigError, match="shorter than the time step"):
        tool.pooled(pairs, batch, last, members)


def test_labels_follow_a_driver_who_changes() -> None:
    model = Krauss()
    first, second = (
        wavy_pairs(model, torch.tensor([[t_r, 0.1]], dtype=torch.float64), seed=3)
        for t_r in (1.0, 2.5)
    )
    pairs = PairSet((first[0], replace(second[0], pair_id="p1")), "test")
    batch = PairBatch.of(pairs)
    windows = Windows.of(torch.tensor([40, 40]), SETTINGS)
    labels = calibrator(RandomSearch(samples=1024)).labels(
        pairs, batch, windows, torch.tensor([[1.7, 0.1], [1.7, 0.1]]).double()
    )
    sensitive = labels.sensitivity > labels.sensitivity.median()
    medians = [
        float(labels.parameters[(windows.pair == p) & sensitive, 0].median()) for p in (0, 1)
    ]
    assert medians[0] == pytest.approx(1.0, abs=0.3)
    assert medians[1] == pytest.approx(2.5, abs=0.3)
    assert float(labels.loss.max()) < 0.05 + SpeedRmse.tie_tolerance


def test_windows_that_determine_nothing_get_the_fixed_parameters() -> None:
    """Far behind its leader every candidate gives the same speed: the maximum speed."""
    model = Krauss(parameters={"v_max": {"default": 10.0}})
    pairs = straight_pairs([100])
    far = replace(pairs[0], leader_position=pairs[0].leader_position + 1e5)
    pairs = PairSet((far,), "test")
    fixed = torch.tensor([[2.345, 0.678]], dtype=torch.float64)
    windows = Windows.of(torch.tensor([10]), SETTINGS)
    labels = calibrator(RandomSearch(samples=256), model=model).labels(
        pairs, PairBatch.of(pairs), windows, fixed
    )
    torch.testing.assert_close(labels.parameters, fixed.expand(10, 2))
    assert float(labels.sensitivity.max()) == 0


def test_the_second_time_nothing_is_calibrated_again(tmp_path: Path) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    first = Counting()
    before = everything(calibrator(first, tmp_path), pairs)
    assert first.solved == 3 + 120
    second = Counting()
    after = everything(calibrator(second, tmp_path), pairs)
    assert second.solved == 0
    for one, two in zip(before, after, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize(
    ("model", "changes", "samples"),
    [
        (Krauss(parameters={"t_r": {"high": 6.0}}), {}, 64),
        (Krauss(parameters={"b": {"default": 3.0}}), {}, 64),
        (Krauss(), {"seed": 1}, 64),
        (Krauss(), {}, 65),
        (Krauss(variant="sumo"), {}, 64),
        (Krauss(), {"objective": GapRmse()}, 64),
        (Krauss(), {"objective": SpeedHuber(delta=2.0)}, 64),
    ],
    ids=["bounds", "constant", "seed", "optimizer", "settings", "objective", "its settings"],
)
def test_whatever_matters_makes_a_new_entry(
    tmp_path: Path, model: DrivingModel, changes: dict[str, object], samples: int
) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    everything(calibrator(Counting(), tmp_path, objective=SpeedRmse()), pairs)
    everything(calibrator(Counting(), tmp_path, objective=SpeedHuber(delta=1.0)), pairs)
    again = Counting(samples)
    everything(calibrator(again, tmp_path, model, **changes), pairs)
    assert again.solved == 123


def test_other_data_is_not_mistaken(tmp_path: Path) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    everything(calibrator(Counting(), tmp_path), pairs)
    nudged = replace(pairs[1], follower_speed=pairs[1].follower_speed + 1e-9)
    again = Counting()
    everything(calibrator(again, tmp_path), PairSet((pairs[0], nudged, pairs[2]), "test"))
    assert again.solved == 1 + 40


def test_an_interrupted_calibration_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cfx.calibration.calibrator._CLAIM", 40)
    monkeypatch.setattr("cfx.calibration.calibrator._WINDOWS_OF_ENTRY", 40)
    pairs = wavy_pairs(Krauss(), TRUE)
    whole = everything(calibrator(Counting()), pairs)
    interrupted = Counting(stop_after=3 + 80)
    with pytest.raises(KeyboardInterrupt):
        everything(calibrator(interrupted, tmp_path), pairs)
    rest = Counting()
    resumed = everything(calibrator(rest, tmp_path), pairs)
    assert rest.solved == 40
    for one, two in zip(whole, resumed, strict=True):
        assert torch.equal(one, two)


def test_labels_of_more_windows_of_the_same_drivers_begin_with_those_that_are_known(
    tmp_path: Path,
) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    batch = PairBatch.of(pairs)
    fixed = Krauss().space.defaults().expand(3, -1)
    few = Windows.of(torch.tensor([34, 33, 32]), SETTINGS)
    many = Windows.of(torch.tensor([40, 40, 40]), SETTINGS)
    known = calibrator(Counting(), tmp_path).labels(pairs, batch, few, fixed)
    optimizer = Counting()
    found = calibrator(optimizer, tmp_path).labels(pairs, batch, many, fixed)
    # The first 32 windows of each are there; the eight that follow are calibrated.
    assert optimizer.solved == 3 * 8
    whole = calibrator(Counting()).labels(pairs, batch, many, fixed)
    assert torch.equal(found.parameters, whole.parameters)
    assert torch.equal(found.loss, whole.loss)
    first = [0, 31, 34, 65, 67, 98]
    assert torch.equal(known.loss[first], found.loss[[0, 31, 40, 71, 80, 111]])


def test_a_damaged_entry_is_computed_again(tmp_path: Path) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    everything(calibrator(Counting(), tmp_path), pairs)
    entries = sorted(tmp_path.rglob("*.entry"))
    assert len(entries) == 9  # a driver's parameters, and two blocks of labels
    entries[0].write_bytes(entries[0].read_bytes()[:50])
    entries[1].write_bytes(b"")
    np.savez(entries[2], parameters=np.array([object()], dtype=object), allow_pickle=True)
    # Whole archives of something else: one without the mark, one whose content was changed.
    with entries[3].open("wb") as file:
        np.savez(file, parameters=np.full((9, 9), np.nan))
    flipped = bytearray(entries[4].read_bytes())
    flipped[-200] ^= 1
    entries[4].write_bytes(bytes(flipped))
    again = Counting()
    everything(calibrator(again, tmp_path), pairs)
    assert again.solved > 0
    assert sorted(tmp_path.rglob("*.entry")) == entries  # no partial file is left beside them


def test_a_cache_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OutputError, match=r"cannot write the calibration cache.*cache\.enabled=false"
    ):
        everything(calibrator(Counting(), tmp_path / "file"), wavy_pairs(Krauss(), TRUE))


def test_constant_drivers_of_the_synthetic_dataset_are_recovered() -> None:
    pairs = SyntheticDataset(variation=0.0, pairs=6, frames=500, seed=3).load()
    tool = calibrator(GradientSearch())
    fixed = tool.driver_specific(pairs, PairBatch.of(pairs), torch.full((len(pairs),), 400))
    true = torch.tensor(
        [[pair.truth[name][0] for name in tool.space.names] for pair in pairs], dtype=torch.float64
    )
    low, high = tool.space.bounds()
    error = dict(
        zip(tool.space.names, ((fixed - true).abs() / (high - low)).amax(0).tolist(), strict=True)
    )
    assert error["t_r"] < 0.01, error
    assert error["t_i"] < 0.15, error


@pytest.mark.parametrize("objective", [GapRmse(), Mixed(), TheilInequality(), SpeedHuber()])
def test_every_objective_finds_what_determines_it(objective: Objective) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    tool = calibrator(RandomSearch(samples=1024), objective=objective)
    fixed, labels = everything(tool, pairs)
    assert fixed[:, 0].tolist() == pytest.approx(TRUE[:, 0].tolist(), abs=0.1)
    assert bool(labels.isfinite().all())


def test_a_calibration_reports_other_objectives_too() -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    batch = PairBatch.of(pairs)
    last = torch.tensor([150, 200, 250])
    tool = calibrator(RandomSearch(samples=64), reported={"speed": SpeedRmse(), "gap": GapRmse()})
    perfect = tool.losses(batch, last, TRUE)
    assert perfect == pytest.approx({"speed": 0.0, "gap": 0.0}, abs=1e-9)
    pooled = TRUE[:1]
    members = torch.tensor([[True, False, True]])
    found = tool.losses(batch, last, pooled, members)
    each = tool.losses(batch, last, pooled.expand(3, -1))
    alone = []
    for p in (0, 2):
        alone.append(tool.losses(batch[p : p + 1], last[p : p + 1], pooled)["gap"])
    assert found["gap"] == pytest.approx(sum(alone) / 2)
    assert 0 < found["speed"] < each["speed"] * 3
    # One pair at a time gives the same.
    tool.memory = 1
    assert tool.losses(batch, last, pooled, members) == pytest.approx(found)


def test_ties_have_the_objectives_tolerance_unless_a_setting_says_another() -> None:
    tool = calibrator(RandomSearch(samples=8), objective=TheilInequality())
    assert tool.tie_tolerance(WindowSettings()) == TheilInequality.tie_tolerance
    assert tool.tie_tolerance(WindowSettings(tie_tolerance=0.0)) == 0.0


@pytest.mark.parametrize("samples", [2048, 1 << 18], ids=["kernel", "a shard for each driver"])
def test_the_number_of_cores_changes_no_bit(samples: int, request: pytest.FixtureRequest) -> None:
    request.addfinalizer(lambda: threads.limit_cores(None))
    pairs = wavy_pairs(Krauss(), TRUE, frames=60)
    batch = PairBatch.of(pairs)
    tool = calibrator(RandomSearch(samples=samples))
    threads.limit_cores(1)
    alone = tool.driver_specific(pairs, batch, batch.lengths - 1)
    threads.limit_cores(None)
    assert torch.equal(tool.driver_specific(pairs, batch, batch.lengths - 1), alone)


class Elsewhere(Engine):
    """Works as a cluster would whose workers are processes of their own."""

    distributes = True

    def __init__(self) -> None:
        super().__init__()
        self.shards: list[CalibrationShard] = []

    def map(
        self, work: Any, shards: Iterable[Any], report: Report, *, shares_cores: bool = True
    ) -> Generator[tuple[int, Any], None, None]:
        for number, one in enumerate(shards):
            self.shards.append(one)
            yield number, work(copy.deepcopy(one), report)


@pytest.mark.parametrize(
    "optimizer",
    [
        RandomSearch(samples=512),
        GradientSearch(),
        BotorchOptimizer(screening=16, initial=4, iterations=1),
    ],
    ids=["random", "gradient", "botorch"],
)
def test_a_cluster_shares_drivers_among_its_workers_and_changes_no_bit(
    optimizer: Optimizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small parts would not be worth compiling for; all of them together are."""
    monkeypatch.setattr("cfx.calibration.calibrator._TRAJECTORIES_OF_SHARD", 2)
    drivers = torch.stack([torch.linspace(1.0, 2.5, 5), torch.linspace(0.0, 0.6, 5)], dim=1)
    pairs = wavy_pairs(Krauss(), drivers.double(), frames=150)
    batch, elsewhere = PairBatch.of(pairs), Elsewhere()
    last = torch.tensor([149, 120, 149, 90, 60])
    members = torch.tensor([[True] * 5, [True, False, True, True, False]])
    here = calibrator(optimizer)
    there = calibrator(optimizer, engine=elsewhere)
    expected = here.driver_specific(pairs, batch, last)
    assert torch.equal(there.driver_specific(pairs, batch, last), expected)
    assert [len(shard.batch) for shard in elsewhere.shards] == [2, 2, 1]
    elsewhere.shards.clear()
    expected = here.pooled(pairs, batch, last, members)
    assert torch.equal(there.pooled(pairs, batch, last, members), expected)
    assert len(elsewhere.shards) == 1, "what is simulated for one group serves all"


class Torn(RandomSearch):
    """Says that its last two points are ends of independent searches."""

    def ends(self, n: int) -> int:
        return 2


def test_drivers_whose_ends_differ_are_counted_and_named(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    pairs = wavy_pairs(Krauss(), TRUE)
    batch, last = PairBatch.of(pairs), torch.full((len(pairs),), 200)
    settled, torn = calibrator(RandomSearch(samples=64)), calibrator(Torn(samples=64), tmp_path)
    settled.driver_specific(pairs, batch, last)
    assert all(math.isnan(share) for share in settled.apart(pairs, last))
    assert not caplog.messages
    torn.driver_specific(pairs, batch, last)
    apart = torn.apart(pairs, last)
    assert min(apart) > 0.01
    assert [message[:46] for message in caplog.messages] == [
        "The optimum of 3 of 3 pairs may have been miss"
    ]
    assert all(pair.pair_id in caplog.text for pair in pairs)
    # Another process that finds the entries says the same.
    again = calibrator(Torn(samples=64), tmp_path)
    again.driver_specific(pairs, batch, last)
    assert again.apart(pairs, last) == apart
