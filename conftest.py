"""Fixtures and settings for the tests of cfx and of the distributions in `plugins/`."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# PyTorch's threads spin while they wait, and take the cores that other test processes want: small
# tests cost ten times as much CPU time. PyTorch reads this when it is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from tests.checkout import ROOT
from tests.installer import Installer

# xdist's own process reads this file too, and runs no test: fixtures import what takes seconds.
if TYPE_CHECKING:
    from cfx.data.pairs import PairSet

pytest_plugins = ["tests.browser", "tests.bucket", "tests.flat"]

# A slow machine is no failure, and a failure must come again on the next run.
settings.register_profile("cfx", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("cfx")


def pytest_configure() -> None:
    """Lets garbage be collected less often: it took a tenth of all the tests' time."""
    gc.set_threshold(20_000, 20, 20)


def pytest_collection_finish() -> None:
    """Spares the garbage collector what was imported."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _away_from_the_checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Lets jobs that are told no folder write into one of the tests, and none into the checkout."""
    outputs = ROOT / "outputs"
    was_there, before = outputs.exists(), Path.cwd()
    os.chdir(tmp_path_factory.mktemp("work"))
    yield
    os.chdir(before)
    assert was_there or not outputs.exists(), f"a test has written into {outputs}"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; skips where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here ({folder}); see CONTRIBUTING.md")
    return folder


@pytest.fixture(scope="session")
def i80_pairs(shared_data: Path) -> PairSet:
    """All pairs of the reconstructed recordings of I-80."""
    from cfx.data.tidy import TidyDataset

    path = shared_data / "i80_reconstructed_pairs.parquet"
    return TidyDataset(path=path, min_duration=0, accelerations="recorded").load()


@pytest.fixture
def install(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Installer]:
    """Returns a function that installs a fabricated distribution for one test."""
    before = set(sys.modules)
    folder = tmp_path_factory.mktemp("site")
    yield Installer(folder, monkeypatch)
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]
