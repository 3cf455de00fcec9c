"""A program that calls cfx goes on as if it had not: success and failure leave no trace in it."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import signal
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import hydra
import lightning.pytorch  # noqa: F401 - its loggers are there before a job sets their levels
import mlflow
import numpy as np
import pandas as pd
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.version import getbase
from omegaconf import OmegaConf

import cfx
from cfx.core import registry
from cfx.core.threads import cores_limit, limit_cores
from cfx.simulation.rollout import simulate_follower

QUICK = ["debug=quick", "data.max_pairs=3", "learner.epochs=1", "figures=none"]
QUICK.append("calibration.prior=none")

State = dict[str, Any]


class JobError(Exception):
    """What a job ends with here."""


_finished: list[cfx.plugin.Result] = []
"""The job that a program ran, for those who look at it later."""


def finished_job() -> None:
    _finished[:] = [cfx.run([*QUICK, "cores=1"])]


def failed_job() -> None:
    """A job whose plugin sets what it likes, for the whole process, and fails."""
    with pytest.raises(JobError):
        cfx.run(QUICK, run_job=_disturb)


def mistaken_job() -> None:
    with pytest.raises(cfx.errors.ConfigError, match="there is no optimizer"):
        cfx.run(["optimizer=nonexistent"])


def refused_job() -> None:
    with pytest.raises(cfx.errors.CfxError):
        cfx.run([*QUICK, "data=tidy", "data.path=nonexistent.csv"])


def loaded_job() -> None:
    cfx.load("cfx://idm")


def nothing_loaded() -> None:
    with pytest.raises(cfx.errors.DataError):
        cfx.load(Path.cwd())


def simulation() -> None:
    cfx.simulate("idm", {"T": 1.2}, leader=_leader())


def compiled_simulation() -> None:
    simulate_follower(_model(), None, *_scene(), 0.1, compile="always")


def refused_simulation() -> None:
    with pytest.raises(cfx.errors.CfxError, match="outside its bounds"):
        cfx.simulate("idm", {"T": -1.0}, leader=_leader())


def calibration() -> None:
    pairs = cfx.read(dataset="synthetic", pairs=2, frames=150)
    fit = cfx.calibrate(pairs, "idm", optimizer="random")
    assert len(fit.losses) == 6


def refused_calibration() -> None:
    with pytest.raises(cfx.errors.ConfigError, match="there is no objective"):
        cfx.calibrate(cfx.read(dataset="synthetic", pairs=2, frames=150), objective="none")


def components() -> None:
    for kind, name in (("model", "w99"), ("learner", "rollout"), ("optimizer", "botorch")):
        cfx.get(kind, name)


def unknown_component() -> None:
    with pytest.raises(cfx.errors.CfxError):
        cfx.get("model", "nonexistent")


CALLS = [
    finished_job,
    failed_job,
    mistaken_job,
    refused_job,
    loaded_job,
    nothing_loaded,
    simulation,
    compiled_simulation,
    refused_simulation,
    calibration,
    refused_calibration,
    components,
    unknown_component,
]


def _disturb(_config: Any, _folder: Path) -> Any:
    torch.set_num_threads(2)
    torch.set_default_dtype(torch.float16)
    torch.set_grad_enabled(False)
    torch.use_deterministic_algorithms(False)
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("medium")
    limit_cores(1)
    logging.basicConfig(force=True, level=logging.DEBUG)
    logging.disable(logging.ERROR)
    for name in ("callers", "callers.off"):
        logger = logging.getLogger(name)
        logger.disabled = not logger.disabled
        logger.setLevel(logging.FATAL)
        logger.handlers.clear()
        logger.propagate = False
    warnings.simplefilter("ignore")
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    os.environ["CALLERS"] = "another"
    os.environ["NOT_THE_CALLERS"] = "1"
    os.chdir("/")
    sys.argv.append("more")
    mlflow.set_tracking_uri("sqlite:////nowhere/mlflow.db")
    raise JobError


def _model() -> cfx.plugin.DrivingModel:
    return cast("cfx.plugin.DrivingModel", registry.create("model", {"name": "idm"}))


def _leader() -> pd.DataFrame:
    return pd.DataFrame({"time_s": np.arange(50) * 0.1, "speed": 12.0})


def _scene() -> tuple[cfx.plugin.Leader, cfx.plugin.Start]:
    speed = torch.full((1, 60), 12.0)
    position = 40 + 1.2 * torch.arange(60.0)[None]
    leader = cfx.plugin.Leader(position, speed, torch.zeros(1, 60), torch.full((1,), 4.5))
    return leader, cfx.plugin.Start(torch.zeros(1), torch.full((1,), 12.0), torch.zeros(1))


def _loggers() -> State:
    found = {}
    names = ["root", *logging.getLogger().manager.loggerDict]
    for name in names:
        logger = logging.getLogger() if name == "root" else logging.getLogger(name)
        found[name] = (
            logger.level,
            logger.handlers[:],
            logger.filters[:],
            logger.disabled,
            logger.propagate,
        )
    return found


def _state() -> State:
    return {
        "threads": (torch.get_num_threads(), cores_limit()),
        "torch": (
            torch.get_default_dtype(),
            torch.is_grad_enabled(),
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
            torch.backends.cudnn.benchmark,
            torch.backends.cudnn.deterministic,
            torch.get_float32_matmul_precision(),
        ),
        "random": (
            random.getstate(),
            np.random.get_state()[1].tolist(),  # type: ignore[index, union-attr]  # noqa: NPY002 - what a program may have seeded
            torch.get_rng_state().tolist(),
        ),
        "logging": (_loggers(), logging.getLogger().manager.disable),
        "warnings": (warnings.filters[:], warnings.showwarning),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "process": (dict(os.environ), Path.cwd(), sys.argv[:]),
        "hydra": (GlobalHydra.instance().hydra, HydraConfig.instance().cfg, getbase()),
        "mlflow": (mlflow.get_tracking_uri(), mlflow.active_run()),
    }


@contextlib.contextmanager
def _a_program(folder: Path) -> Iterator[None]:
    """Lets the block be a program that has chosen all of it differently from what cfx would."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        patch.chdir(folder)
        patch.setenv("CALLERS", "1")
        patch.setattr(sys, "argv", ["callers.py", "--flag"])
        patch.delenv("MLFLOW_DISABLE_TELEMETRY", raising=False)
        warnings.filterwarnings("error", message="of the program")
        loud, off = logging.getLogger("callers"), logging.getLogger("callers.off")
        loud.addHandler(logging.NullHandler())
        off.disabled = True
        handlers, level = logging.getLogger().handlers[:], logging.getLogger().level
        logging.getLogger().setLevel(logging.ERROR)
        logging.getLogger().addHandler(logging.NullHandler())
        usual = signal.signal(signal.SIGUSR1, lambda *_: None)
        threads = torch.get_num_threads()
        torch.set_num_threads(3)
        torch.set_default_dtype(torch.float64)
        torch.use_deterministic_algorithms(True, warn_only=True)
        mlflow.set_tracking_uri(f"sqlite:///{folder}/callers.db")
        try:
            with torch.no_grad(), hydra.initialize(None, version_base="1.2"):
                HydraConfig.instance().cfg = OmegaConf.create({"hydra": {"mode": "RUN"}})  # type: ignore[assignment]
                yield
        finally:
            HydraConfig.instance().cfg = None
            mlflow.set_tracking_uri(None)  # type: ignore[arg-type]  # MLflow's own way to unset it
            torch.use_deterministic_algorithms(False)
            torch.set_default_dtype(torch.float32)
            torch.set_num_threads(threads)
            signal.signal(signal.SIGUSR1, usual)
            logging.getLogger().handlers[:] = handlers
            logging.getLogger().setLevel(level)
            loud.handlers.clear()
            off.disabled = False


@pytest.fixture(scope="module", params=CALLS, ids=lambda call: str(call.__name__))
def states(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[State, State]:
    """A program's state before and after it called cfx."""
    call: Callable[[], None] = request.param
    with _a_program(tmp_path_factory.mktemp("program")):
        before = _state()
        call()
        return before, _state()


@pytest.mark.parametrize(
    "kind",
    ["threads", "torch", "random", "warnings", "signals", "process", "hydra", "mlflow"],
)
def test_a_program_is_left_as_it_was(states: tuple[State, State], kind: str) -> None:
    before, after = states
    assert after[kind] == before[kind]


def test_loggers_are_left_as_they_were(states: tuple[State, State]) -> None:
    (before, below), (after, below_now) = states[0]["logging"], states[1]["logging"]
    assert below_now == below
    assert {name: after[name] for name in before} == before


@pytest.mark.parametrize("states", [finished_job], indirect=True)
def test_a_job_gives_the_same_numbers_whatever_its_caller_has_chosen(
    states: tuple[State, State], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(states) == 2
    monkeypatch.chdir(tmp_path)
    alone = cfx.run([*QUICK, "cores=1", "cache.enabled=false", "tracking.enabled=false"])
    assert _finished[0].metrics == pytest.approx(alone.metrics, rel=0, abs=0, nan_ok=True)


def _program(arguments: list[str], folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


APPLICATION = """
import hydra
import lightning.pytorch as pl
import mlflow
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from mlflow.utils import autologging_utils

mlflow.set_tracking_uri("sqlite:///callers.db")
mlflow.set_experiment("callers")
fit = pl.Trainer.fit
mlflow.autolog()
assert pl.Trainer.fit is not fit, "Lightning logs by itself"
import cfx

QUICK = ["debug=quick", "data.max_pairs=3", "learner.epochs=1", "figures=none"]
QUICK += ["calibration.prior=none", "cores=1"]

def fails(*_):
    raise SystemError

@hydra.main(version_base=None)
def main(config):
    hydras = HydraConfig.get(), GlobalHydra.instance().hydra
    try:
        cfx.run(QUICK, run_job=fails)
    except SystemError:
        pass
    assert mlflow.active_run() is None
    assert not autologging_utils.autologging_is_disabled("pytorch")
    assert not autologging_utils._AUTOLOGGING_GLOBALLY_DISABLED
    with mlflow.start_run() as mine:
        cfx.run(QUICK)
        assert mlflow.active_run().info.run_id == mine.info.run_id
    assert HydraConfig.get() is hydras[0]
    assert GlobalHydra.instance().hydra is hydras[1]
    data = mlflow.get_run(mine.info.run_id).data
    assert not data.metrics and not data.params, (data.metrics, data.params)
    runs = mlflow.search_runs(experiment_names=["callers"])
    assert len(runs) == 1, runs.to_string()
    print("went on")

main()
"""


def test_a_job_runs_within_somebody_elses_hydra_application_that_logs_by_itself(
    tmp_path: Path,
) -> None:
    """Autologging makes no run of a job, and goes on afterwards; the application is Hydra's own."""
    (tmp_path / "main.py").write_text(APPLICATION, encoding="utf-8")
    assert "went on" in _program(["main.py"], tmp_path)


def test_importing_cfx_changes_nothing(tmp_path: Path) -> None:
    script = """
        import logging, os, signal, warnings
        def state():
            signals = [signal.getsignal(number) for number in signal.valid_signals()]
            return dict(os.environ), warnings.filters[:], signals, logging.root.handlers[:]
        before = state()
        import cfx
        assert state() == before
    """
    _program(["-c", textwrap.dedent(script)], tmp_path)
