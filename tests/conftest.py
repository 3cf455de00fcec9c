"""Fixtures and settings for every test."""

from __future__ import annotations

import functools
import gc
import importlib
import os
import pickle
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

# PyTorch's threads spin while they wait, and take the cores that other test processes want: small
# tests cost ten times as much CPU time. PyTorch reads this when it is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hydra._internal import defaults_list
from hypothesis import settings
from omegaconf import OmegaConf, grammar_parser

# xdist's own process reads this file too, and runs no test: fixtures import what takes seconds.
if TYPE_CHECKING:
    from cfx.data.pairs import PairSet
    from cfx.simulation.synthetic import SyntheticDataset

pytest_plugins = ["tests.browser"]

ROOT = Path(__file__).resolve().parent.parent

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
def simulated_anew() -> Iterator[list[bool]]:
    """Simulates each synthetic recording once a session; while the list holds True, every time.

    What a job selects from a recording is no part of it.
    """
    from cfx.data.base import DatasetSettings
    from cfx.simulation.synthetic import SyntheticDataset

    anew = [False]
    selection = set(DatasetSettings.model_fields)
    known: dict[str, PairSet] = {}
    read = SyntheticDataset.read

    def read_once(self: SyntheticDataset) -> PairSet:
        key = self.settings.model_dump_json(exclude=selection)
        if anew[0] or key not in known:
            known[key] = read(self)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SyntheticDataset, "read", read_once)
        yield anew


@pytest.fixture(autouse=True)
def _simulates_anew(request: pytest.FixtureRequest, simulated_anew: list[bool]) -> Iterator[None]:
    """Lets tests whose names say that synthetic recordings are tested simulate them."""
    simulated_anew[0] = "synthetic" in request.node.nodeid
    yield
    simulated_anew[0] = False


@pytest.fixture(scope="session", autouse=True)
def _short_platoons(request: pytest.FixtureRequest) -> Iterator[None]:
    """Lets the leader of a job's platoons brake after 6 s and not 60: half of a small job's time.

    Jobs of slow tests, such as the golden ones, and `tests/evaluation/test_platoon.py` have the
    standard manoeuvre.
    """
    if request.config.getoption("markexpr") != "not slow":
        yield
        return
    from cfx.evaluation.platoon import Manoeuvre, measure_platoons
    from cfx.evaluation.protocols import held_out, within_driver

    short = functools.partial(
        measure_platoons, manoeuvre=Manoeuvre(settle=6.0, hold=2.0, after=4.0)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(held_out, "measure_platoons", short)
        patch.setattr(within_driver, "measure_platoons", short)
        yield


@pytest.fixture(scope="session", autouse=True)
def _parsed_once() -> Iterator[None]:
    """Parses each text of YAML, and each interpolation, once a session.

    That is a third of the time in which Hydra composes.
    """
    known: dict[str, bytes] = {}
    load = OmegaConf.load

    def load_once(file: Any) -> Any:
        if not hasattr(file, "read"):
            return load(file)
        text = file.read()
        if text not in known:
            file.seek(0)
            known[text] = pickle.dumps(load(file))
        return pickle.loads(known[text])  # noqa: S301 - pickled three lines above

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(load_once))
        parse_once = functools.lru_cache(maxsize=None)(grammar_parser.parse)
        for module in ("base", "_utils"):
            patch.setattr(f"omegaconf.{module}.parse", parse_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def _choices_where_they_are_read() -> Iterator[None]:
    """Lets Hydra list all choices so far only for a default that is named by one of them.

    It does so for each file, which is another quarter of the time in which it composes.
    """
    make = defaults_list._create_interpolation_map

    def make_if_read(overrides: Any, defaults: Sequence[Any], self_added: bool) -> Any:
        if any(one.is_interpolation() for one in defaults):
            return make(overrides, defaults, self_added)
        return None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(defaults_list, "_create_interpolation_map", make_if_read)
        yield


@pytest.fixture(scope="session", autouse=True)
def _scores_without_compiling() -> None:
    """Hides Numba from `scoringrules`, which compiles for two seconds what cfx never calls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "numba", None)
        importlib.import_module("scoringrules")


@pytest.fixture(scope="session", autouse=True)
def _migrated_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Lets MLflow run its migrations once a session, and not for 1 s of each new database."""
    from cfx.results.mlflow import store

    migrated = tmp_path_factory.mktemp("store") / "migrated.db"
    create = store._create

    def create_from_copy(file: Path, home: Path) -> None:
        from mlflow.store.db import utils  # a second, which most tests do not wait for

        migrate = utils._initialize_tables

        def initialize(engine: Any) -> None:
            if migrated.exists():
                engine.dispose()
                shutil.copyfile(migrated, engine.url.database)
            else:
                migrate(engine)
                shutil.copyfile(engine.url.database, migrated)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(utils, "_initialize_tables", initialize)
            create(file, home)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "_create", create_from_copy)
        yield


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


class Installer:
    """Puts fabricated distributions on the import path, as pip would leave them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self._monkeypatch = monkeypatch
        monkeypatch.syspath_prepend(str(folder))

    def __call__(
        self,
        name: str,
        entry_points: dict[str, dict[str, str]],
        files: dict[str, str],
        version: str = "1.0",
    ) -> None:
        """Installs a distribution: entry points by group, and its files' texts by path."""
        for path, text in files.items():
            target = self.folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(textwrap.dedent(text), encoding="utf-8")
        info = self.folder / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8"
        )
        groups = [
            f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items())
            for group, points in entry_points.items()
        ]
        (info / "entry_points.txt").write_text("\n".join(groups), encoding="utf-8")
        importlib.invalidate_caches()


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
