"""Every rival holds the contract of rivals, with a small budget."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch

from cfx.plugin import PairSet, registry
from cfx_report.benchmark.contract import CHECKS, Tried, tried
from cfx_report.benchmark.rival import Rival
from cfx_report.rivals.lagged import LaggedRival
from cfx_report.rivals.noisy_idm import _given_covariances, _kernel

SMALL: dict[str, dict[str, Any]] = {
    "ridge": {"moments": 200},
    "boosting": {"moments": 100},
    "neighbours": {"moments": 200, "neighbours": 5},
    "gaussian_process": {"moments": 20},
    "direct_gru": {"steps": 2, "stretches": 4, "seconds": 3.0, "hidden_size": 8},
    "direct_lstm": {"steps": 2, "stretches": 4, "seconds": 3.0, "hidden_size": 8},
    "transformer": {"steps": 2, "stretches": 4, "seconds": 3.0, "hidden_size": 8},
    "physics_informed": {"steps": 20, "hidden_size": 8},
    "ar_idm": {"remembered": 2, "optimizer": "random"},
    "ma_idm": {"remembered": 2, "optimizer": "random"},
    "stacked": {"members": ["ridge", "constant_acceleration"], "similar": 20},
}
NAMES = [entry.name for entry in registry.entries("rival") if entry.distribution == "cfx-report"]


def made(name: str, **settings: object) -> Rival:
    return cast(Rival, registry.create("rival", {"name": name, **SMALL.get(name, {}), **settings}))


@pytest.fixture(scope="module", params=NAMES)
def one(request: pytest.FixtureRequest) -> Tried:
    return tried(made(request.param))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract(one: Tried, check: Any) -> None:
    check(one)


def test_a_network_learns_to_follow() -> None:
    """After a few steps it is nearer to the drivers than before: gradients reach it."""
    untrained, trained = made("direct_gru", steps=1), made("direct_gru", steps=40, stretches=16)
    errors = []
    for rival in (untrained, trained):
        done = tried(rival)
        speed = done.driver.drive(done.segments.blanked(), done.segments.first, None)
        batch = done.segments.batch()
        later = batch.mask & (torch.arange(batch.mask.shape[1]) > done.segments.first[:, None])
        errors.append(float((speed - batch.follower_speed)[later].square().mean().sqrt()))
    assert errors[1] < 0.8 * errors[0]


def test_noise_is_the_best_linear_prediction() -> None:
    """An AR(1) process with 0.8 is found again from its covariances."""
    noise = _given_covariances(0.8 ** np.arange(4.0))
    np.testing.assert_allclose(noise.weights, [0.8, 0.0, 0.0], atol=1e-12)
    assert noise.deviation == pytest.approx(0.6)
    assert _kernel(np.arange(3.0), 1.0, 2.0, 0.5)[0] == pytest.approx(1.5, abs=1e-5)


def test_sites_are_learned_from_evenly() -> None:
    """A site with many pairs gives no more moments than a small one."""
    from cfx_report.rivals.lagged import _drawn

    done = tried(made("constant_speed"))
    pairs = PairSet((*done.pairs.pairs,), "pairs")
    drawn = _drawn(pairs, 60, 0)
    counts: dict[str, int] = {}
    for pair, moments in zip(pairs, drawn, strict=True):
        counts[pair.site] = counts.get(pair.site, 0) + len(moments)
    assert all(abs(count - 60) <= 3 for count in counts.values())


def test_a_regression_drives_with_the_lags_that_drive_best(monkeypatch: pytest.MonkeyPatch) -> None:
    rival = made("ridge")
    assert isinstance(rival, LaggedRival)
    monkeypatch.setattr("cfx_report.rivals.lagged.mean_error", lambda driver, _: -driver.lags)
    assert tried(rival).driver.lags == 21  # type: ignore[attr-defined]
