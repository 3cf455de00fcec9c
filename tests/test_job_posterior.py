"""Jobs with `calibration.posterior`: what they say of parameters, and what they leave as it is."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from rich.text import Text

import cfx
from cfx.errors import PluginError
from cfx.results.tables.known_parameters import KnownParameters
from tests.installer import Installer

QUICK = [
    "debug=quick",
    "policy=fixed",
    "data.pairs=3",
    "data.platoon_size=1",
    "data.frames=400",
    "data.max_pairs=null",
    "figures=none",
    "tracking.enabled=false",
]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("diagnostics", "reason"),
    [
        ({"pareto_k": [0.3, 0.8]}, "samples of these posteriors do not settle (pareto_k above 0.7"),
        ({"r_hat": [1.01, 1.2]}, "chains differ (r_hat above 1.05 in"),
        ({"r_hat": [1.01, 1.2], "divergences": 0.0}, "chains differ or leave out a part"),
        ({"r_hat": 1.0, "divergences": [0.0, 0.1]}, "chains differ or leave out a part"),
    ],
)
def test_intervals_that_are_not_to_be_relied_on_are_named(
    diagnostics: dict[str, float | list[float]], reason: str
) -> None:
    fits = {
        "pair_id": ["a", "b"],
        "method": "driver_specific",
        "noise_scale": 0.1,
        "noise_left": 0.0,
    }
    rows = pd.DataFrame({**fits, **diagnostics, "effective_samples": [60.0, 20.0]})
    known = KnownParameters(rows, ())
    assert known.metrics()["posterior/reliable"] == 0.5
    said = [str(one) for one in known.printed() if isinstance(one, Text)]
    assert said[0].startswith(f"Do not rely on the intervals of 1 of 2 pairs (b): {reason}")
    assert said[1].startswith("The intervals of 1 of 2 pairs rest on fewer than 100 independent")


def test_a_likelihood_that_counts_less_is_said() -> None:
    fits = {"pair_id": ["a"], "method": "driver_specific", "noise_scale": 0.1, "noise_left": 0.0}
    rows = pd.DataFrame({**fits, "pareto_k": [0.3], "effective_samples": [600.0]})

    def said(rows: pd.DataFrame) -> list[str]:
        return [str(one) for one in KnownParameters(rows, ()).printed() if isinstance(one, Text)]

    assert said(rows) == []
    (sentence,) = said(rows.assign(likelihood_power=0.5))
    assert sentence.startswith("Each step counts 0.5 times (likelihood_power):")


CERTAIN = """
import numpy as np
from cfx.calibration.posterior import DriverPosteriors, PosteriorMethod


class Certain(DriverPosteriors):
    def __init__(self, names, best):
        self.names, self.best, self.draws = names, best, best[:, None]

    def columns(self):
        found = dict.fromkeys(
            ("noise_scale", "noise_correlation", "noise_left", "effective_samples", "pareto_k"),
            np.zeros(len(self.best)),
        )
        for number, name in enumerate(self.names):
            for kind in ("low", "median", "high"):
                found[f"{kind}_{name}"] = self.best[:, number].numpy()
            found[f"contraction_{name}"] = np.ones(len(self.best))
        return found

    def tables(self, ids):
        return {}

    def draw_drivers(self, count, seed):
        return self.best[:1].expand(count, -1)


class CertainMethod(PosteriorMethod):
    def find(self, solver, batch, last, best, settings):
        return Certain(solver.space.names, best)
"""


def test_a_posterior_of_a_third_party_needs_a_class_and_an_entry_point(install: Installer) -> None:
    point = {"cfx.posteriors": {"certain": "certain_posterior:CertainMethod"}}
    install("somebody-else", point, {"certain_posterior.py": CERTAIN})
    found = cfx.run([*QUICK, "hydra.run.dir=job", "calibration.posterior=certain"])
    rows = (
        pd.read_parquet("job/fits.parquet")
        .query("method == 'driver_specific'")
        .set_index("pair_id")
    )
    fixed = found.pairs.query("method == 'driver_specific'").set_index("pair_id")
    for name in found.evaluation.names:
        assert found.metrics[f"posterior/determined/{name}"] == 1
        expected = fixed[f"parameter_{name}"]
        pd.testing.assert_series_equal(rows[f"median_{name}"], expected, check_names=False)


def test_a_posterior_that_is_not_there_is_named_before_any_work() -> None:
    with pytest.raises(PluginError, match=r"calibration\.posterior=laplce: .*'laplace'"):
        cfx.run([*QUICK, "hydra.run.dir=job", "calibration.posterior=laplce"])
    assert not Path("job/pairs.csv").exists()
