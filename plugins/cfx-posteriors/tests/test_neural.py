"""Samples by a network: they are the posterior, or it is said that they are not."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pandas as pd
import pytest
import torch
from rich.text import Text

import cfx
from cfx.calibration.posterior import posterior_method
from cfx.errors import NotInstalledError
from cfx.models.krauss import Krauss
from cfx.results.tables.known_parameters import KnownParameters
from cfx_posteriors.importance import sample
from cfx_posteriors.laplace import laplace, likely_starts
from tests.test_job_posterior import QUICK

from .recordings import draw_recordings

pytest.importorskip("sbi", reason="sbi is not here; pip install 'cfx-posteriors[sbi]'")

from cfx_posteriors import neural

SHARES = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)


@pytest.mark.slow
def test_samples_are_the_posterior() -> None:
    posterior = draw_recordings(Krauss(), 2, frames=300).posterior
    learned = neural.learn(posterior, SHARES, seed=0, memory=1 << 30)
    assert float(learned.pareto_k.max()) < 0.7
    assert 0.8 < float(learned.coverage[0]) < 0.97
    normal = laplace(posterior, likely_starts(posterior, 0))
    weighted = sample(posterior, normal, SHARES, seed=0, memory=1 << 30)
    width = weighted.quantiles[:, 2:] - weighted.quantiles[:, :1]
    apart = (learned.quantiles - weighted.quantiles) / width
    assert float(apart.abs().max()) < 0.15
    assert float((posterior(learned.likeliest[:, None])[:, 0] - normal.log_density).min()) > -0.5


def test_a_round_knows_the_density_of_what_it_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of its samples, the mean of one part's share of the density is that part's share of them."""
    monkeypatch.setattr(neural, "EPOCHS", 1)
    posterior = draw_recordings(Krauss(), 2, frames=100).posterior
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        generator = torch.Generator().manual_seed(0)
        region = neural._first_region(posterior, 0, 1 << 30)
        one = neural._learn_round(posterior, region, [], generator, 1 << 30)
        drawn = one.draw(generator)
        share = one.region.tails.log_density(drawn) - one.log_density(drawn)
    places = drawn.shape[1]
    assert places == 800
    wanted = torch.full((2,), 200 / 800, dtype=torch.float64)
    torch.testing.assert_close(share.exp().mean(1), wanted, atol=0.02, rtol=0)


def test_recordings_do_not_depend_on_how_many_are_simulated_at_once() -> None:
    posterior = draw_recordings(Krauss(), 3, frames=100).posterior
    region = neural._first_region(posterior, 0, 1 << 30)
    parts = []
    for drivers in ([[0, 1, 2]], [[0], [1, 2]]):
        generator = torch.Generator().manual_seed(0)
        recordings = []
        for some in map(torch.tensor, drivers):
            cut = neural._Region(*(values[some] for values in region))
            recordings.append(neural._recordings(posterior.take(some), cut, 20, generator))
        parts.append([torch.cat(values) for values in zip(*recordings, strict=True)])
    for one, other in zip(*parts, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_a_network_that_has_learned_too_little_is_named() -> None:
    fits = {
        "pair_id": ["a", "b"],
        "method": "driver_specific",
        "noise_scale": 0.1,
        "noise_left": 0.0,
    }
    own = {"pareto_k": [0.3, 0.8], "effective_samples": 500.0, "expected_coverage": 0.7}
    known = KnownParameters(pd.DataFrame({**fits, **own}), ())
    assert known.metrics()["posterior/expected_coverage"] == 0.7
    said = [str(one) for one in known.printed() if isinstance(one, Text)]
    assert said[0].endswith("such intervals are the network's alone.")
    assert said[1].startswith("Intervals of the network alone hold 70% of simulated drivers'")


def test_without_sbi_it_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(NotInstalledError, match=r"needs sbi, .* install .*cfx-posteriors\[sbi\]"):
        posterior_method("sbi")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["laplace", "sbi"])
def test_sumo_in_the_loop(way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The posterior of a model that SUMO drives is that of its equations."""
    pytest.importorskip("libsumo", reason="SUMO is not here; pip install 'cfx-driving[sumo]'")
    pytest.importorskip("cfx_sumo", reason="its simulator drives them too")
    monkeypatch.chdir(tmp_path)
    for setting, value in {"FIRST": 100, "ROUNDS": 1, "EPOCHS": 1, "SIMULATIONS": 1}.items():
        monkeypatch.setattr(neural, setting, value)
    asked = [*QUICK, "model=krauss_sumo", "data.pairs=1", f"calibration.posterior={way}"]
    fits_of = {}
    for simulator in ("sumo", "memory"):
        cfx.run([*asked, f"simulator={simulator}", f"hydra.run.dir={simulator}"])
        fits = pd.read_parquet(f"{simulator}/fits.parquet")
        fits_of[simulator] = fits[fits["method"] == "driver_specific"].set_index("pair_id")
    medians = [f"median_{name}" for name in ("tau", "accel", "decel", "minGap")]
    pd.testing.assert_frame_equal(fits_of["sumo"][medians], fits_of["memory"][medians], rtol=0.1)
