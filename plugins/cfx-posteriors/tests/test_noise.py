"""Where noise enters: what predictions are, what is evident, and what intervals then hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cfx
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.settings import CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch
from cfx.errors import ConfigError
from cfx.models.idm import IDM
from cfx.simulation.rollout import MemoryStepper
from cfx_posteriors.intervals import LaplaceMethod, SbiMethod, choose_noise
from cfx_posteriors.laplace import laplace, likely_starts
from cfx_posteriors.noise import NOISE_KINDS, noise_kind

from .benchmarks.simulated_drivers import simulate
from .recordings import draw_recordings

NOWHERE = Path("no recording: leaders are made up")


def simulated(noise: str, drivers: int = 8) -> tuple[Solver, PairBatch]:
    recordings, _ = simulate("idm", noise, drivers, 40.0, seed=3, recording=NOWHERE)
    pairs = cfx.read(recordings, min_duration=0, check="off").selected
    batch = PairBatch.of(pairs, dtype=torch.float64)
    return Solver(MemoryStepper(IDM(), batch.dt), RandomSearch(), seed=0), batch


@pytest.mark.parametrize("noise", ["trajectory", "measurement", "acceleration"])
def test_the_noise_that_drivers_were_simulated_with_is_the_most_evident(noise: str) -> None:
    solver, batch = simulated(noise)
    best = IDM().space.defaults().double().expand(len(batch), -1)
    settings = CalibrationSettings(posterior="laplace")
    chosen = choose_noise(solver, batch, batch.lengths - 1, best, settings)
    assert chosen.name == noise
    table = chosen.table([str(number) for number in range(len(batch))])
    assert len(table) == len(NOISE_KINDS) * len(batch)
    assert table.loc[table["chosen"], "noise"].unique().tolist() == [noise]


@pytest.mark.parametrize("kind", NOISE_KINDS)
def test_the_compiled_kernel_predicts_as_steps_do(kind: str) -> None:
    drawn = draw_recordings(IDM(), 3, frames=120)
    posterior = replace(drawn.posterior, kind=noise_kind(kind, 1))
    generator = torch.Generator().manual_seed(0)
    place = torch.randn((3, 4, posterior.dimensions), generator=generator, dtype=torch.float64)
    stepwise = posterior._predicted(place)
    errors = torch.where(posterior.counted > 0, stepwise, 0.0)
    torch.testing.assert_close(posterior.errors(place), errors, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", NOISE_KINDS)
def test_slopes_of_the_density_are_its_differences(kind: str) -> None:
    drawn = draw_recordings(IDM(), 2, frames=200)
    posterior = replace(drawn.posterior, kind=noise_kind(kind, 1))
    place = laplace(posterior, likely_starts(posterior, seed=0)).mode[:, None, :-1] + 0.1
    value, slope = posterior.with_slope(place)
    assert bool(value.isfinite().all())
    for column in range(place.shape[-1]):
        shift = 1e-4 * torch.eye(place.shape[-1], dtype=torch.float64)[column]
        high, low = (posterior.with_slope(place + sign * shift)[0] for sign in (1.0, -1.0))
        torch.testing.assert_close(slope[..., column], (high - low) / 2e-4, rtol=2e-2, atol=2e-2)


def test_errors_that_never_come_back_are_no_noise_of_the_measurement() -> None:
    """Under noise of the acceleration a closed loop is too sure, predictions from states are not."""
    recordings, truth = simulate("idm", "acceleration", 24, 60.0, seed=7, recording=NOWHERE)
    pairs = cfx.read(recordings, min_duration=0, check="off").selected
    batch = PairBatch.of(pairs, dtype=torch.float64)
    solver = Solver(MemoryStepper(IDM(), batch.dt), RandomSearch(), seed=0)
    best = IDM().space.defaults().double().expand(len(batch), -1)
    held = {}
    for noise in ("trajectory", "chosen"):
        settings = CalibrationSettings(posterior="laplace", noise=noise)
        intervals = LaplaceMethod().find(solver, batch, batch.lengths - 1, best, settings)
        value = torch.tensor(truth[list(intervals.names)].to_numpy())
        held[noise] = float(((intervals.low <= value) & (value <= intervals.high)).double().mean())
    assert held["trajectory"] < 0.84
    assert 0.85 < held["chosen"] < 0.97


def test_networks_learn_from_closed_loops_alone() -> None:
    pytest.importorskip("sbi")
    solver, batch = simulated("trajectory", 1)
    best = IDM().space.defaults().double()[None]
    settings = CalibrationSettings(posterior="sbi", noise="both")
    with pytest.raises(ConfigError, match=r"set calibration\.noise=trajectory"):
        SbiMethod().find(solver, batch, batch.lengths - 1, best, settings)


def test_white_noise_has_no_order() -> None:
    with pytest.raises(ValueError, match=r"noise_order=2: calibration\.noise=measurement is"):
        CalibrationSettings(posterior="laplace", noise="measurement", noise_order=2)
