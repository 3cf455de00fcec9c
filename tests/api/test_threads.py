"""Programs with threads: pools, web servers and notebooks call cfx from several at once."""

from __future__ import annotations

import asyncio
import json
import os
import random
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import fastapi
import joblib
import numpy as np
import pandas as pd
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.version import VersionBase

import cfx
from cfx.app import hydra_source

SMALL = {"optimizer": "random", "optimizer.samples": 16, "calibration.prior": "weak"}
POLICY = "cfx://idm"


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return cfx.read(dataset="synthetic", pairs=2, frames=200).frame


@pytest.fixture(scope="module")
def calls(table: pd.DataFrame) -> list[Callable[[], pd.DataFrame]]:
    """Returns calls of each kind."""
    pairs = cfx.read(table)
    return [
        lambda: cfx.read(table).frame,
        lambda: cfx.calibrate(pairs, "idm", **SMALL).parameters,
        lambda: cfx.simulate("krauss", None, pairs),
        lambda: cfx.evaluate(POLICY, pairs, **SMALL).pairs,
    ]


@pytest.fixture(scope="module")
def alone(calls: list[Callable[[], pd.DataFrame]]) -> list[pd.DataFrame]:
    """What each call gives in one thread."""
    return [call() for call in calls]


def _numbers(generators: list[Callable[[], float]], futures: list[Future[Any]]) -> list[float]:
    """Draws from a program's own generators while threads of it work; once at least."""
    numbers = [draw() for draw in generators]
    while wait(futures, timeout=0.005).not_done:
        numbers += [draw() for draw in generators]
    return numbers


def test_threads_get_the_bits_of_one_and_leave_the_program_its_random_numbers(
    calls: list[Callable[[], pd.DataFrame]], alone: list[pd.DataFrame]
) -> None:
    generators = [random.random, np.random.random, lambda: torch.rand(()).item()]

    def begin() -> None:
        random.seed(1)
        np.random.seed(1)  # noqa: NPY002 - as above
        torch.manual_seed(1)

    begin()
    with ThreadPoolExecutor(8) as pool:
        futures = [pool.submit(call) for call in 2 * calls]
        drawn = _numbers(generators, futures)
    for future, expected in zip(futures, 2 * alone, strict=True):
        pd.testing.assert_frame_equal(future.result(), expected, check_exact=True)
    begin()
    assert [draw() for _ in range(len(drawn) // 3) for draw in generators] == drawn
    assert not GlobalHydra.instance().is_initialized()


def test_joblibs_threads(table: pd.DataFrame, alone: list[pd.DataFrame]) -> None:
    def calibrated() -> pd.DataFrame:
        return cfx.calibrate(cfx.read(table), "idm", **SMALL).parameters

    workers = joblib.Parallel(n_jobs=3, backend="threading")
    for parameters in workers(joblib.delayed(calibrated)() for _ in range(3)):
        pd.testing.assert_frame_equal(parameters, alone[1], check_exact=True)


async def _asked(app: fastapi.FastAPI, path: str) -> Any:
    """Returns what a web application answers to one request."""
    scope = {"type": "http", "method": "GET", "path": path, "headers": [], "query_string": b""}
    parts: list[bytes] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        parts.append(message.get("body", b""))

    await app({**scope, "http_version": "1.1", "scheme": "http"}, receive, send)
    return json.loads(b"".join(parts))


def test_a_web_server(table: pd.DataFrame, alone: list[pd.DataFrame]) -> None:
    """FastAPI answers each request in a thread of its pool."""
    app = fastapi.FastAPI()

    @app.get("/parameters")
    def parameters() -> list[float]:
        fit = cfx.calibrate(cfx.read(table), "idm", **SMALL)
        return [float(value) for value in fit.parameters.to_numpy().ravel()]

    async def answers() -> list[Any]:
        return await asyncio.gather(*[_asked(app, "/parameters") for _ in range(4)])

    expected = alone[1].to_numpy().ravel().tolist()
    assert asyncio.run(answers()) == [expected] * 4


def test_other_threads_keep_their_hydra_and_their_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While one thread composes, what another reads and sets is the program's own."""
    monkeypatch.delenv("OF_THE_PROGRAM", raising=False)
    base, holder = VersionBase.instance(), HydraConfig.instance()
    before = (base.version_base, holder.cfg)
    config = hydra_source.composed([])

    def elsewhere() -> tuple[Any, Any]:
        os.environ["OF_THE_PROGRAM"] = "1"
        seen = (VersionBase.instance().version_base, HydraConfig.instance().cfg)
        HydraConfig.instance().cfg = "the program's"  # type: ignore[assignment]
        return seen

    with ThreadPoolExecutor(1) as pool, hydra_source.resolving(config):
        assert HydraConfig.get().job.name == "cfx"
        assert pool.submit(elsewhere).result() == before
    assert HydraConfig.instance().cfg == "the program's"
    assert VersionBase.instance() is base
    assert os.environ["OF_THE_PROGRAM"] == "1"
    holder.cfg = before[1]
