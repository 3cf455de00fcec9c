"""What every posterior keeps: its columns and tables, its seed, and the process that it works in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cfx.calibration.posterior import posterior_method
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.settings import CalibrationSettings
from cfx.calibration.shards import Solver
from cfx.core import registry
from cfx.models.krauss import Krauss
from cfx.simulation.rollout import MemoryStepper
from cfx_posteriors.intervals import ParameterIntervals

from .recordings import DT, Drawn, draw_recordings

IDS = ["one", "other"]
FRAMES = 200


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    return draw_recordings(Krauss(), len(IDS), frames=FRAMES)


def posteriors_by(name: str, drawn: Drawn) -> ParameterIntervals:
    solver = Solver(MemoryStepper(Krauss(), DT), RandomSearch(), seed=3)
    best = Krauss().space.defaults(dtype=torch.float64).expand(len(IDS), -1)
    last = torch.full((len(IDS),), FRAMES - 1)
    settings = CalibrationSettings(posterior=name)
    posteriors = posterior_method(name).find(solver, drawn.batch, last, best, settings)
    assert isinstance(posteriors, ParameterIntervals)
    return posteriors


SLOW = {"nuts", "sbi"}
"""JAX compiles for seconds, and a network is trained."""
NAMES = [
    pytest.param(entry.name, marks=[pytest.mark.slow] if entry.name in SLOW else [])
    for entry in registry.entries("posterior")
    if entry.distribution == "cfx-posteriors"
]


@pytest.mark.parametrize("name", NAMES)
def test_contract(name: str, drawn: Drawn, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if name == "sbi":
        pytest.importorskip("sbi", reason="sbi is not here; pip install 'cfx-posteriors[sbi]'")
        from cfx_posteriors import neural

        for setting, value in {"FIRST": 100, "ROUNDS": 2, "EPOCHS": 2}.items():
            monkeypatch.setattr(neural, setting, value)
    if name == "nuts":
        from cfx_posteriors import nuts

        for setting, value in {"WARM_UP": 50, "DRAWS": 100}.items():
            monkeypatch.setattr(nuts, setting, value)
    monkeypatch.chdir(tmp_path)
    before = torch.get_rng_state(), torch.get_default_dtype(), np.random.get_state()[1].tolist()  # noqa: NPY002 - others' random numbers
    posteriors = posteriors_by(name, drawn)
    again = posteriors_by(name, drawn)
    after = torch.get_rng_state(), torch.get_default_dtype(), np.random.get_state()[1].tolist()  # noqa: NPY002 - as above
    torch.testing.assert_close(after[0], before[0])
    assert after[1:] == before[1:]
    assert not list(tmp_path.iterdir())

    columns = posteriors.columns()
    for parameter in Krauss().space.names:
        low, middle, high = (columns[f"{kind}_{parameter}"] for kind in ("low", "median", "high"))
        assert (low < middle).all()
        assert (middle < high).all()
        assert (columns[f"contraction_{parameter}"] < 1).all()
    for kind in ("noise_scale", "noise_correlation", "noise_left", "effective_samples"):
        assert np.isfinite(columns[kind]).all()
    assert {"pareto_k", "r_hat"} & columns.keys()
    torch.testing.assert_close(posteriors.draws, again.draws, rtol=0, atol=0)
    tables = posteriors.tables(IDS)
    assert set(tables["posterior"]["pair_id"]) == set(tables["fan"]["pair_id"]) == set(IDS)
    new = tables["population" if posterior_method(name).has_population else "prior"]
    low, high = Krauss().space.bounds()
    for values in (posteriors.draws, torch.tensor(new.to_numpy())):
        assert bool(((values >= low) & (values <= high)).all())
